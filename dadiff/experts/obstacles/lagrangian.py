"""The augmented Lagrangian of collision avoidance, batched: its value, gradient and curvature.

    L(p) = f(p) + sum_{t,j} (s_tj^2 - lambda_tj^2) / (2 mu)
    s = max(0, lambda + mu g),   g = (r_j^2 - |p(t) - o_j|^2) / 2

The constraint g <= 0 is smooth everywhere, dg/dp = -(p - o) and d2g/dp2 = -I. So the Hessian's block at t is

    sum_j mu [s_tj > 0] (p - o_j)(p - o_j)' - s_tj I       (Gauss-Newton leaves out the last term)

on top of that of f, and stays block pentadiagonal. The batch is the last axis. Absent discs have r = 0: g <= 0 always.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dadiff.experts.obstacles.problem import ObstacleProblem
from dadiff.experts.obstacles.quadratic import Quadratic, batch_last, select


@dataclass(frozen=True)
class Lagrangian:
    """L of N environments.

    Args:
        f: the cost without obstacles.
        centre: o, (2, O, N).
        radius: r, (O, N).
        multiplier: lambda >= 0, (K, O, N) for t = 2..T.
        penalty: mu > 0, (N,).
    """

    f: Quadratic
    centre: np.ndarray
    radius: np.ndarray
    multiplier: np.ndarray
    penalty: np.ndarray

    @classmethod
    def of(cls, problem: ObstacleProblem, penalty: float) -> Lagrangian:
        """L of a problem with every multiplier 0."""
        centre, radius = batch_last(problem.centre.swapaxes(1, 2)), batch_last(problem.radius)
        multiplier = np.zeros((problem.horizon - 1, *radius.shape))
        return cls(Quadratic.of(problem), centre, radius, multiplier, np.full(problem.count, penalty))

    def take(self, index: np.ndarray) -> Lagrangian:
        """The environments at `index`."""
        parts = {name: select(getattr(self, name), index) for name in ("centre", "radius", "multiplier", "penalty")}
        return replace(self, f=self.f.take(index), **parts)

    def constraint(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """g, (K, O, N), and p - o, (K, 2, O, N)."""
        offset = p[2:, :, None] - self.centre
        return (self.radius**2 - offset[:, 0] ** 2 - offset[:, 1] ** 2) / 2, offset

    def force(self, g: np.ndarray) -> np.ndarray:
        """s = max(0, lambda + mu g), (K, O, N): what the discs push back with, and the next multipliers."""
        return np.maximum(self.multiplier + self.penalty * g, 0)

    def value(self, p: np.ndarray, s: np.ndarray | None = None) -> np.ndarray:
        """L, (N,), with s at p where it is known."""
        s = self.force(self.constraint(p)[0]) if s is None else s
        return self.f.value(p) + (s**2 - self.multiplier**2).sum(axis=(0, 1)) / (2 * self.penalty)

    def gradient(self, p: np.ndarray, s: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """dL/dq, (K, 2, N), with s and p - o at p."""
        return self.f.gradient(p) - (s[:, None] * offset).sum(axis=2)

    def blocks(self, s: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The diagonal blocks of the Gauss-Newton Hessian, (K, 2, 2, N), and what Newton takes off, (K, N)."""
        x, y = offset[:, 0], offset[:, 1]
        stiff = self.penalty * (s > 0)
        sx = stiff * x
        free = self.f.hessian_diagonal()
        blocks = np.empty((len(s), 2, 2, s.shape[-1]))
        blocks[:, 0, 0] = free + (sx * x).sum(axis=1)
        blocks[:, 0, 1] = blocks[:, 1, 0] = (sx * y).sum(axis=1)
        blocks[:, 1, 1] = free + (stiff * y * y).sum(axis=1)
        return blocks, s.sum(axis=1)

    def newton_step(self, gradient: np.ndarray, s: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """-H^-1 gradient, (K, 2, N): Newton's H where it is positive definite, else that of Gauss-Newton."""
        blocks, concave = self.blocks(s, offset)
        newton = blocks.copy()
        newton[:, 0, 0] -= concave
        newton[:, 1, 1] -= concave
        factor = self.f.factorise(newton)
        step = factor.solve(-gradient)
        bent = np.flatnonzero(~factor.definite)
        if len(bent):
            step[..., bent] = self.f.factorise(select(blocks, bent)).solve(select(-gradient, bent))
        return step

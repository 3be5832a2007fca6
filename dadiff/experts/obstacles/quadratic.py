"""The cost without obstacles, a convex quadratic in the positions p(2..T), and its minimum in closed form.

    f(p) = sum_t w(t) |p(t) - v(t)|^2 + kappa sum_t |p(t+2) - 2 p(t+1) + p(t)|^2,   kappa = rho / dt^4

Arrays have the batch as the last axis: p is (T+1, 2, N). Gradient and Hessian are those of q = p(2..T), K = T - 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dadiff.experts.obstacles.pentadiagonal import Band, Factor, factorise, squared_second_difference
from dadiff.experts.obstacles.problem import ObstacleProblem

_band = lru_cache(squared_second_difference)


def batch_last(array: np.ndarray) -> np.ndarray:
    """(N, ...) to contiguous (..., N)."""
    return np.ascontiguousarray(np.moveaxis(array, 0, -1))


def select(array: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The environments at `index`, (..., len(index)), contiguous: array[..., index] would put the batch first."""
    return np.take(array, index, axis=-1)


@dataclass(frozen=True)
class Quadratic:
    """f of N environments.

    Args:
        weight: w, (T+1, N).
        goal: v, (T+1, 2, N).
        kappa: weight of the squared second differences.
    """

    weight: np.ndarray
    goal: np.ndarray
    kappa: float

    @classmethod
    def of(cls, problem: ObstacleProblem) -> Quadratic:
        """f of a problem."""
        kappa = problem.input_cost / problem.time_step**4
        return cls(batch_last(problem.weight), batch_last(problem.goal), kappa)

    def take(self, index: np.ndarray) -> Quadratic:
        """The environments at `index`."""
        return replace(self, weight=select(self.weight, index), goal=select(self.goal, index))

    @property
    def band(self) -> Band:
        """What D'D holds; the Hessian of the second differences is 2 kappa D'D."""
        return _band(len(self.weight) - 2)

    def value(self, p: np.ndarray) -> np.ndarray:
        """f, (N,)."""
        bend = np.diff(p, n=2, axis=0)
        tracking = (self.weight * np.square(p - self.goal).sum(axis=1)).sum(axis=0)
        return tracking + self.kappa * np.square(bend).sum(axis=(0, 1))

    def gradient(self, p: np.ndarray) -> np.ndarray:
        """df/dq, (K, 2, N)."""
        bend = np.zeros_like(p)
        bend[:-2] = np.diff(p, n=2, axis=0)
        tracking = self.weight[2:, None] * (p[2:] - self.goal[2:])
        return 2 * tracking + 2 * self.kappa * np.diff(bend, n=2, axis=0)

    def hessian_diagonal(self) -> np.ndarray:
        """The diagonal of d2f/dq2, the same for both axes, (K, N)."""
        return 2 * self.weight[2:] + 2 * self.kappa * self.band.diagonal[:, None]

    def factorise(self, diagonal: np.ndarray) -> Factor:
        """The factors of a Hessian with the second differences of f and these diagonal blocks, (K, 2, 2, N)."""
        return factorise(diagonal, 2 * self.kappa * self.band.first, 2 * self.kappa * self.band.second)


def obstacle_free(problem: ObstacleProblem) -> np.ndarray:
    """argmin f: the positions of the optimum without obstacles, (N, T+1, 2). One Newton step, as f is quadratic."""
    f = Quadratic.of(problem)
    p = np.empty((problem.horizon + 1, 2, problem.count))
    p[:2] = batch_last(problem.start)
    p[2:] = p[1]
    diagonal = f.hessian_diagonal()[:, None, None] * np.eye(2)[:, :, None]
    p[2:] -= f.factorise(diagonal).solve(f.gradient(p))
    return np.moveaxis(p, -1, 0)

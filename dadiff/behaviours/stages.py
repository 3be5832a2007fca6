"""The rows of G tau = g: one block x(t+1) - A_t x(t) - B_t u(t) = c_t for each stage t = 0..T-1.

G is banded, so that it and its transpose are applied in O(T), and M = G W G' + R with a diagonal W is block
tridiagonal: `BlockTridiagonal` factorises it by a recursion over the stages. Multipliers and residuals are written
(*robots, T, plans, n), time before plans. Works on numpy arrays and torch tensors alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems import System, require_affine
from dadiff.trajectory.arrays import Array, contiguous, join, stack
from dadiff.trajectory.layout import TrajectoryLayout

NEARLY_DEPENDENT = 1e13


def transposed(M: Array) -> Array:
    """M' of a stack of matrices."""
    return M.swapaxes(-1, -2)


@dataclass(frozen=True)
class Stages:
    """x(t+1) = A_t x(t) + B_t u(t) + c_t.

    Args:
        A: (*robots, T, n, n).
        B: (*robots, T, n, m).
        c: (*robots, T, n).
    """

    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    c: np.ndarray = field(repr=False)

    @classmethod
    def constant(cls, A: np.ndarray, B: np.ndarray, c: np.ndarray | None, horizon: int) -> Stages:
        """The same (A (*robots, n, n), B, c (*robots, n)) at every stage."""
        offset = np.zeros(A.shape[:-1]) if c is None else np.broadcast_to(c, A.shape[:-1])
        A, B = (np.repeat(M[..., None, :, :], horizon, axis=-3) for M in (A, B))
        return cls(A, B, np.repeat(offset[..., None, :], horizon, axis=-2))

    def __post_init__(self) -> None:
        A, B, c = self.A.shape, self.B.shape, self.c.shape
        if A[-1] != A[-2] or B[:-1] != A[:-1] or c != A[:-1]:
            raise ShapeError(
                f"dynamics: A has shape {tuple(A)}, B {tuple(B)}, c {tuple(c)}; "
                "expected (*robots, T, n, n), (*robots, T, n, m), (*robots, T, n)"
            )

    @property
    def robots(self) -> tuple[int, ...]:
        """Leading dimensions."""
        return self.A.shape[:-3]

    def take(self, index: np.ndarray) -> Stages:
        """Of some robots."""
        return Stages(self.A[index], self.B[index], self.c[index])

    def residual(self, layout: TrajectoryLayout, tau: Array) -> Array:
        """G tau - g of tau (*robots, plans, d): (*robots, T, plans, n)."""
        x, u = (contiguous(part.swapaxes(-2, -3)) for part in layout.split(tau))
        predicted = x[..., :-1, :, :] @ transposed(self.A) + u @ transposed(self.B) + self.c[..., :, None, :]
        return x[..., 1:, :, :] - predicted

    def adjoint(self, layout: TrajectoryLayout, multipliers: Array) -> Array:
        """G' lambda of lambda (*robots, T, plans, n): (*robots, plans, d)."""
        zero = 0 * multipliers[..., :1, :, :]
        states = join([zero, multipliers], -3) - join([multipliers @ self.A, zero], -3)
        return by_plan(layout, states, -(multipliers @ self.B))

    def matrix(self, layout: TrajectoryLayout) -> tuple[np.ndarray, np.ndarray]:
        """G of shape (*robots, nT, d) and g of shape (*robots, nT)."""
        unit = np.broadcast_to(np.eye(layout.size), (*self.robots, layout.size, layout.size))
        g = self.c.reshape(*self.robots, -1)
        columns = self.residual(layout, unit) + self.c[..., :, None, :]
        return transposed(columns.swapaxes(-2, -3).reshape(*self.robots, layout.size, -1)), g

    def simulate(self, x_init: Array, inputs: Array) -> Array:
        """States (*robots, plans, T+1, n) from x(0) (*robots, plans, n) and inputs (*robots, plans, T, m)."""
        forced = inputs.swapaxes(-2, -3) @ transposed(self.B) + self.c[..., :, None, :]
        states = [x_init]
        for t in range(self.A.shape[-3]):
            states.append(states[-1] @ transposed(self.A[..., t, :, :]) + forced[..., t, :, :])
        return stack(states, -2)


def stages_of(system: System, horizon: int) -> Stages:
    """The stages of a linear system, which may vary in time, over T inputs."""
    return Stages(*require_affine(system, "projector").matrices(horizon))


def by_plan(layout: TrajectoryLayout, states: Array, inputs: Array) -> Array:
    """tau (*robots, plans, d) of states (*robots, T+1, plans, n) and inputs (*robots, T, plans, m)."""
    return layout.flatten(states.swapaxes(-2, -3), inputs.swapaxes(-2, -3))


@dataclass(frozen=True)
class BlockTridiagonal:
    """M = G W G' + R, factorised as by a Kalman filter that measures x(t) with covariance W.

    With P(t) the variance of x(t) once the stages before t hold, P(0) = W_x(0),

        N(t) = A_t P(t) A_t' + B_t W_u(t) B_t' + R(t),   S(t) = N(t) + W_x(t+1),   P(t+1) = W_x(t+1) S(t)^-1 N(t),

    S are the pivots of M. P is a product and no difference: nothing cancels where A is unstable.

    Args:
        stages: of G.
        weights: the diagonal of W for the states, (*robots, T+1, 1, n), and for the inputs, (*robots, T, 1, m).
        inverse: S(t)^-1, (*robots, T, n, n).
        carry: A_t W_x(t) S(t-1)^-1 transposed, (*robots, T, n, n).
        variance: P(t), (*robots, T, n, n).
    """

    stages: Stages
    weights: tuple[np.ndarray, np.ndarray] = field(repr=False)
    inverse: np.ndarray = field(repr=False)
    carry: np.ndarray = field(repr=False)
    variance: np.ndarray = field(repr=False)

    @classmethod
    def of(
        cls, stages: Stages, layout: TrajectoryLayout, weights: np.ndarray, noise: np.ndarray | float = 0.0
    ) -> BlockTridiagonal:
        """Factorise with W = diag(weights (..., d)) and R = noise I.

        Args:
            noise: a number, or one for each robot (*robots,).

        Raises:
            ConfigError: if the stages cannot all hold: too many entries have weight 0.
        """
        W_x, W_u = layout.split(np.broadcast_to(weights, (*stages.robots, layout.size)))
        added = (stages.B * W_u[..., None, :]) @ transposed(stages.B)
        unit = np.eye(layout.state_dim)
        added, measured = added + np.asarray(noise)[..., None, None, None] * unit, W_x[..., None] * unit
        P, pivots, inverse, variance = measured[..., 0, :, :], [], [], []
        over_time = (np.moveaxis(M, -3, 0) for M in (stages.A, transposed(stages.A), added, measured[..., 1:, :, :]))
        for A, A_t, Q, W in zip(*over_time, strict=True):
            variance.append(P)
            N = A @ P @ A_t + Q
            pivots.append(N + W)
            inverse.append(_inverted(pivots[-1]))
            P = W @ (inverse[-1] @ N)
            P = (P + transposed(P)) / 2
        S_inverse = np.stack(inverse, axis=-3)
        _check_pivots(np.stack(pivots, axis=-3), S_inverse)
        carry = S_inverse[..., :-1, :, :] @ (W_x[..., 1:-1, :, None] * transposed(stages.A[..., 1:, :, :]))
        return cls(stages, (W_x[..., None, :], W_u[..., None, :]), S_inverse, carry, np.stack(variance, axis=-3))

    def solve(self, right: Array) -> tuple[Array, Array]:
        """lambda = M^-1 r, by one sweep forwards and one backwards, and W G' lambda for states and inputs.

            y(t) = r(t) + A_t W_x(t) S(t-1)^-1 y(t-1),   lambda(t) = S(t)^-1 (y(t) + W_x(t+1) A_t+1' lambda(t+1))
            (W G' lambda)(t+1) = W_x(t+1) S(t)^-1 y(t) - P(t+1) A_t+1' lambda(t+1)

        Args:
            right: r of shape (*robots, T, plans, n).

        Returns:
            lambda (*robots, T, plans, n), and W G' lambda as (states (*robots, T+1, ...), inputs (*robots, T, ...)).
        """
        horizon, forward = right.shape[-3], [right[..., 0, :, :]]
        for t in range(1, horizon):
            forward.append(right[..., t, :, :] + forward[-1] @ self.carry[..., t - 1, :, :])
        scaled = stack(forward, -3) @ self.inverse
        backward = [scaled[..., -1, :, :]]
        for t in reversed(range(horizon - 1)):
            backward.append(scaled[..., t, :, :] + backward[-1] @ transposed(self.carry[..., t, :, :]))
        multipliers = stack(backward[::-1], -3)
        W_x, W_u = self.weights
        zero = 0 * scaled[..., :1, :, :]
        filtered = join([zero, W_x[..., 1:, :, :] * scaled], -3)
        smoothed = join([(multipliers @ self.stages.A) @ self.variance, zero], -3)
        return multipliers, (filtered - smoothed, -W_u * (multipliers @ self.stages.B))


def _inverted(S: np.ndarray) -> np.ndarray:
    """S^-1; nan where it has none."""
    try:
        return np.linalg.inv(S)
    except np.linalg.LinAlgError:
        return np.full_like(S, np.nan)


def _check_pivots(S: np.ndarray, inverse: np.ndarray) -> None:
    """Refuse a row that follows from the others: by how much it does is S_ii (S^-1)_ii, whatever the units."""
    dependence = np.einsum("...tii,...tii->...ti", S, inverse).max(axis=-1)
    at = np.argwhere(~(dependence <= NEARLY_DEPENDENT))
    if len(at):
        raise ConfigError(
            "projection: the pins leave nothing free with which the dynamics could hold at t = "
            f"{int(at[:, -1].min())}; pin fewer entries"
        )

"""The nearest trajectory that obeys the dynamics, stays within bounds and keeps clear of discs, for many plans at once.

    min  sum w (z - z_hat)^2 / 2     s.t.  x(t+1) = A(t) x(t) + B(t) u(t) + c(t),   low <= z <= high,
                                           normal(t)_h' p(t) >= offset(t)_h

with p two entries of the state. Bounds, pins among them (low = high), and half-planes concern one time each, so that
given multipliers lambda of the dynamics the nearest z is a projection time by time,

    x(t) = P_t( x_hat(t) - (A(t)' lambda(t) - lambda(t-1)) / w ),      u(t) = clip( u_hat(t) - B(t)' lambda(t) / w )

and lambda maximises a concave dual whose gradient is the residual r of the dynamics. Semismooth Newton finds it in a
few steps (Qi & Sun 1993; Li, Sun & Toh 2018): the Jacobian of r is -G D G', block tridiagonal, where D is 1/w on
entries that are free to move and 0 on those at a bound. A step costs O(T n^3). What is returned keeps bounds exactly,
and the dynamics up to TOLERANCE.

Discs become half-planes about the estimate; a half-plane lies outside of its disc, so every solution is clear of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cache

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.system import Bounds
from dadiff.trajectory.layout import TrajectoryLayout

TOLERANCE = 1e-10
"""Residual of the dynamics at which a plan counts as found, relative to 1 + its largest entry."""

ITERATIONS = 100


class Status(IntEnum):
    """What became of one plan."""

    FOUND = 0
    NOT_CONVERGED = 1
    INFEASIBLE = 2  # proven by multipliers; what is close to feasible may end as NOT_CONVERGED


@dataclass(frozen=True)
class Limits:
    """What N plans must keep to; `nothing` leaves all free.

    Args:
        low, high: bounds on tau, (N, d), infinite where there is none; equal where an entry is pinned.
        normal: of half-planes, (N, T+1, K, 2).
        offset: (N, T+1, K); -inf stands for no half-plane.
        axes: the two entries of the state that half-planes are about.
    """

    low: np.ndarray = field(repr=False)
    high: np.ndarray = field(repr=False)
    normal: np.ndarray = field(repr=False)
    offset: np.ndarray = field(repr=False)
    axes: tuple[int, int] = (0, 1)

    @classmethod
    def nothing(cls, layout: TrajectoryLayout, count: int) -> Limits:
        """No limits for `count` plans."""
        free, times = np.full((count, layout.size), np.inf), layout.horizon + 1
        return cls(-free, free, np.zeros((count, times, 0, 2)), np.zeros((count, times, 0)))

    @classmethod
    def of(cls, layout: TrajectoryLayout, count: int, bounds: Bounds) -> Limits:
        """The bounds of a system, the same at all times."""
        low, high = (np.broadcast_to(bound, (count, layout.size)) for bound in within(layout, bounds))
        return replace(cls.nothing(layout, count), low=low, high=high)

    def pinned(self, places: np.ndarray, values: np.ndarray) -> Limits:
        """With the entries `places` (p,) held at values (N, p), whatever their bounds."""
        low, high = self.low.copy(), self.high.copy()
        low[:, places] = high[:, places] = values
        return replace(self, low=low, high=high)

    def clear_of(self, positions: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> Limits:
        """With a half-plane for each time and disc, see `half_planes`."""
        normal, offset = half_planes(positions, centre, radius)
        return replace(self, normal=normal, offset=offset)

    def take(self, index: np.ndarray) -> Limits:
        """Of some plans."""
        return Limits(self.low[index], self.high[index], self.normal[index], self.offset[index], self.axes)

    def clip(self, tau: np.ndarray) -> np.ndarray:
        """tau (N, d) between its bounds."""
        return np.clip(tau, self.low, self.high)

    def exceeded(self, layout: TrajectoryLayout, tau: np.ndarray) -> np.ndarray:
        """The sum of what tau (N, d) lacks to keep bounds and half-planes, (N,)."""
        p = layout.states(tau)[..., list(self.axes)]
        short = np.maximum(self.offset - (self.normal * p[:, :, None]).sum(-1), 0)
        return np.maximum(np.maximum(self.low - tau, tau - self.high), 0).sum(-1) + short.sum((-2, -1))


def within(layout: TrajectoryLayout, bounds: Bounds) -> tuple[np.ndarray, np.ndarray]:
    """A system's bounds as (low, high) of tau, each (d,)."""
    states, inputs = bounds.of_states(layout.state_dim), bounds.of_inputs(layout.input_dim)
    T = layout.horizon
    low, high = (
        layout.flatten(np.tile(x, (T + 1, 1)), np.tile(u, (T, 1))) for x, u in zip(states, inputs, strict=True)
    )
    return low, high


def half_planes(positions: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each time and disc the half-plane that touches the disc on the side of the path: normals and offsets.

    Args:
        positions: (N, T+1, 2).
        centre: (N, O, 2).
        radius: (N, O); 0 stands for no disc.

    Returns:
        (N, T+1, O, 2) and (N, T+1, O). There are none for absent discs, and none at t = 0 and 1, which inputs reach
        too late.
    """
    away = positions[:, :, None] - centre[:, None]
    normal = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
    offset = (normal * centre[:, None]).sum(axis=-1) + radius[:, None]
    offset[np.broadcast_to(radius[:, None] <= 0, offset.shape)] = -np.inf
    offset[:, :2] = -np.inf
    return normal, offset


@dataclass(frozen=True)
class Nearest:
    """What was found.

    Args:
        tau: (N, d); means something only where `status` is FOUND.
        status: `Status`, (N,).
        iterations: Newton steps, (N,).
        multiplier: lambda, (N, T, n), from which a neighbouring problem may start.
    """

    tau: np.ndarray = field(repr=False)
    status: np.ndarray = field(repr=False)
    iterations: np.ndarray = field(repr=False)
    multiplier: np.ndarray = field(repr=False)

    @property
    def found(self) -> np.ndarray:
        """Of which plans there is one, (N,)."""
        return self.status == Status.FOUND


def nearest(
    layout: TrajectoryLayout,
    tau: np.ndarray,
    A: np.ndarray,
    B: np.ndarray,
    c: np.ndarray,
    limits: Limits,
    scale: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Nearest:
    """The nearest admissible trajectory within limits, for each of N plans.

    Args:
        tau: (N, d), physical units.
        A, B, c: of every step, (T, n, n), (T, n, m), (T, n), or with a leading R where N / R plans each share them.
        scale: (d,), or with a leading dimension likewise; distances are |(z - z_hat) / scale|, by default Euclidean.
        start: multipliers of a neighbouring problem, (N, T, n).

    Raises:
        ShapeError: if tau disagrees with the layout.
        ConfigError: if a scale is not positive.
    """
    from dadiff.experts import nearest_kernels as kernels

    layout.check(tau)
    if tau.ndim != 2:
        raise ShapeError(f"nearest: plans have shape {tau.shape}; expected (N, {layout.size})")
    scale = np.ones(layout.size) if scale is None else scale
    if not (scale > 0).all():
        raise ConfigError("nearest: an entry has no positive scale, so nothing says how far it lies; give it one")
    N, T, n = len(tau), layout.horizon, layout.state_dim
    A, B, c = (M if M.ndim == rank + 1 else M[None] for M, rank in ((A, 3), (B, 3), (c, 2)))
    low, high = (_by_time(layout, np.broadcast_to(bound, tau.shape), 0.0) for bound in (limits.low, limits.high))
    weight = _by_time(layout, np.atleast_2d(scale) ** -2.0, 1.0)
    given = (_by_time(layout, tau, 0.0), weight, low, high, np.concatenate([A, B], axis=-1), c)
    s_hat, weight, low, high, F, c, normal, offset = (
        np.ascontiguousarray(array, dtype=np.float64) for array in (*given, limits.normal, limits.offset)
    )
    s, multiplier = np.empty((N, T + 1, n + layout.input_dim)), np.zeros((N, T, n))
    if start is not None:
        multiplier[:] = start
    status, iterations = np.empty(N, dtype=np.int64), np.empty(N, dtype=np.int64)
    problem = kernels.Problem(s_hat, weight, low, high, F, c, normal, offset, *limits.axes)
    kernels.nearest(problem, s, multiplier, status, iterations, TOLERANCE, ITERATIONS)
    return Nearest(layout.flatten(s[..., :n], s[:, :T, n:]), status, iterations, multiplier)


@cache
def compile_kernels() -> None:
    """Find one trajectory: machine code is made by the first call on a machine, which is not to be timed."""
    layout = TrajectoryLayout(2, 1, 2)
    A, B, c = np.tile(np.eye(2), (2, 1, 1)), np.ones((2, 2, 1)), np.zeros((2, 2))
    nearest(layout, np.ones((1, layout.size)), A, B, c, Limits.nothing(layout, 1))


def _by_time(layout: TrajectoryLayout, tau: np.ndarray, last: float) -> np.ndarray:
    """[x(t); u(t)] for t = 0..T, (N, T+1, n + m), with u(T) = `last`."""
    x, u = layout.split(tau)
    return np.concatenate([x, np.concatenate([u, np.full_like(u[:, :1], last)], axis=1)], axis=-1)

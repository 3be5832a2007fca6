"""The nearest trajectory that obeys the dynamics, stays within bounds and keeps clear of discs, for many plans at once.

    min  sum w (z - z_hat)^2 / 2     s.t.  x(t+1) = A(t) x(t) + B(t) u(t) + c(t),   low <= z <= high,
                                           normal(t)_k' p(t) >= offset(t)_k

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

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from dadiff.errors import ShapeError
from dadiff.trajectory.layout import TrajectoryLayout

TOLERANCE = 1e-10
"""Residual of the dynamics at which a plan counts as found, relative to 1 + its largest state."""

ITERATIONS = 60


class Status(IntEnum):
    """What became of one plan."""

    FOUND = 0
    NOT_CONVERGED = 1
    INFEASIBLE = 2  # proven by multipliers; what is close to feasible may end as NOT_CONVERGED


@dataclass(frozen=True)
class Limits:
    """What N plans must keep to; `nothing` leaves all free.

    Args:
        low, high: bounds on tau, (N, d) or (d,), infinite where there is none; equal where an entry is pinned.
        normal: of half-planes, (N, T+1, K, 2).
        offset: (N, T+1, K); -inf stands for no half-plane.
        axes: the two entries of the state that half-planes are about.
    """

    low: np.ndarray
    high: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    axes: tuple[int, int] = (0, 1)

    @classmethod
    def nothing(cls, layout: TrajectoryLayout, count: int) -> Limits:
        """No limits for `count` plans."""
        free = np.full((count, layout.size), np.inf)
        return cls(-free, free, np.zeros((count, layout.horizon + 1, 0, 2)), np.zeros((count, layout.horizon + 1, 0)))


@dataclass(frozen=True)
class Nearest:
    """What was found.

    Args:
        tau: (N, d); means something only where `status` is FOUND.
        status: `Status`, (N,).
        iterations: Newton steps, (N,).
        multiplier: lambda, (N, T, n), from which a neighbouring problem may start.
    """

    tau: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    multiplier: np.ndarray


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
        A, B, c: of every step, (T, n, n), (T, n, m), (T, n), or with a leading N.
        scale: (d,); distances are |(z - z_hat) / scale|, by default Euclidean.
        start: multipliers of a neighbouring problem, (N, T, n).

    Raises:
        ShapeError: if tau disagrees with the layout.
    """
    from dadiff.behaviours import clear_kernels as kernels

    layout.check(tau)
    if tau.ndim != 2:
        raise ShapeError(f"nearest: plans have shape {tau.shape}; expected (N, {layout.size})")
    N, T, n = len(tau), layout.horizon, layout.state_dim
    weight = np.broadcast_to(1.0 if scale is None else scale**-2.0, layout.size)
    x, u = (np.array(part, dtype=np.float64, order="C") for part in layout.split(tau))
    multiplier = np.zeros((N, T, n)) if start is None else np.array(start, dtype=np.float64, order="C")
    status, iterations = np.empty(N, dtype=np.int64), np.empty(N, dtype=np.int64)
    stages = [M if M.ndim == rank + 1 else M[None] for M, rank in ((A, 3), (B, 3), (c, 2))]
    bounds = [np.broadcast_to(bound, tau.shape) for bound in (limits.low, limits.high)]
    given = [*stages, *layout.split(weight), *(part for bound in bounds for part in layout.split(bound))]
    arrays = [np.ascontiguousarray(array, dtype=np.float64) for array in (*given, limits.normal, limits.offset)]
    kernels.nearest(x, u, kernels.Limited(*arrays), *limits.axes, multiplier, status, iterations, TOLERANCE, ITERATIONS)
    return Nearest(layout.flatten(x, u), status, iterations, multiplier)


def half_planes(positions: np.ndarray, centre: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each time and disc the half-plane that touches the disc on the side of the path: normals and offsets.

    Args:
        positions: (N, T+1, 2).
        centre: (N, O, 2).
        radius: (N, O); 0 stands for no disc.

    Returns:
        (N, T+1, O, 2) and (N, T+1, O). There are none at t = 0, and none for absent discs.
    """
    away = positions[:, :, None] - centre[:, None]
    normal = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
    offset = (normal * centre[:, None]).sum(axis=-1) + radius[:, None]
    offset[np.broadcast_to(radius[:, None] <= 0, offset.shape)] = -np.inf
    offset[:, 0] = -np.inf
    return normal, offset

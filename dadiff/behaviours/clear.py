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

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Projection, ProjectionInfo, check_shape
from dadiff.behaviours.sets import Dynamics
from dadiff.errors import NotApplicableError, ShapeError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import Layout, TrajectoryLayout

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
class Clear:
    """The trajectories of `dynamics` that keep clear of the discs of an environment.

    Args:
        dynamics: of one robot, whose first two states are a position.
        margin: by which discs are inflated, in metres.
        rounds: how often discs become half-planes, first about the estimate, then about what was found.
        discs: (x, y, radius, whether there is one) for each plan, (plans, O, 4); None before an environment is given.
    """

    dynamics: Dynamics
    margin: float = 0.03
    rounds: int = 2
    discs: np.ndarray | None = field(default=None, repr=False)

    @property
    def layout(self) -> TrajectoryLayout:
        """Of the trajectories."""
        return self.dynamics.layout

    @property
    def notes(self) -> dict[str, float]:
        """Of the dynamics."""
        return self.dynamics.notes

    def among(self, condition: Layout, E: np.ndarray) -> Clear:
        """The set for plans in environments E (plans, c).

        Raises:
            NotApplicableError: if E holds no obstacles, or there are several robots.
        """
        if "obstacles" not in condition or self.dynamics.robots:
            raise NotApplicableError(
                "projector known_clear: it needs one robot and a condition with discs; use task=obstacles, or another "
                "projector"
            )
        return replace(self, discs=condition.get(E, "obstacles"))

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Projection:
        """The projection onto the set, on the CPU whatever the device; without an environment, onto the dynamics."""
        if self.discs is None:
            return self.dynamics.bind(coordinates, pins, device)
        return ClearProjection(self, self.discs, coordinates or physical(self.layout), pins)


class ClearProjection(Projection):
    """Nearest trajectories clear of discs, which are half-planes about the estimate: local, as the set is not convex.

    Where an estimate is so far off that its half-planes contradict each other, it is projected onto the dynamics only,
    and counts as unconverged. So it belongs to the end of the chain, or to estimates that are plans already.

    Args:
        target: the set.
        discs: (plans, O, 4).
        where: the coordinates.
        pins: of the plans.
    """

    def __init__(self, target: Clear, discs: np.ndarray, where: Coordinates, pins: Sequence[Pin]) -> None:
        self._set, self._where, self._shape = target, where, (target.layout.size,)
        self._pinned = Pinned.of(pins, target.layout, ())
        self._centre, self._radius = discs[..., :2], np.where(discs[..., 3] > 0.5, discs[..., 2] + target.margin, 0.0)
        self._unlimited = target.dynamics.bind(where, pins)
        self.info = ProjectionInfo(self._unlimited.info.rank, "blocks")

    def __call__(
        self, tau: Array, metric: Covariance | None = None, start: Array | None = None, noise: Array | None = None
    ) -> Array:
        """The nearest trajectory found for each plan.

        Args:
            tau: (plans, d), in the coordinates that the set was bound in.
            metric: C in those coordinates, in which the dynamics are projected onto first; None is the identity.
            start, noise: of no use here.
        """
        check_shape(tau, self._shape)
        if not isinstance(tau, np.ndarray):
            return tau.new_tensor(self(tau.detach().cpu().numpy(), metric))
        reached = self._where.to_physical(self._unlimited(tau, metric))
        estimate = self._where.to_physical(tau) if metric is None else reached
        found, clear, steps = reached.copy(), np.zeros(len(tau), dtype=bool), 0
        for _ in range(self._set.rounds):
            result = self._nearest(estimate, found)
            clear = result.status == Status.FOUND
            found[clear], steps = result.tau[clear], max(steps, int(result.iterations.max(initial=0)))
        self.info = ProjectionInfo(self.info.rank, "blocks", steps, 0.0, int((~clear).sum()))
        return self._where.to_scaled(found)

    def _nearest(self, estimate: np.ndarray, about: np.ndarray) -> Nearest:
        """With half-planes about a path (plans, d), in physical units."""
        layout, stages, places = self._set.layout, self._set.dynamics.stages, self._pinned.places
        normal, offset = half_planes(layout.states(about)[..., :2], self._centre, self._radius)
        low, high = np.full(estimate.shape, -np.inf), np.full(estimate.shape, np.inf)
        low[:, places] = high[:, places] = self._pinned.values
        limits = Limits(low, high, normal, offset)
        return nearest(layout, estimate, stages.A, stages.B, stages.c, limits, self._where.scale)

    def on(self, device: str) -> ClearProjection:
        """Itself: it has nothing to move."""
        return self

    @property
    def affine(self) -> bool:
        """True: what is scaled may enter a disc."""
        return True

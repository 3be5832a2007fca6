"""`Limited`: the trajectories of a system that keep within bounds on states and inputs, and clear of discs.

The projection onto it is `dadiff.experts.nearest`: exact for linear dynamics and boxes. Discs become half-planes about
the estimate, and nonlinear dynamics are linearised along a plan (`dadiff.experts.limited_ilqr`); both are repeated.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import prod
from typing import cast

import numpy as np

from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Projection, ProjectionInfo, check_shape
from dadiff.behaviours.sets import Dynamics
from dadiff.errors import NotApplicableError
from dadiff.experts.limited_ilqr import MISSED, LimitedTracking, solve
from dadiff.experts.nearest import Limits, Status, compile_kernels, nearest, within
from dadiff.systems.system import Bounds
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import LEAST, Covariance
from dadiff.trajectory.layout import Layout, TrajectoryLayout


@dataclass(frozen=True)
class Limited:
    """The trajectories of `dynamics` within bounds and clear of the discs of an environment.

    Args:
        dynamics: without limits, linear or nonlinear.
        bounds: on states and inputs.
        margin: by which discs are inflated, in metres; None keeps clear of none.
        rounds: how often discs become half-planes, first about the estimate, then about what was found.
        discs: (x, y, radius, whether there is one) for each plan, (plans, O, 4); None before an environment is given.
    """

    dynamics: Dynamics | Manifold
    bounds: Bounds = field(default_factory=Bounds)
    margin: float | None = None
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

    def among(self, condition: Layout, E: np.ndarray) -> Limited:
        """The set for plans in environments E (plans, c); itself where it keeps clear of nothing.

        Raises:
            NotApplicableError: if E holds no obstacles, or there are several robots.
        """
        if self.margin is None:
            return self
        if "obstacles" not in condition or self.dynamics.robots:
            raise NotApplicableError(
                "projector known_clear: it needs one robot and a condition with discs; use task=obstacles, or another "
                "projector"
            )
        return replace(self, discs=condition.get(E, "obstacles"))

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Projection:
        """The projection onto the set, on the CPU whatever the device. Pins hold beyond the bounds."""
        kind = AlongDynamics if isinstance(self.dynamics, Dynamics) else AlongManifold
        return kind(self, coordinates or physical(self.layout), pins)


class LimitedProjection(Projection):
    """The nearest trajectories within limits; local where the set is not convex: among discs, on nonlinear dynamics.

    In the metric of a covariance C the dynamics are projected onto in C first, and what that gives is brought within
    limits in the metric of the variances of C. Where nothing was found within limits, `info` counts the plan.

    Args:
        target: the set.
        where: the coordinates.
        pins: of the plans.
    """

    def __init__(self, target: Limited, where: Coordinates, pins: Sequence[Pin]) -> None:
        self._set, self._where = target, where
        self._pinned = Pinned.of(pins, target.layout, target.dynamics.robots)
        self._shape = (*target.dynamics.robots, target.layout.size)
        self._unlimited = target.dynamics.bind(where, pins)
        self.info = ProjectionInfo(self._unlimited.info.rank, "limited")
        compile_kernels()

    def __call__(
        self, tau: Array, metric: Covariance | None = None, start: Array | None = None, noise: Array | None = None
    ) -> Array:
        """The nearest trajectory within limits that was found for each plan.

        Args:
            tau: (*robots, plans..., d), in the coordinates that the set was bound in.
            metric: C in those coordinates; None is the identity.
            start: trajectories of the system, shaped as tau, along which nonlinear dynamics are linearised first.
            noise: of no use here.
        """
        check_shape(tau, self._shape)
        if not isinstance(tau, np.ndarray):
            begin = None if start is None else start.detach().cpu().numpy()
            return tau.new_tensor(self(tau.detach().cpu().numpy(), metric, begin))
        where, reached = self._where, tau if metric is None else self._unlimited(tau, metric, start)
        along = start if metric is None else reached
        begin = None if along is None else self._flat(along)
        found = self._nearest(self._flat(reached), where.scale * _deviations(metric), begin)
        return where.to_scaled(found.reshape(tau.shape))

    def _flat(self, z: np.ndarray) -> np.ndarray:
        """(*robots, plans, d) in physical units."""
        return self._where.to_physical(z).reshape(*self._shape[:-1], -1, self._shape[-1])

    @abstractmethod
    def _nearest(self, aim: np.ndarray, scale: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        """Within limits, nearest to aim (*robots, plans, d) with distances in units of scale."""

    @property
    def unlimited(self) -> Projection:
        """The projection onto the dynamics alone."""
        return self._unlimited

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) of plans, each (d,), in the coordinates that the set was bound in; pins have none."""
        low, high = (bound.copy() for bound in within(self._set.layout, self._set.bounds))
        low[self._pinned.places], high[self._pinned.places] = -np.inf, np.inf
        return self._where.to_scaled(low), self._where.to_scaled(high)

    def on(self, device: str) -> LimitedProjection:
        """Itself: it has nothing to move."""
        return self

    @property
    def affine(self) -> bool:
        """True: what is scaled may leave the set."""
        return True

    def _limits(self, lead: tuple[int, ...]) -> Limits:
        """Bounds and pins of plans (*robots, plans), one after the other."""
        places, count = self._pinned.places, prod(lead)
        values = np.broadcast_to(self._pinned.values, (*lead, len(places))).reshape(count, len(places))
        return Limits.of(self._set.layout, count, self._set.bounds).pinned(places, values)

    def _clear_of_discs(self, limits: Limits, about: np.ndarray) -> Limits:
        """With half-planes about paths (plans, d)."""
        discs, margin = self._set.discs, self._set.margin
        if discs is None or margin is None:
            return limits
        radius = np.where(discs[..., 3] > 0.5, discs[..., 2] + margin, 0.0)
        return limits.clear_of(self._set.layout.states(about)[..., :2], discs[..., :2], radius)

    @property
    def _rounds(self) -> int:
        return 1 if self._set.discs is None else self._set.rounds

    def _observe(self, exceeded: np.ndarray, found: np.ndarray, steps: int, infeasible: int = 0) -> None:
        """Say how far plans (N,) are from the set, and how many did not reach it."""
        residual = float(np.max(exceeded[np.isfinite(exceeded)], initial=0.0))
        self.info = ProjectionInfo(self.info.rank, "limited", steps, residual, int((~found).sum()), infeasible)


class AlongDynamics(LimitedProjection):
    """Onto linear dynamics within limits. A plan for which there is nothing within is projected onto the dynamics."""

    def _nearest(self, aim: np.ndarray, scale: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        dynamics = cast(Dynamics, self._set.dynamics)
        layout, stages = dynamics.layout, dynamics.stages
        without = self._where.to_physical(self._unlimited(self._where.to_scaled(aim))).reshape(-1, layout.size)
        flat, found, limits = aim.reshape(-1, layout.size), without.copy(), self._limits(aim.shape[:-1])
        A, B, c = (M.reshape(-1, *M.shape[len(dynamics.robots) :]) for M in (stages.A, stages.B, stages.c))
        for _ in range(self._rounds):
            around = self._clear_of_discs(limits, found)
            result = nearest(layout, flat, A, B, c, around, scale.reshape(-1, layout.size))
            found[result.found] = result.tau[result.found]
        exceeded = around.exceeded(layout, found)
        infeasible = int((result.status == Status.INFEASIBLE).sum())
        self._observe(exceeded, result.found, int(result.iterations.max(initial=0)), infeasible)
        return found


class AlongManifold(LimitedProjection):
    """Onto nonlinear dynamics within limits, by sweeps; every plan obeys the dynamics and the bounds on inputs."""

    def _nearest(self, aim: np.ndarray, scale: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        manifold, tau = cast(Manifold, self._set.dynamics), aim if start is None else start
        limits, count = self._limits(aim.shape[:-1]), 0
        for _ in range(self._rounds):
            around = self._clear_of_discs(limits, tau.reshape(-1, manifold.layout.size))
            problem = LimitedTracking(manifold.system, manifold.layout, aim, scale, around)
            solution = solve(problem, tau, sweeps=manifold.sweeps)
            tau, count = solution.tau, count + int(solution.sweeps.max(initial=0))
        self._observe(problem.exceeded(tau), problem.within(tau), count)
        return tau


@dataclass(frozen=True)
class Clipped(Limited):
    """What robots do about bounds that nobody thought of: plans of the dynamics whose entries are clipped.

    Args:
        replay: clip inputs only, and recompute the states, which may then exceed their bounds.
    """

    replay: bool = field(default=False, kw_only=True)

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Projection:
        """The map onto the dynamics and then between the bounds; it is no projection."""
        return ClippedProjection(self, coordinates or physical(self.layout), pins)


class ClippedProjection(LimitedProjection):
    """See `Clipped`."""

    def _nearest(self, aim: np.ndarray, scale: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        target, where = cast(Clipped, self._set), self._where
        layout, limits = target.layout, self._limits(aim.shape[:-1])
        begin = None if start is None else where.to_scaled(start)
        tau = where.to_physical(self._unlimited(where.to_scaled(aim), None, begin))
        clipped = limits.clip(tau.reshape(-1, layout.size)).reshape(tau.shape)
        if target.replay:
            dynamics, inputs = target.dynamics, layout.inputs(clipped)
            by = dynamics.stages if isinstance(dynamics, Dynamics) else dynamics.system
            clipped = layout.flatten(by.simulate(layout.states(clipped)[..., 0, :], inputs), inputs)
        exceeded = limits.exceeded(layout, clipped.reshape(-1, layout.size))
        self._observe(exceeded, exceeded <= MISSED * (1 + np.abs(clipped).max()), 1)
        return clipped


def _deviations(metric: Covariance | None) -> np.ndarray:
    """The roots of the diagonal of C, (..., d), where certain entries are given the least; 1 for the identity."""
    if metric is None:
        return np.ones(1)
    variances = metric.diagonal + np.square(metric.factor).sum(axis=-1)
    return np.sqrt(np.maximum(variances, LEAST * variances.mean(axis=-1, keepdims=True)))

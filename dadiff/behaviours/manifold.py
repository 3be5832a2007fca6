"""`Manifold`: the trajectories of a nonlinear system, and the projection onto them by sweeps of LQR tracking.

    argmin |tau - tau_hat|^2_C   s.t.  x(t+1) = f_t(x(t), u(t)),  pins

is to track tau_hat (`dadiff.experts.ilqr`): one Gauss-Newton sweep linearises along a plan, solves the LQR problem
backwards and rolls the system out under its gains, so that plans are feasible after every sweep. Along a reverse chain
one sweep for each step is enough: the estimates become feasible themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Projection, ProjectionInfo, check_shape
from dadiff.behaviours.sets import identity
from dadiff.errors import ConfigError
from dadiff.experts.ilqr import Metric, Solution, Tracking, solve
from dadiff.systems import System
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout


@dataclass(frozen=True)
class Manifold:
    """The trajectories of x(t+1) = f_t(x(t), u(t)).

    Args:
        system: of `robots` robots.
        sweeps: Gauss-Newton sweeps for each projection, at most.
        notes: see `TrajectorySet`.
    """

    layout: TrajectoryLayout
    system: System
    sweeps: int = 1
    notes: dict[str, float] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        if self.sweeps < 1:
            raise ConfigError(f"projector: sweeps is {self.sweeps}; at least one is needed")

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the system."""
        return self.system.robots

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Tracker:
        """The projection onto the set, nearest in the given coordinates; it computes on the CPU, whatever the device.

        Raises:
            ConfigError: if some entries of x(0) are pinned and others not.
        """
        return Tracker(self, coordinates or physical(self.layout), Pinned.of(pins, self.layout, self.robots))


class Tracker(Projection):
    """The projection onto a `Manifold`, see `Projection`.

    Args:
        target: the set.
        where: the coordinates.
        pinned: places and values of the pins.
    """

    def __init__(self, target: Manifold, where: Coordinates, pinned: Pinned) -> None:
        self._set, self._where = target, where
        self._shape = (*target.robots, target.layout.size)
        self._x_init, self._pins = _starts_and_others(target.layout, pinned)
        self.info = ProjectionInfo(target.layout.rank - len(pinned.places), "manifold")

    def __call__(
        self,
        tau: Array,
        metric: Covariance | None = None,
        start: Array | None = None,
        noise: Array | None = None,
    ) -> Array:
        """The trajectory of the system nearest to tau, as near as its sweeps come.

        Args:
            tau: (*robots, plans..., d), in the coordinates that the set was bound in.
            metric: C in those coordinates, the same for all robots; None is the identity.
            start: trajectories of the system to start from, shaped as tau; None linearises along tau itself first.
            noise: of no use here, since known dynamics leave no residual.
        """
        check_shape(tau, self._shape)
        if not isinstance(tau, np.ndarray):
            given = (None if value is None else value.detach().cpu().numpy() for value in (start, noise))
            return tau.new_tensor(self(tau.detach().cpu().numpy(), metric, *given))
        lead = (*self._shape[:-1], -1, tau.shape[-1])
        given = (None if value is None else value.reshape(lead) for value in (start, noise))
        return self._project(tau.reshape(lead), metric, *given).reshape(tau.shape)

    def _project(
        self, z: np.ndarray, metric: Covariance | None, start: np.ndarray | None, noise: np.ndarray | None
    ) -> np.ndarray:
        """As `__call__`, of plans (*robots, plans, d) along one dimension."""
        where, layout = self._where, self._set.layout
        problem = self._problem(where.to_physical(z), metric_of(metric or identity(layout), layout, where))
        begin = None if start is None else where.to_physical(start)
        solution = solve(problem, begin, sweeps=self._set.sweeps)
        self.info = self._observed(problem, solution)
        return where.to_scaled(solution.tau)

    def on(self, device: str) -> Tracker:
        """Itself: it has nothing to move."""
        return self

    @property
    def affine(self) -> bool:
        """True: nonlinear dynamics are no subspace, and a scaled trajectory is none of theirs."""
        return True

    def _problem(self, reference: np.ndarray, metric: Metric) -> Tracking:
        lead = reference.shape[:-1]
        x_init = None if self._x_init is None else np.broadcast_to(self._x_init, (*lead, self._x_init.shape[-1]))
        pins = self._pins and (self._pins[0], np.broadcast_to(self._pins[1], (*lead, len(self._pins[0]))))
        return Tracking(self._set.system, metric, reference, x_init, pins)

    def _observed(self, problem: Tracking, solution: Solution) -> ProjectionInfo:
        """Plans that left float range or miss their pins have not reached the set."""
        missed = problem.violation(solution.tau)
        size = 1 + np.abs(problem.pins[1]).sum(axis=-1) if problem.pins else 1.0
        there = np.isfinite(solution.cost) & (missed <= 1e-6 * size)
        residual = float(np.max(missed[np.isfinite(missed)], initial=0.0))
        iterations = int(solution.sweeps.max(initial=0))
        return ProjectionInfo(self.info.rank, "manifold", iterations, residual, int((~there).sum()))


def metric_of(covariance: Covariance, layout: TrajectoryLayout, where: Coordinates) -> Metric:
    """C^-1 in physical units from C in scaled coordinates.

    Raises:
        ConfigError: if robots have covariances of their own.
    """
    if covariance.diagonal.ndim > 1:
        raise ConfigError(
            f"projection: the covariance is one of {covariance.diagonal.shape[0]} robots; nonlinear dynamics are "
            "projected onto in one metric for all"
        )
    spread = covariance.invertible.rescaled(where.scale)
    return Metric.diagonal(layout, spread.diagonal, spread.factor)


def _starts_and_others(
    layout: TrajectoryLayout, pinned: Pinned
) -> tuple[np.ndarray | None, tuple[np.ndarray, np.ndarray] | None]:
    """x(0) where it is pinned, and the pins of other entries."""
    first = np.isin(pinned.places, np.arange(layout.size)[layout.initial_state])
    if first.sum() not in (0, layout.state_dim):
        raise ConfigError(
            f"projection: {first.sum()} of the {layout.state_dim} entries of x(0) are pinned; for nonlinear dynamics "
            "pin all of them or none"
        )
    order = np.flatnonzero(first)[np.argsort(pinned.places[first])]
    others = pinned.places[~first], pinned.values[..., ~first]
    return (pinned.values[..., order] if len(order) else None), (others if len(others[0]) else None)

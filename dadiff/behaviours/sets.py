"""Sets of trajectories: what a projector says is admissible, in physical units.

A set is found once. `bind` gives the projection onto it in some coordinates, with the entries that are pinned for each
plan; what does not depend on the pins' values is computed once for the set.

    Dynamics   G tau = g with the stages of x(t+1) = A_t x(t) + B_t u(t) + c_t
    Uncertain  G tau = g + r with r ~ N(0, R): dynamics that are known up to what data leave open
    Span       { origin + basis h : h in R^r }
    Rollout    keeps the inputs and recomputes the states: an oblique projection
    Everything all trajectories: only the pins are held
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, Protocol

import numpy as np

from dadiff.behaviours.forms import Blocks, Hold, Rows, in_metric, onto_rows, onto_span
from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import AffineMap, Geometry, Projection
from dadiff.behaviours.stages import Stages
from dadiff.errors import ConfigError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import column_basis, largest_angle, null_space, projector_distance

InitialState = Literal["free", "fixed"]

DENSE_UP_TO = 600
"""The size d up to which dynamics are projected onto by dense matrices, beyond it by recursion; measured."""

COMPARED_UP_TO = 1000
"""The size d up to which a learned set is compared with the true one: that takes O(d^3)."""


class TrajectorySet(Protocol):
    """What a projector's `fit` returns."""

    @property
    def layout(self) -> TrajectoryLayout:
        """Of the trajectories."""
        ...

    @property
    def notes(self) -> dict[str, float]:
        """What the projector can say of the set, by name."""
        ...

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Projection:
        """The projection onto the set."""
        ...


@dataclass(frozen=True)
class AffineSet(ABC):
    """What the sets share: binding, with one geometry for each choice of coordinates and places of pins.

    Args:
        layout: of the trajectories.
        notes: what the projector can say of the set, by name: rank, singular-value gap.
    """

    layout: TrajectoryLayout
    notes: dict[str, float] = field(default_factory=dict, kw_only=True)
    _geometries: dict[object, Geometry] = field(
        default_factory=dict, init=False, repr=False, compare=False, kw_only=True
    )

    @property
    @abstractmethod
    def robots(self) -> tuple[int, ...]:
        """Leading dimensions: () for one system."""

    @abstractmethod
    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """The set in some coordinates with pins at some places."""

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> Projection:
        """The projection onto the set, in the given coordinates.

        Args:
            coordinates: where it acts; None for physical units.
            pins: entries of tau that are given for each plan.
            device: where torch finds its matrices at once; otherwise they go there at the first call.
        """
        where = coordinates or physical(self.layout)
        pinned = Pinned.of(pins, self.layout, self.robots)
        key = (where.mean.tobytes(), where.scale.tobytes(), pinned.places.tobytes())
        if key not in self._geometries:
            self._geometries[key] = self.geometry(where, pinned.places)
        projection = Projection(self._geometries[key], (*self.robots, self.layout.size), pinned)
        return projection if device is None else projection.on(device)

    def directions(self, places: np.ndarray) -> np.ndarray:
        """Orthonormal basis (*robots, d, r) of the differences of trajectories that share their pinned entries.

        Raises:
            ConfigError: if the set has none, since it is no subspace.
        """
        raise ConfigError(f"projector: the trajectories of {type(self).__name__} are no subspace, and have no basis")


def identity(layout: TrajectoryLayout) -> Covariance:
    """C = I."""
    return Covariance.diagonal_of(np.ones(layout.size))


@dataclass(frozen=True)
class Dynamics(AffineSet):
    """The trajectories of x(t+1) = A_t x(t) + B_t u(t) + c_t.

    Args:
        stages: A_t, B_t, c_t.
    """

    stages: Stages

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the stages."""
        return self.stages.robots

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """Dense up to d = DENSE_UP_TO, by recursion beyond."""
        rank = self.layout.rank - len(places)
        if self.layout.size > DENSE_UP_TO:
            weighted = partial(Blocks.of, self.layout, self.stages, places=places, where=where)
            return Geometry(rank, "blocks", partial(weighted, identity(self.layout)), weighted)
        rows = Rows(*self.stages.matrix(self.layout)).scaled(where)
        return Geometry(
            rank, "dense", partial(onto_rows, rows, places, where), partial(in_metric, rows, places=places, where=where)
        )

    def directions(self, places: np.ndarray) -> np.ndarray:
        """The kernel of G without the pinned columns."""
        return onto_rows(Rows(*self.stages.matrix(self.layout)), places, physical(self.layout)).matrix


@dataclass(frozen=True)
class Uncertain(Dynamics):
    """Estimated dynamics, trusted in each direction by how well it is known: G tau = g + r with r ~ N(0, R).

    Its projection is a Kalman update, tau - C G' (G C G' + R)^-1 (G tau - g), which weighs C against R: C must be a
    covariance in earnest. It is no projection onto a set: applied twice it moves twice.

    Args:
        spread: V of shape (*robots, nT, q) with R = V V', stage by stage.
    """

    spread: np.ndarray = field(repr=False)

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """As `Dynamics.geometry`."""
        rank = self.layout.rank - len(places)
        if self.layout.size > DENSE_UP_TO:
            weighted = partial(Blocks.of, self.layout, self.stages, places=places, where=where, noise=self.spread)
            return Geometry(rank, "blocks", partial(weighted, identity(self.layout)), weighted)
        rows = Rows(*self.stages.matrix(self.layout), self.spread).scaled(where)
        dense = partial(in_metric, rows, places=places, where=where)
        return Geometry(rank, "dense", partial(dense, identity(self.layout)), dense)


@dataclass(frozen=True)
class Span(AffineSet):
    """{ origin + basis h : h in R^r } in physical units.

    Args:
        basis: (*robots, d, r), of full column rank.
        origin: (*robots, d), or None for 0.
    """

    basis: np.ndarray = field(repr=False)
    origin: np.ndarray | None = field(default=None, repr=False)

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the basis."""
        return self.basis.shape[:-2]

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """Dense."""
        Q = column_basis(self.basis / where.scale[:, None])
        origin = np.zeros(self.basis.shape[:-1]) if self.origin is None else self.origin
        origin = (origin - where.mean) / where.scale

        def weighted(metric: Covariance) -> AffineMap:
            G = null_space(Q.swapaxes(-1, -2)).swapaxes(-1, -2)
            return in_metric(Rows(G, (G @ origin[..., None])[..., 0]), metric, places, where)

        rank = self.basis.shape[-1] - len(places)
        return Geometry(rank, "dense", partial(onto_span, Q, origin, places, where), weighted)

    def directions(self, places: np.ndarray) -> np.ndarray:
        """The basis, made orthonormal, without what the pins fix."""
        origin = np.zeros(self.basis.shape[:-1])
        return onto_span(column_basis(self.basis), origin, places, physical(self.layout)).matrix


@dataclass(frozen=True)
class Everything(AffineSet):
    """All trajectories: a projection only holds the pins."""

    @property
    def robots(self) -> tuple[int, ...]:
        """None: the same for all."""
        return ()

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """Without matrices."""
        weighted = partial(Hold.of, places=places, where=where)
        return Geometry(self.layout.size - len(places), "blocks", partial(weighted, identity(self.layout)), weighted)


@dataclass(frozen=True)
class RolledOut:
    """tau -> [simulated states; the inputs], from x(0) as pinned. See `Rollout`."""

    layout: TrajectoryLayout
    stages: Stages
    scale: np.ndarray = field(repr=False)
    mean: np.ndarray = field(repr=False)

    def given(self, values: np.ndarray) -> np.ndarray:
        """x(0) itself."""
        return values

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """See `Form`."""
        inputs = self.layout.inputs(z * self.scale + self.mean)
        x_init = given + 0 * inputs[..., 0, :1]  # one for each plan
        tau = self.layout.flatten(self.stages.simulate(x_init, inputs), inputs)
        return (tau - self.mean) / self.scale


@dataclass(frozen=True)
class Rollout(AffineSet):
    """Keeps the inputs and recomputes the states from x_init: tau -> F [x_init; u]. An oblique projection.

    Args:
        stages: A_t, B_t, c_t.
    """

    stages: Stages

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the stages."""
        return self.stages.robots

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """By recursion, in every metric alike.

        Raises:
            ConfigError: unless exactly x(0) is pinned.
        """
        if places.tolist() != list(range(self.layout.size))[self.layout.initial_state]:
            raise ConfigError("projector: a roll-out starts at x(0): pin x(0) (Pin.initial_state), and nothing else")
        form = RolledOut(self.layout, self.stages, where.scale, where.mean)
        return Geometry(self.layout.rank - self.layout.state_dim, "blocks", lambda: form, lambda _: form)


def compared(learned: TrajectorySet, truth: TrajectorySet, pins: Sequence[Pin] = ()) -> dict[str, float]:
    """How far a learned set is from the true one: largest principal angle and distance, means over robots.

    Of what shares its pinned entries. Nothing is said of sets that are no subspaces or larger than d = COMPARED_UP_TO.
    """
    if not (isinstance(learned, AffineSet) and isinstance(truth, AffineSet)) or truth.layout.size > COMPARED_UP_TO:
        return {}
    places = Pinned.of(pins, truth.layout, truth.robots).places
    U, V = learned.directions(places), truth.directions(places)
    return {
        "principal_angle": float(np.mean(largest_angle(U, V))),
        "projector_distance": float(np.mean(projector_distance(U, V))),
    }

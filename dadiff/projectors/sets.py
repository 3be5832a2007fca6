"""Admissible sets and the maps that enforce them.

A projector learns, from (A, B) or from a recording, the set of trajectories that it takes for admissible.
The set is found once, in physical units; binding it to coordinates and cases gives a `Projection`, the cheap step
that the sampler repeats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError, ExcitationError, ShapeError
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.layout import Array, TrajectoryLayout
from dadiff.trajectory.subspace import column_basis, null_space, numerical_rank

InitialState = Literal["free", "fixed"]


@dataclass(frozen=True)
class Projection:
    """z -> offset + synthesis analysis' z, for a batch of cases.

    Orthogonal if analysis = synthesis; `rollout` is the oblique case.

    Args:
        analysis: (*robots, d, r), or the slice of z that it selects.
        synthesis: (*robots, d, r).
        offset: (*robots, 1, d) for all plans of a robot, or (*robots, plans, d) with one a plan.
    """

    analysis: Array | slice = field(repr=False)
    synthesis: Array = field(repr=False)
    offset: Array = field(repr=False)

    def __call__(self, z: Array) -> Array:
        """Project z (*robots, ..., d); numpy with numpy, torch with torch. All plans of a robot go in one product."""
        *robots, d, _ = self.synthesis.shape
        if (*z.shape[: len(robots)], z.shape[-1]) != (*robots, d):
            raise ShapeError(
                f"projection: made for trajectories of shape {(*robots, '...', d)} (robots first), found "
                f"{tuple(z.shape)}; build the projector from these robots' systems or recordings"
            )
        flat = z.reshape(*robots, -1, d)
        g = flat[..., self.analysis] if isinstance(self.analysis, slice) else flat @ self.analysis
        image = g @ self.synthesis.swapaxes(-1, -2) + self.offset
        return image.reshape(z.shape)

    def map(self, convert: Callable[[np.ndarray], Array]) -> Projection:
        """The same projection with converted arrays, for example torch tensors on a device."""
        analysis, synthesis = self.analysis, convert(self.synthesis)
        if analysis is self.synthesis:
            analysis = synthesis
        elif not isinstance(analysis, slice):
            analysis = convert(analysis)
        return Projection(analysis, synthesis, convert(self.offset))


@dataclass(frozen=True)
class AdmissibleSet:
    """{ lift x_init + basis g : g in R^r } in physical units.

    Args:
        layout: of the trajectories.
        basis: (*robots, d, r) with orthonormal columns.
        lift: (*robots, d, n), or None where x(0) is free.
        notes: what the projector can say of the set, by name: rank, singular-value gap.
    """

    layout: TrajectoryLayout
    basis: np.ndarray = field(repr=False)
    lift: np.ndarray | None = field(default=None, repr=False)
    notes: dict[str, float] = field(default_factory=dict)

    def starting(self, initial_state: InitialState) -> AdmissibleSet:
        """The set itself (`free`), or its trajectories with x(0) = x_init for each case (`fixed`).

        With v = basis g and E_0 the rows of x(0): g = (E_0 basis)^† x_init + N h, N the kernel of E_0 basis.

        Raises:
            ExcitationError: if the set does not reach every x(0).
        """
        if initial_state == "free":
            return self
        start = self.basis[..., self.layout.initial_state, :]
        if (rank := numerical_rank(start)) < self.layout.state_dim:
            raise ExcitationError(
                f"projector: the initial states of the set span {rank} of {self.layout.state_dim} dimensions, so x(0) "
                "cannot be fixed; use initial_state: free or a recording that excites every state"
            )
        lift = self.basis @ np.linalg.pinv(start)
        return replace(self, basis=self.basis @ null_space(start), lift=lift)

    def projection(self, coordinates: Coordinates | None = None, x_init: np.ndarray | None = None) -> Projection:
        """The orthogonal projection onto the set, in the given coordinates.

        Args:
            coordinates: where it acts; None for physical units.
            x_init: (*robots, plans..., n), one for each plan; needed where x(0) is fixed.
        """
        where = coordinates or physical(self.layout)
        Q = column_basis(self.basis / where.scale[:, None])
        origin = np.zeros((1, self.layout.size)) if self.lift is None else _starting_at(x_init, self.lift)
        linear = Projection(Q, Q, np.zeros((1, self.layout.size)))
        centre = np.broadcast_to(where.to_scaled(origin), (*Q.shape[:-2], *origin.shape[-2:]))
        return replace(linear, offset=centre - linear(centre))


@dataclass(frozen=True)
class Rollout:
    """Keeps the inputs and recomputes the states from x_init: tau -> F [x_init; u]. An oblique projection.

    Args:
        layout: of the trajectories.
        F: trajectory map (*robots, d, n + mT).
        notes: as for `AdmissibleSet`.
    """

    layout: TrajectoryLayout
    F: np.ndarray = field(repr=False)
    notes: dict[str, float] = field(default_factory=dict)

    def projection(self, coordinates: Coordinates | None = None, x_init: np.ndarray | None = None) -> Projection:
        """As `AdmissibleSet.projection`."""
        where, inputs = coordinates or physical(self.layout), self.layout.all_inputs
        free, forced = np.split(self.F, [self.layout.state_dim], axis=-1)
        synthesis = forced * where.scale[inputs] / where.scale[:, None]
        mean = (forced @ where.mean[inputs])[..., None, :]
        return Projection(inputs, synthesis, where.to_scaled(_starting_at(x_init, free) + mean))


def _starting_at(x_init: np.ndarray | None, lift: np.ndarray) -> np.ndarray:
    """lift x_init of shape (*robots, plans, d)."""
    if x_init is None:
        raise ConfigError("projector: x(0) is fixed, so projection(...) needs x_init, one for each plan")
    flat = x_init.reshape(*lift.shape[:-2], -1, x_init.shape[-1])
    return flat @ lift.swapaxes(-1, -2)

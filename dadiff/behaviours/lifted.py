"""Koopman's view: dynamics that are linear in observables, fitted by extended dynamic mode decomposition (EDMD).

    psi(x(t+1)) = K psi(x(t)) + B u(t),    x = psi_{1..n}

(Williams, Kevrekidis & Rowley 2015; with inputs Korda & Mezic 2018.) Lifted once, at x(0), and never again:
trajectories from one x(0) are an affine set in the inputs, whose offset is nonlinear in x(0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Projection, ProjectionInfo, check_shape
from dadiff.behaviours.stages import transposed
from dadiff.errors import ConfigError
from dadiff.systems.features import Features
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.response import along
from dadiff.trajectory.subspace import semidefinite_inverse


@dataclass(frozen=True)
class Lifted:
    """The trajectories of dynamics that are linear in observables.

    Args:
        observables: psi, with the states themselves first; of states alone.
        K: (*robots, p, p), B: (*robots, p, m).
        notes: see `TrajectorySet`.
    """

    layout: TrajectoryLayout
    observables: Features
    K: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    notes: dict[str, float] = field(default_factory=dict, kw_only=True)

    @property
    def robots(self) -> tuple[int, ...]:
        """Of K."""
        return self.K.shape[:-2]

    def lift(self, x: np.ndarray) -> np.ndarray:
        """psi (..., p) of x (..., n)."""
        return self.observables(x, np.zeros((*x.shape[:-1], 0)))

    def simulate(self, x_init: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """States (*robots, plans, T+1, n) from x(0) (*robots, plans, n) and inputs (*robots, plans, T, m)."""
        z, n = self.lift(x_init), self.layout.state_dim
        states = [x_init]
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(inputs.shape[-2]):
                z = along(self.K, z) + along(self.B, inputs[..., t, :])
                states.append(z[..., :n])
        return np.stack(states, axis=-2)

    def rows(self) -> np.ndarray:
        """G of shape (*robots, n(T+1), d): x(0), and x(t) less what the inputs add; G tau follows from x(0) alone."""
        layout = self.layout
        unit = np.broadcast_to(np.eye(layout.size), (*self.robots, layout.size, layout.size))
        states, inputs = layout.split(unit)
        forced = self._forced(inputs)
        return transposed((states - forced).reshape(*self.robots, layout.size, -1))

    def free(self, x_init: np.ndarray) -> np.ndarray:
        """G tau of trajectories from x(0) (*robots, plans, n), (*robots, plans, n(T+1))."""
        still = np.zeros((*x_init.shape[:-1], self.layout.horizon, self.layout.input_dim))
        return self.simulate(x_init, still).reshape(*x_init.shape[:-1], -1)

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> LiftedProjection:
        """The projection onto the trajectories from each plan's x(0), nearest in the given coordinates.

        Raises:
            ConfigError: unless exactly x(0) is pinned.
        """
        pinned = Pinned.of(pins, self.layout, self.robots)
        if pinned.places.tolist() != list(range(self.layout.size))[self.layout.initial_state]:
            raise ConfigError("projector koopman: observables are lifted at x(0): pin x(0), and nothing else")
        return LiftedProjection(self, coordinates or physical(self.layout), pinned)

    def _forced(self, inputs: np.ndarray) -> np.ndarray:
        """What inputs (*robots, ..., T, m) add to the states, (*robots, ..., T+1, n)."""
        z = np.zeros((*inputs.shape[:-2], self.K.shape[-1]))
        states = [z[..., : self.layout.state_dim]]
        for t in range(inputs.shape[-2]):
            z = along(self.K, z) + along(self.B, inputs[..., t, :])
            states.append(z[..., : self.layout.state_dim])
        return np.stack(states, axis=-2)


class LiftedProjection(Projection):
    """tau - C G' (G C G')^+ (G tau - g), g being each plan's own. See `Projection` and `Lifted`.

    Args:
        target: the set.
        where: the coordinates.
        pinned: x(0) of each plan.
    """

    def __init__(self, target: Lifted, where: Coordinates, pinned: Pinned) -> None:
        self._where, self._shape = where, (*target.robots, target.layout.size)
        self._rows, self._right = target.rows(), target.free(pinned.values)
        self._gains: WeakKeyDictionary[Covariance, np.ndarray] = WeakKeyDictionary()
        self._identity = Covariance.diagonal_of(np.ones(target.layout.size))
        self.info = ProjectionInfo(target.layout.rank - target.layout.state_dim, "dense")

    def __call__(
        self,
        tau: Array,
        metric: Covariance | None = None,
        start: Array | None = None,
        noise: Array | None = None,
    ) -> Array:
        """See `Projection`; nothing is gained by a start, and there is no residual to draw."""
        check_shape(tau, self._shape)
        if not isinstance(tau, np.ndarray):
            return tau.new_tensor(self(tau.detach().cpu().numpy(), metric))
        plans = self._where.to_physical(tau).reshape(*self._shape[:-1], -1, tau.shape[-1])
        residual = plans @ transposed(self._rows) - self._right
        moved = plans - residual @ transposed(self._gain(metric or self._identity))
        return self._where.to_scaled(moved).reshape(tau.shape)

    def on(self, device: str) -> LiftedProjection:
        """Itself: it computes on the CPU."""
        return self

    @property
    def affine(self) -> bool:
        """True: x(0) is pinned."""
        return True

    def _gain(self, metric: Covariance) -> np.ndarray:
        """C G' (G C G')^+ in physical units, (*robots, d, n(T+1)), once for each metric."""
        if metric not in self._gains:
            C_G = transposed(metric.rescaled(self._where.scale).times(self._rows))
            self._gains[metric] = C_G @ semidefinite_inverse(self._rows @ C_G)
        return self._gains[metric]

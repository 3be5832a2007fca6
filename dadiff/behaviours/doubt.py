"""Dynamics that are known up to a covariance of their matrices, held against each plan as it is.

With theta = [A B c]' ~ N(theta_hat, L L') the residual of a plan that the robot can follow is

    G tau - g = V(tau) e,    V(tau)_t = phi(t)' L,    phi = [x; u; 1],    e ~ N(0, I),

the same e at all times: it spans as many directions as theta has numbers, not all nT of them. So every plan is
corrected as if the dynamics that explain it best were known, while the covariance averaged over demonstrations
(`dadiff.behaviours.Uncertain`) lets each time err for itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from dadiff.behaviours.forms import Blocks, Hold, Rows
from dadiff.behaviours.manifold import Manifold, Tracker
from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Geometry
from dadiff.behaviours.sets import Dynamics, identity
from dadiff.behaviours.stages import Stages
from dadiff.errors import NotApplicableError
from dadiff.systems.features import Regressed
from dadiff.trajectory.arrays import Array, join, solve
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import semidefinite_inverse

DOUBTED_UP_TO = 1500
"""The size d up to which plans are held against doubted dynamics: that takes dense matrices."""

AT_ONCE = 128
"""Plans whose doubted nonlinear dynamics are in memory at a time."""

ROUNDS = 2
"""How often V is taken at the corrected plan: first at the plan as it comes."""


@dataclass(frozen=True)
class Doubted(Dynamics):
    """The trajectories of dynamics whose matrices are known up to N(theta_hat, L L').

    Its projection is tau - C G' (G C G' + V V')^-1 (G tau - g) with V = V(tau'), tau' the corrected plan. Like that of
    `Uncertain` it is no projection onto a set.

    Args:
        root: L of shape (*robots, p, n, k), p = n + m, and one more where c is doubted, too.
    """

    root: np.ndarray = field(repr=False)

    def geometry(self, where: Coordinates, places: np.ndarray) -> Geometry:
        """Dense.

        Raises:
            NotApplicableError: for trajectories that are too long.
        """
        if self.layout.size > DOUBTED_UP_TO:
            raise NotApplicableError(
                f"projector: trajectories of d = {self.layout.size} > {DOUBTED_UP_TO} numbers are too long to be held "
                "one by one against doubted dynamics; use projector.residual=averaged"
            )
        rows = Rows(*self.stages.matrix(self.layout)).scaled(where)
        made = partial(ByPlan.of, self.layout, rows, self.root, places, where)
        return Geometry(self.layout.rank - len(places), "dense", partial(made, identity(self.layout)), made)


@dataclass(frozen=True)
class ByPlan:
    """See `Doubted`; in scaled coordinates.

    Args:
        G, g: rows, (*robots, nT, d) and (*robots, nT).
        root: L in one, (*robots, p, n k).
        gain: by which the pins move what is correlated with them, (*robots, d, k).
        moves: G C given the pins, (*robots, nT, d).
        inverse: (G C G')^+, (*robots, nT, nT).
        places: of the pins.
        scale, mean: of the coordinates.
    """

    layout: TrajectoryLayout
    G: np.ndarray = field(repr=False)
    g: np.ndarray = field(repr=False)
    root: np.ndarray = field(repr=False)
    gain: np.ndarray = field(repr=False)
    moves: np.ndarray = field(repr=False)
    inverse: np.ndarray = field(repr=False)
    places: np.ndarray = field(repr=False)
    scale: np.ndarray = field(repr=False)
    mean: np.ndarray = field(repr=False)

    @classmethod
    def of(
        cls,
        layout: TrajectoryLayout,
        rows: Rows,
        root: np.ndarray,
        places: np.ndarray,
        where: Coordinates,
        metric: Covariance,
    ) -> ByPlan:
        """In the metric C."""
        given, gain = metric.given(places)
        moves = rows.G @ given.matrix
        inverse = semidefinite_inverse(moves @ rows.G.swapaxes(-1, -2))
        flat = root.reshape(*root.shape[:-2], -1)
        return cls(layout, rows.G, rows.g, flat, gain, moves, inverse, places, where.scale, where.mean)

    def given(self, values: np.ndarray) -> np.ndarray:
        """The values in scaled coordinates."""
        return (values - self.mean[self.places]) / self.scale[self.places]

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """See `Form`: (M + V V')^-1 by Woodbury's formula, plan by plan, with M = G C G'."""
        z = self._pinned(z, given)
        residual = z @ self.G.swapaxes(-1, -2) - self.g[..., None, :]
        corrected = z
        for _ in range(ROUNDS):
            V = self.deviations(corrected)
            e = residual if noise is None else residual - (V @ noise[..., : V.shape[-1], None])[..., 0]
            weighed = self.inverse[..., None, :, :] @ V
            known, V_t = e @ self.inverse, V.swapaxes(-1, -2)
            explained = solve(V_t @ weighed + like_identity(V), V_t @ known[..., None])
            multipliers = known - (weighed @ explained)[..., 0]
            corrected = z - multipliers @ self.moves
        return corrected

    def deviations(self, z: Array) -> Array:
        """V of plans (*robots, plans, d): (*robots, plans, nT, k)."""
        x, u = self.layout.split(z * self.scale + self.mean)
        phi = join([x[..., :-1, :], u], -1)
        if self.root.shape[-2] > phi.shape[-1]:
            phi = join([phi, phi[..., :1] ** 0], -1)
        V = phi @ self.root[..., None, :, :]  # (*robots, plans, T, n k)
        return V.reshape(*V.shape[:-2], self.G.shape[-2], -1)

    def _pinned(self, z: Array, given: Array) -> Array:
        if not len(self.places):
            return z
        z = z + (given - z[..., self.places]) @ self.gain.swapaxes(-1, -2)
        z[..., self.places] = given
        return z


def like_identity(V: Array) -> Array:
    """I of the size of V' V, as an array of its kind."""
    unit = np.eye(V.shape[-1])
    return unit if isinstance(V, np.ndarray) else V.new_tensor(unit)


@dataclass(frozen=True)
class DoubtedManifold(Manifold):
    """The trajectories of x(t+1) = x(t) + Theta phi(x(t), u(t)), Theta' being known up to N(theta_hat, L L').

    As `Doubted`, with G tau - g linearised about the plan that the sweep before gave: each sweep is one of Gauss-Newton
    for min |tau - tau_hat|^2_C + |e|^2, in O(T).

    Args:
        root: L of shape (*robots, p, n, k), p being the number of features.
    """

    system: Regressed
    root: np.ndarray = field(repr=False, kw_only=True)

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> DoubtedTracker:
        """See `Manifold.bind`."""
        return DoubtedTracker(self, coordinates or physical(self.layout), Pinned.of(pins, self.layout, self.robots))


class DoubtedTracker(Tracker):
    """The correction of plans by doubted nonlinear dynamics; it draws their residual from `noise`.

    Args:
        target: the dynamics.
        where: the coordinates.
        pinned: places and values of the pins.
    """

    _set: DoubtedManifold

    def __init__(self, target: DoubtedManifold, where: Coordinates, pinned: Pinned) -> None:
        super().__init__(target, where, pinned)
        self._pinned = pinned

    def _project(
        self, z: np.ndarray, metric: Covariance | None, start: np.ndarray | None, noise: np.ndarray | None
    ) -> np.ndarray:
        C = (metric or identity(self._set.layout)).invertible
        values = np.broadcast_to(self._pinned.values, (*z.shape[:-1], len(self._pinned.places)))
        hold = Hold.of(C, self._pinned.places, self._where)
        about = hold.pin(self._where.to_physical(z if start is None else start), values)
        corrected = np.empty_like(z)
        for _ in range(self._set.sweeps):
            for some in _slices(z.shape[:-1]):
                own = (..., some, None, slice(None))  # each plan is one of a robot of its own
                drawn = None if noise is None else noise[own]
                corrected[..., some, :] = self._along(about[..., some, :], C)(z[own], values[own], drawn)[..., 0, :]
            about = self._where.to_physical(corrected)
        return corrected

    def _along(self, tau: np.ndarray, C: Covariance) -> Blocks:
        """The correction by the dynamics linearised along each of tau (*robots, plans, d)."""
        layout, system, root = self._set.layout, self._set.system, self._set.root
        x, u = layout.split(tau)
        stages = Stages(*system.linearise(x[..., :-1, :], u))
        V = system.features(x[..., :-1, :], u) @ root.reshape(*root.shape[:-2], -1)[..., None, :, :]
        V = V.reshape(*V.shape[:-2], -1, root.shape[-1])
        return Blocks.of(layout, stages, C, self._pinned.places, self._where, V)


def _slices(plans: tuple[int, ...]) -> list[slice]:
    """Of plans (*robots, plans), so many at once that their matrices fit."""
    *robots, count = plans
    size = max(1, AT_ONCE // int(np.prod(robots)))
    return [slice(first, first + size) for first in range(0, count, size)]

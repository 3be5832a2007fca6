"""The projectors: what is known of the dynamics, and the admissible set that follows from it.

Each is a dataclass with `fit(layout, system, recording)`, which uses what its `needs` names, and a yaml in
`conf/projector/`. `fit` returns the set in physical units; see `dadiff.projectors.sets`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from dadiff.errors import ConfigError, ExcitationError
from dadiff.projectors.sets import AdmissibleSet, InitialState, Projection, Rollout
from dadiff.systems import LinearSystem, Recording
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.hankel import identity_length, trajectory_matrix
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.response import dynamics_matrix, trajectory_map
from dadiff.trajectory.subspace import null_space, numerical_rank, rank_tolerance

Given = TypeVar("Given")


class Fitted(Protocol):
    """What a projector's `fit` returns."""

    notes: dict[str, float]

    def projection(self, coordinates: Coordinates | None = None, x_init: np.ndarray | None = None) -> Projection: ...


class Projector(Protocol):
    """Finds an admissible set; `needs` names what it finds it from: "system", "recording" or nothing."""

    needs: ClassVar[str | None]

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> Fitted | None: ...


@dataclass(frozen=True)
class NoProjector:
    """Vanilla diffusion: nothing is projected."""

    needs: ClassVar[str | None] = None

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> None:
        """Nothing to fit."""


@dataclass(frozen=True)
class Known:
    """P = F F† from known (A, B), eq. (5).

    Args:
        initial_state: `fixed` projects onto the trajectories with x(0) = x_init.
    """

    initial_state: InitialState = "free"
    needs: ClassVar[str | None] = "system"

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> AdmissibleSet:
        """The image of F."""
        system = _required(system, "known", "system")
        return _image_of_dynamics(system.A, system.B, layout).starting(self.initial_state)


@dataclass(frozen=True)
class Hankel:
    """P = H H† with H = [H_{T+1}(x); H_T(u)], literally eq. (11).

    Process noise gives every column a direction of its own; from d columns on H H† is the identity and the
    projector does nothing. That is refused unless `allow_identity`.
    """

    initial_state: InitialState = "free"
    allow_identity: bool = False
    needs: ClassVar[str | None] = "recording"

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> AdmissibleSet:
        """The image of H."""
        recording = _required(recording, "hankel", "recording")
        U, s, rank = _decompose(recording, layout)
        if rank == layout.size and not self.allow_identity:
            raise ExcitationError(
                f"projector hankel: {recording.count} x S = {recording.length} noisy columns span all d = "
                f"{layout.size} dimensions, so H H† is the identity and projects nothing; use hankel_lowrank, "
                f"S < {identity_length(layout, recording.count)}, or projector.allow_identity=true"
            )
        return AdmissibleSet(layout, U[..., :rank], notes=_notes(s, rank)).starting(self.initial_state)


@dataclass(frozen=True)
class HankelLowRank:
    """P = U U' with U the n + mT leading left singular vectors of the stacked Hankel matrix.

    The stack is truncated, not H(u) alone: under process noise its best approximation of the dynamics' rank.
    """

    initial_state: InitialState = "free"
    needs: ClassVar[str | None] = "recording"

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> AdmissibleSet:
        """The leading n + mT directions of H."""
        recording = _required(recording, "hankel_lowrank", "recording")
        U, s, _ = _decompose(recording, layout)
        basis = U[..., : layout.rank]
        return AdmissibleSet(layout, basis, notes=_notes(s, layout.rank)).starting(self.initial_state)


@dataclass(frozen=True)
class Identified:
    """P = F F† with (A, B) estimated by least squares: min sum_t |x(t+1) - A x(t) - B u(t)|^2 over the recording."""

    initial_state: InitialState = "free"
    needs: ClassVar[str | None] = "recording"

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> AdmissibleSet:
        """The image of the estimated F."""
        recording = _required(recording, "identified", "recording")
        A, B = identify(recording)
        return _image_of_dynamics(A, B, layout).starting(self.initial_state)


@dataclass(frozen=True)
class RolloutProjector:
    """Keeps the planned inputs and recomputes the states from x_init with known (A, B)."""

    needs: ClassVar[str | None] = "system"
    initial_state: ClassVar[InitialState] = "fixed"

    def fit(
        self, layout: TrajectoryLayout, system: LinearSystem | None = None, recording: Recording | None = None
    ) -> Rollout:
        """The map u -> F [x_init; u]."""
        system = _required(system, "rollout", "system")
        return Rollout(
            layout, trajectory_map(system.A, system.B, layout.horizon), {"rank": layout.rank - layout.state_dim}
        )


def identify(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares (A, B) of shapes (*robots, n, n) and (*robots, n, m) from all transitions of a recording.

    Raises:
        ExcitationError: if [x(t); u(t)] does not span n + m dimensions.
    """
    x, u = recording.states, recording.inputs
    n, m = x.shape[-1], u.shape[-1]
    regressors = np.concatenate([x[..., :-1, :], u], axis=-1).reshape(*x.shape[:-3], -1, n + m)
    if (rank := numerical_rank(regressors)) < n + m:
        raise ExcitationError(
            f"recording: states and inputs span {rank} dimensions, n + m = {n + m} are needed to identify A and B; "
            "record with inputs that vary independently of the state"
        )
    AB = (np.linalg.pinv(regressors) @ x[..., 1:, :].reshape(*x.shape[:-3], -1, n)).swapaxes(-1, -2)
    return AB[..., :n], AB[..., n:]


def _image_of_dynamics(A: np.ndarray, B: np.ndarray, layout: TrajectoryLayout) -> AdmissibleSet:
    basis = null_space(dynamics_matrix(A, B, layout.horizon))
    return AdmissibleSet(layout, basis, notes={"rank": layout.rank})


def _decompose(recording: Recording, layout: TrajectoryLayout) -> tuple[np.ndarray, np.ndarray, int]:
    """Left singular vectors, singular values and rank of the stack H.

    Raises:
        ExcitationError: if x(0) and u(0:T-1) of the windows do not span n + mT dimensions (Willems' condition, which
            noise cannot feign: under feedback alone u(0) follows from x(0)), or the rank differs between robots.
    """
    H = trajectory_matrix(recording.states, recording.inputs, layout)
    sources = np.concatenate([H[..., layout.initial_state, :], H[..., layout.all_inputs, :]], axis=-2)
    if (found := numerical_rank(sources)) < layout.rank:
        raise ExcitationError(
            f"recording: x(0) and u(0:T-1) of its windows have rank {found}, n + mT = {layout.rank} are needed: the "
            "inputs do not excite the system; record with inputs that vary independently of the state (not under "
            "feedback alone)"
        )
    U, s, _ = np.linalg.svd(H, full_matrices=False)
    ranks = (s > rank_tolerance(s, H.shape)).sum(axis=-1)
    rank = int(ranks.min())
    if rank < ranks.max():
        raise ExcitationError(
            f"recording: the robots' Hankel matrices have ranks from {rank} to {int(ranks.max())}; "
            "give every robot a recording of the same length and noise"
        )
    return U, s, rank


def _notes(s: np.ndarray, rank: int) -> dict[str, float]:
    """Rank, and the gap s_r / s_{r+1} behind it (inf where nothing follows); of a fleet, the smallest gap."""
    if rank >= s.shape[-1]:
        return {"rank": rank, "singular_value_gap": float("inf")}
    with np.errstate(divide="ignore"):
        return {"rank": rank, "singular_value_gap": float((s[..., rank - 1] / s[..., rank]).min())}


def _required(value: Given | None, projector: str, what: str) -> Given:
    if value is None:
        raise ConfigError(f"projector {projector} needs a {what}, and none is given; choose one with {what}=...")
    return value

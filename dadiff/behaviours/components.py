"""The projectors: what is known of the dynamics, and the set of trajectories that follows from it.

Each is a dataclass with `fit`, which uses what its `needs` names, and a yaml in `conf/projector/`. `fit` returns the
set in physical units; see `dadiff.behaviours.sets`. `initial_state` says whether x(0) is pinned at x_init.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, TypeVar

import numpy as np

from dadiff.behaviours.bounded import Bounded
from dadiff.behaviours.clear import Clear
from dadiff.behaviours.least_squares import Offset, Transitions, least_squares, lifted, regressed
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.sets import Dynamics, Everything, InitialState, Rollout, Span, TrajectorySet, Uncertain
from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError, ExcitationError, NotApplicableError
from dadiff.systems import AffineSystem, Recording, Robots, System
from dadiff.systems.features import Features, Term
from dadiff.trajectory.hankel import identity_length, trajectory_matrix
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import numerical_rank, rank_tolerance

Given = TypeVar("Given")
LearnFrom = Literal["recording", "demonstrations", "both"]
BoundsChoice = Literal["ignored", "enforced"]

NOTHING: frozenset[str] = frozenset()
SYSTEM, RECORDING = frozenset({"system"}), frozenset({"recording"})


class Projector(Protocol):
    """Finds a set of trajectories; `needs` names what it finds it from: system, recording, demonstrations."""

    @property
    def needs(self) -> frozenset[str]:
        """What `fit` must be given."""
        ...

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> TrajectorySet | None:
        """The set, or None where nothing is projected.

        Args:
            demonstrations: trajectories (N, d), in physical units.
        """
        ...


def pins(projector: Projector, layout: TrajectoryLayout, x_init: np.ndarray) -> tuple[Pin, ...]:
    """What a projector holds of each plan: x(0) = x_init (*robots, plans..., n), where its initial_state is `fixed`."""
    fixed = getattr(projector, "initial_state", "free") == "fixed"
    return (Pin.initial_state(layout, x_init),) if fixed else ()


@dataclass(frozen=True)
class NoProjector:
    """Vanilla diffusion: nothing is projected."""

    needs: ClassVar[frozenset[str]] = NOTHING

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> None:
        """Nothing to fit."""


@dataclass(frozen=True)
class Inpainting:
    """Nothing is known of the dynamics; only x(0) = x_init is held, as Diffuser does (Janner et al. 2022)."""

    needs: ClassVar[frozenset[str]] = NOTHING
    initial_state: ClassVar[InitialState] = "fixed"

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Everything:
        """All trajectories."""
        return Everything(layout, notes={"rank": layout.size})


@dataclass(frozen=True)
class Known:
    """P = F F† from known dynamics, eq. (5).

    Of a nonlinear system: the trajectories that are nearest, by Gauss-Newton sweeps of LQR tracking.

    Args:
        initial_state: `fixed` projects onto the trajectories with x(0) = x_init.
        sweeps: for each projection onto nonlinear dynamics; more than one where a plan is projected once (post hoc).
        bounds: `enforced` keeps to the system's bounds on states and inputs as well, where it has any.
    """

    initial_state: InitialState = "free"
    sweeps: int = 1
    bounds: BoundsChoice = "ignored"
    needs: ClassVar[frozenset[str]] = SYSTEM

    def __post_init__(self) -> None:
        if self.sweeps < 1:
            raise ConfigError(f"projector: sweeps is {self.sweeps}; at least one is needed")

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Dynamics | Manifold | Bounded:
        """The trajectories of the system.

        Raises:
            NotApplicableError: for bounds on a nonlinear system.
        """
        system = _required(system, "known", "system")
        notes: dict[str, float] = {"rank": layout.rank}
        if not isinstance(system, AffineSystem):
            return within(Manifold(layout, system, self.sweeps, notes=notes), self.bounds, system)
        return within(Dynamics(layout, stages_of(system, layout.horizon), notes=notes), self.bounds, system)


@dataclass(frozen=True)
class Nominal(Known):
    """`Known` dynamics, but of the middle of the robot's family, whatever the robot: a mismatch of the plant."""

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Dynamics | Manifold | Bounded:
        """The trajectories of the nominal robot.

        Raises:
            NotApplicableError: if the system is of no family.
        """
        system = _required(system, "nominal", "system")
        if not isinstance(system, Robots) or system.family is None:
            raise NotApplicableError(
                "projector nominal: the system is of no family whose middle could be taken for it; use projector=known"
            )
        return super().fit(layout, system.nominal)


@dataclass(frozen=True)
class KnownClear:
    """Known linear dynamics among discs: keeps clear of the obstacles of E as well.

    Args:
        initial_state: as of `Known`.
        margin: by which discs are inflated, in metres.
        rounds: how often discs become half-planes about what was found.
    """

    initial_state: InitialState = "fixed"
    margin: float = 0.03
    rounds: int = 2
    needs: ClassVar[frozenset[str]] = SYSTEM

    def __post_init__(self) -> None:
        if self.margin < 0 or self.rounds < 1:
            raise ConfigError(f"projector: margin is {self.margin} and rounds {self.rounds}; need >= 0 and >= 1")

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Clear:
        """The trajectories of the system, before it is told of discs.

        Raises:
            NotApplicableError: for nonlinear systems.
        """
        dynamics = Known().fit(layout, system)
        if not isinstance(dynamics, Dynamics):
            raise NotApplicableError("projector known_clear: it keeps linear systems clear; use projector=known")
        return Clear(dynamics, self.margin, self.rounds)


@dataclass(frozen=True)
class Hankel:
    """P = H H† with H = [H_{T+1}(x); H_T(u)], literally eq. (11).

    Process noise gives every column a direction of its own; from d columns on H H† is the identity and the
    projector does nothing. That is refused unless `allow_identity`.
    """

    initial_state: InitialState = "free"
    allow_identity: bool = False
    needs: ClassVar[frozenset[str]] = RECORDING

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Span:
        """The image of H."""
        recording = _required(recording, "hankel", "recording")
        U, s, rank = _decompose(recording, layout)
        if rank == layout.size and not self.allow_identity:
            raise ExcitationError(
                f"projector hankel: {recording.count} x S = {recording.length} noisy columns span all d = "
                f"{layout.size} dimensions, so H H† is the identity and projects nothing; use hankel_lowrank, "
                f"S < {identity_length(layout, recording.count)}, or projector.allow_identity=true"
            )
        return Span(layout, U[..., :rank], notes=_notes(s, rank))


@dataclass(frozen=True)
class HankelLowRank:
    """P = U U' with U the n + mT leading left singular vectors of the stacked Hankel matrix.

    The stack is truncated, not H(u) alone: under process noise its best approximation of the dynamics' rank.
    """

    initial_state: InitialState = "free"
    needs: ClassVar[frozenset[str]] = RECORDING

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Span:
        """The leading n + mT directions of H."""
        recording = _required(recording, "hankel_lowrank", "recording")
        U, s, _ = _decompose(recording, layout)
        return Span(layout, U[..., : layout.rank], notes=_notes(s, layout.rank))


@dataclass(frozen=True)
class Identified:
    """P = F F† with dynamics estimated by least squares: min sum_t |x(t+1) - A x(t) - B u(t) - c|^2.

    With `features` they are nonlinear, x(t+1) = x(t) + Theta phi(x, u), see `dadiff.systems.features`.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        learn_from: transitions of the `recording`, of the `demonstrations`, or of both: they obey the same dynamics.
        offset: c is `none` (0), `estimated`, or `known` from the system.
        features: terms of phi; none for linear dynamics.
        angles: indices of the states whose sines and cosines are features.
        ridge: weight of |Theta|^2 against the squared residuals, features scaled to deviation 1.
        bounds: `enforced` keeps to the system's bounds on states and inputs as well, where it has any.
    """

    initial_state: InitialState = "free"
    learn_from: LearnFrom = "recording"
    offset: Offset = "none"
    features: Sequence[Term] = ()
    angles: Sequence[int] = ()
    ridge: float = 0.0
    bounds: BoundsChoice = "ignored"

    def __post_init__(self) -> None:
        for name in ("features", "angles"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not 0 <= self.ridge < np.inf:
            raise ConfigError(f"projector: ridge is {self.ridge}; it must be finite and not negative")
        if not self.features and (self.angles or self.ridge):
            raise ConfigError("projector: angles and ridge are of features, and there are none; name some")
        if self.features and self.offset != "none":
            raise ConfigError("projector: with features the offset is one of them; use constant, and offset=none")

    @property
    def needs(self) -> frozenset[str]:
        """What it learns from, and the system whose offset or bounds are known."""
        sources = {"recording", "demonstrations"} if self.learn_from == "both" else {self.learn_from}
        told = self.offset == "known" or self.bounds == "enforced"
        return frozenset(sources | ({"system"} if told else set()))

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Dynamics | Manifold | Bounded:
        """The trajectories of the estimated dynamics.

        Raises:
            NotApplicableError: for bounds on nonlinear dynamics.
        """
        data = transitions(self, layout, system, recording, demonstrations)
        notes: dict[str, float] = {"rank": layout.rank}
        if self.features:
            phi = Features(layout.state_dim, layout.input_dim, self.features, self.angles)
            return within(Manifold(layout, regressed(data, phi, self.ridge).system, notes=notes), self.bounds, system)
        estimate = least_squares(data, self.offset, known_offset(self, system))
        return within(Dynamics(layout, estimate.stages(layout.horizon), notes=notes), self.bounds, system)


@dataclass(frozen=True)
class IdentifiedSoft(Identified):
    """Dynamics estimated by least squares, each direction trusted by how well it is known.

    The estimate's posterior covariance says how far a trajectory of the true system may lie from G tau = g; it is
    averaged over the demonstrations. See `dadiff.behaviours.Uncertain`; `enforcement=conditional` weighs it against
    what the denoiser leaves open. With much data it is `Identified`, with little it projects hardly.
    """

    @property
    def needs(self) -> frozenset[str]:
        """What it learns from, and demonstrations, which say what trajectories look like."""
        return super().needs | {"demonstrations"}

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Uncertain:
        """The estimated dynamics, and the covariance of the residual."""
        if self.features:
            raise NotApplicableError(
                "projector identified_soft: what it trusts is linear dynamics; with features use projector=identified"
            )
        if self.bounds == "enforced":
            raise NotApplicableError(
                "projector identified_soft: dynamics that are trusted in part are not held within bounds; use "
                "projector=identified"
            )
        shown = _required(demonstrations, "identified_soft", "dataset")
        data = transitions(self, layout, system, recording, demonstrations)
        estimate = least_squares(data, self.offset, known_offset(self, system))
        spread = estimate.residual_spread(*layout.split(shown))
        deviation = float(np.sqrt(np.square(spread).sum(axis=-1).mean()))
        notes = {"rank": layout.rank, "residual_deviation": deviation}
        return Uncertain(layout, estimate.stages(layout.horizon), spread, notes=notes)


@dataclass(frozen=True)
class Koopman:
    """Extended dynamic mode decomposition: least squares for psi(x(t+1)) = K psi(x(t)) + B u(t).

    Args:
        features: observables besides the states: constant, trigonometric, products; see `dadiff.systems.features`.
        angles: indices of the states whose sines and cosines are observed.
        ridge: weight of |[K, B]|^2 against the squared residuals, observables scaled to deviation 1.
    """

    needs: ClassVar[frozenset[str]] = RECORDING
    initial_state: ClassVar[InitialState] = "fixed"

    features: Sequence[Term] = ("constant",)
    angles: Sequence[int] = ()
    ridge: float = 0.0

    def __post_init__(self) -> None:
        for name in ("features", "angles"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if "control_affine" in self.features:
            raise ConfigError("projector koopman: observables are of states alone, and control_affine is of inputs")
        if not 0 <= self.ridge < np.inf:
            raise ConfigError(f"projector: ridge is {self.ridge}; it must be finite and not negative")

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Lifted:
        """The trajectories of the lifted dynamics."""
        recording = _required(recording, "koopman", "recording")
        data = Transitions.of(recording.states, recording.inputs)
        psi = Features(layout.state_dim, 0, ("identity", *self.features), self.angles)
        K, B = lifted(data, psi, self.ridge)
        return Lifted(layout, psi, K, B, notes={"rank": layout.rank, "observables": psi.count})


@dataclass(frozen=True)
class RolloutProjector:
    """Keeps the planned inputs and recomputes the states from x_init with known dynamics."""

    needs: ClassVar[frozenset[str]] = SYSTEM
    initial_state: ClassVar[InitialState] = "fixed"

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Rollout:
        """The map u -> F [x_init; u]."""
        system = _required(system, "rollout", "system")
        return Rollout(layout, stages_of(system, layout.horizon), notes={"rank": layout.rank - layout.state_dim})


def transitions(
    projector: Identified,
    layout: TrajectoryLayout,
    system: System | None,
    recording: Recording | None,
    demonstrations: np.ndarray | None,
) -> Transitions:
    """What a projector learns dynamics from.

    Raises:
        ConfigError: if a source is missing, or the demonstrations are of many robots.
    """
    found = []
    if projector.learn_from != "demonstrations":
        recording = _required(recording, "identified", "recording")
        found.append(Transitions.of(recording.states, recording.inputs))
    if projector.learn_from != "recording":
        trajectories = _required(demonstrations, "identified", "dataset")
        robots = found[0].x.shape[:-2] if found else () if system is None else system.robots
        if robots not in ((), (1,)):
            raise ConfigError(
                f"projector: the demonstrations are of many robots, and say nothing of any one of the {robots[0]} that "
                "are planned for alone; use projector=identified_family, or projector.learn_from=recording"
            )
        states, inputs = layout.split(trajectories)
        found.append(Transitions.of(states.reshape(*robots, *states.shape), inputs.reshape(*robots, *inputs.shape)))
    return found[0] if len(found) == 1 else found[0] + found[1]


def within(found: Dynamics | Manifold, bounds: BoundsChoice, system: System | None) -> Dynamics | Manifold | Bounded:
    """What was found, within the system's bounds if they are enforced and it has any.

    Raises:
        NotApplicableError: if the dynamics are nonlinear.
    """
    if bounds == "ignored":
        return found
    limits = _required(system, "with bounds", "system").bounds
    if not limits.any:
        return found
    if isinstance(found, Manifold):
        raise NotApplicableError(
            "projector: bounds are held for linear dynamics only, and these are not; use projector.bounds=ignored"
        )
    return Bounded.by(found, limits)


def known_offset(projector: Identified, system: System | None) -> np.ndarray | None:
    """c of the system (*robots, n), where the projector is told it."""
    if projector.offset != "known":
        return None
    return stages_of(_required(system, "identified", "system"), 1).c[..., 0, :]


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

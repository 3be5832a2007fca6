"""The projectors: what is known of the dynamics, and the set of trajectories that follows from it.

Each is a dataclass with `fit`, which uses what its `needs` names, and a yaml in `conf/projector/`. `fit` returns the
set in physical units; see `dadiff.behaviours.sets`. `initial_state` says whether x(0) is pinned at x_init.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol, TypeVar

import numpy as np

from dadiff.behaviours.doubt import Doubted
from dadiff.behaviours.hulls import Hull
from dadiff.behaviours.least_squares import Offset, Transitions, least_squares, lifted, regressed
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.sets import Dynamics, Everything, InitialState, Rollout, Span, TrajectorySet, Uncertain
from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError, ExcitationError, NotApplicableError
from dadiff.systems import AffineSystem, Recording, Robots, System
from dadiff.systems.features import Features, Term
from dadiff.trajectory.hankel import identity_length
from dadiff.trajectory.layout import TrajectoryLayout

Given = TypeVar("Given")
LearnFrom = Literal["recording", "demonstrations", "both"]
BoundsChoice = Literal["ignored", "enforced"]

SMALL_GAP = 2.0
"""Of singular values s_r / s_{r+1}: below it a truncated Hankel matrix is one of noise as well."""

log = logging.getLogger(__name__)

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
        bounds: `enforced` keeps to the system's bounds on states and inputs as well.
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
    ) -> Dynamics | Manifold | Limited:
        """The trajectories of the system.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
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
    ) -> Dynamics | Manifold | Limited:
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
    """Known dynamics among discs: keeps clear of the obstacles of E as well; the first two states are a position.

    Args:
        initial_state, sweeps, bounds: as of `Known`.
        margin: by which discs are inflated, in metres.
        rounds: how often discs become half-planes about what was found.
    """

    initial_state: InitialState = "fixed"
    margin: float = 0.03
    rounds: int = 2
    sweeps: int = 1
    bounds: BoundsChoice = "ignored"
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
    ) -> Limited:
        """The trajectories of the system, before it is told of discs.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
        """
        found = Known(sweeps=self.sweeps, bounds=self.bounds).fit(layout, system)
        limited = found if isinstance(found, Limited) else Limited(found)
        return replace(limited, margin=self.margin, rounds=self.rounds)


@dataclass(frozen=True)
class Hankel:
    """P = H H† with H = [H_{T+1}(x); H_T(u)], literally eq. (11).

    Process noise gives every column a direction of its own; from d columns on H H† is the identity and the
    projector does nothing. That is refused unless `allow_identity`.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        allow_identity: also where it projects nothing.
        offset: of the dynamics: `none`; `estimated`: the affine hull of the columns; or `known`: about the system's
            drift. See `dadiff.behaviours.hulls`.
    """

    initial_state: InitialState = "free"
    allow_identity: bool = False
    offset: Offset = "none"

    @property
    def needs(self) -> frozenset[str]:
        """A recording, and the system whose offset is known."""
        return told(RECORDING, self.offset)

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Span:
        """The image of H."""
        recording = _required(recording, "hankel", "recording")
        hull = Hull.of(recording, layout, self.offset, offsetting(system, self.offset, "hankel"))
        if hull.rank == layout.size and not self.allow_identity:
            longest = identity_length(layout, recording.count, spare=int(self.offset == "estimated"))
            raise ExcitationError(
                f"projector hankel: {recording.count} x S = {recording.length} noisy columns span all d = "
                f"{layout.size} dimensions, so H H† is the identity and projects nothing; use hankel_lowrank, "
                f"S < {longest}, or projector.allow_identity=true"
            )
        return hull.span(hull.rank)


@dataclass(frozen=True)
class HankelLowRank:
    """P = U U' with U the n + mT leading left singular vectors of the stacked Hankel matrix.

    The stack is truncated, not H(u) alone: under process noise its best approximation of the dynamics' rank, each
    channel scaled to one size.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        offset: as of `Hankel`.
    """

    initial_state: InitialState = "free"
    offset: Offset = "none"

    @property
    def needs(self) -> frozenset[str]:
        """A recording, and the system whose offset is known."""
        return told(RECORDING, self.offset)

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Span:
        """The leading n + mT directions of H."""
        recording = _required(recording, "hankel_lowrank", "recording")
        hull = Hull.of(recording, layout, self.offset, offsetting(system, self.offset, "hankel_lowrank"))
        if (gap := hull.gap(layout.rank)) < SMALL_GAP:
            log.warning(
                "projector hankel_lowrank: singular value n + mT = %d is only %.3g times the next one: noise is taken "
                "for dynamics; record longer or with larger inputs, or use projector=identified",
                layout.rank,
                gap,
            )
        return hull.span(layout.rank)


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
        bounds: `enforced` keeps to the system's bounds on states and inputs as well.
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
        if self.features and self.offset == "known":
            raise ConfigError("projector: with features the offset is one of them; use offset=estimated")

    @property
    def needs(self) -> frozenset[str]:
        """What it learns from, and the system whose offset or bounds are known."""
        sources = {"recording", "demonstrations"} if self.learn_from == "both" else {self.learn_from}
        return told(frozenset(sources), self.offset) | (SYSTEM if self.bounds == "enforced" else NOTHING)

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Dynamics | Manifold | Limited:
        """The trajectories of the estimated dynamics.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
        """
        data = transitions(self, layout, system, recording, demonstrations)
        notes: dict[str, float] = {"rank": layout.rank}
        if self.features:
            terms = with_offset(self.features, self.offset)
            phi = Features(layout.state_dim, layout.input_dim, terms, self.angles)
            return within(Manifold(layout, regressed(data, phi, self.ridge).system, notes=notes), self.bounds, system)
        estimate = least_squares(data, self.offset, known_offset(self.offset, system))
        return within(Dynamics(layout, estimate.stages(layout.horizon), notes=notes), self.bounds, system)


@dataclass(frozen=True)
class IdentifiedSoft(Identified):
    """Dynamics estimated by least squares, each direction trusted by how well it is known.

    The estimate's posterior covariance says how far a trajectory of the true system may lie from G tau = g, and
    `enforcement=conditional` weighs that against what the denoiser leaves open. With much data it is `Identified`, with
    little it projects hardly.

    Args:
        residual: its covariance is that of `each` plan (`dadiff.behaviours.Doubted`), or `averaged` over the
            demonstrations (`Uncertain`), which long trajectories need.
    """

    residual: Literal["each", "averaged"] = "each"

    @property
    def needs(self) -> frozenset[str]:
        """What it learns from; to average, demonstrations, which say what trajectories look like."""
        return super().needs | ({"demonstrations"} if self.residual == "averaged" else set())

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Uncertain | Doubted:
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
        data = transitions(self, layout, system, recording, demonstrations)
        estimate = least_squares(data, self.offset, known_offset(self.offset, system))
        if self.residual == "each":
            return Doubted(layout, estimate.stages(layout.horizon), estimate.root, notes={"rank": layout.rank})
        spread = estimate.residual_spread(*layout.split(_required(demonstrations, "identified_soft", "dataset")))
        deviation = float(np.sqrt(np.square(spread).sum(axis=-1).mean()))
        notes = {"rank": layout.rank, "residual_deviation": deviation}
        return Uncertain(layout, estimate.stages(layout.horizon), spread, notes=notes)


@dataclass(frozen=True)
class Koopman:
    """Extended dynamic mode decomposition: least squares for psi(x(t+1)) = K psi(x(t)) + B u(t).

    Args:
        features: observables besides the states: trigonometric, products; see `dadiff.systems.features`.
        angles: indices of the states whose sines and cosines are observed.
        ridge: weight of |[K, B]|^2 against the squared residuals, observables scaled to deviation 1.
        offset: `estimated` observes the constant 1, which carries it; `none` does not; `known` is taken from the
            transitions of the system's states, for observables that are the states alone.
    """

    initial_state: ClassVar[InitialState] = "fixed"

    features: Sequence[Term] = ()
    angles: Sequence[int] = ()
    ridge: float = 0.0
    offset: Offset = "estimated"

    @property
    def needs(self) -> frozenset[str]:
        """A recording, and the system whose offset is known."""
        return told(RECORDING, self.offset)

    def __post_init__(self) -> None:
        for name in ("features", "angles"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if "control_affine" in self.features:
            raise ConfigError("projector koopman: observables are of states alone, and control_affine is of inputs")
        if self.offset == "known" and self.features:
            raise ConfigError("projector koopman: observables beside the states carry no known offset; use estimated")
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
        psi = Features(layout.state_dim, 0, with_offset(("identity", *self.features), self.offset), self.angles)
        if (c := known_offset(self.offset, system, "koopman")) is None:
            K, B = lifted(data, psi, self.ridge)
        else:
            K, B = with_constant(*lifted(data.less(c), replace(psi, terms=("identity",)), self.ridge), c)
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


def within(found: Dynamics | Manifold, bounds: BoundsChoice, system: System | None) -> Dynamics | Manifold | Limited:
    """What was found, within the system's bounds if they are enforced.

    Raises:
        ConfigError: if it has none.
    """
    if bounds == "ignored":
        return found
    limits = _required(system, "with bounds", "system").bounds
    if not limits.any:
        raise ConfigError(
            "projector: bounds are to be enforced, and the system has none; give it some, such as "
            "system.bounds.input_low=-2 system.bounds.input_high=2, or use projector.bounds=ignored"
        )
    return Limited(found, limits)


def with_offset(terms: Sequence[Term], offset: Offset) -> tuple[Term, ...]:
    """The terms, and the constant one where an offset is to be carried."""
    return tuple(terms) if offset == "none" or "constant" in terms else (*terms, "constant")


def with_constant(K: np.ndarray, B: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K and B of the observables [x; 1] from those of x, and c (*robots, n)."""
    n = K.shape[-1]
    above = np.concatenate([K, c[..., None]], axis=-1)
    below = np.broadcast_to(np.eye(n + 1)[n:], (*K.shape[:-2], 1, n + 1))
    return np.concatenate([above, below], axis=-2), np.concatenate([B, np.zeros((*B.shape[:-2], 1, B.shape[-1]))], -2)


def told(sources: frozenset[str], offset: Offset) -> frozenset[str]:
    """What a projector needs beside its sources: the system, where it is told the offset."""
    return sources | SYSTEM if offset == "known" else sources


def offsetting(system: System | None, offset: Offset, projector: str) -> System | None:
    """The system whose offset is known, or None where none is."""
    return _required(system, projector, "system") if offset == "known" else None


def known_offset(offset: Offset, system: System | None, projector: str = "identified") -> np.ndarray | None:
    """c of the system (*robots, n), where the projector is told it."""
    given = offsetting(system, offset, projector)
    return None if given is None else stages_of(given, 1).c[..., 0, :]


def _required(value: Given | None, projector: str, what: str) -> Given:
    if value is None:
        raise ConfigError(f"projector {projector} needs a {what}, and none is given; choose one with {what}=...")
    return value

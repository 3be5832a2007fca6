"""Projectors that are told the dynamics, or nothing of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from dadiff.behaviours.limited import Clipped, Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.projector import NOTHING, SYSTEM, Fitted, Sources
from dadiff.behaviours.sets import Dynamics, Everything, InitialState, Rollout
from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems import AffineSystem, Robots
from dadiff.trajectory.layout import TrajectoryLayout

BoundsChoice = Literal["ignored", "enforced"]


@dataclass(frozen=True)
class NoProjector(Fitted[None]):
    """Vanilla diffusion: nothing is projected."""

    label: ClassVar[str] = "none"
    needs: ClassVar[frozenset[str]] = NOTHING

    def find(self, layout: TrajectoryLayout, sources: Sources) -> None:
        """Nothing to fit."""


@dataclass(frozen=True)
class Inpainting(Fitted[Everything]):
    """Nothing is known of the dynamics; only x(0) = x_init is held, as Diffuser does (Janner et al. 2022)."""

    label: ClassVar[str] = "inpainting"
    needs: ClassVar[frozenset[str]] = NOTHING
    initial_state: ClassVar[InitialState] = "fixed"

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Everything:
        """All trajectories."""
        return Everything(layout, notes={"rank": layout.size})


@dataclass(frozen=True)
class Known(Fitted[Dynamics | Manifold | Limited]):
    """P = F F† from known dynamics, eq. (5).

    Of a nonlinear system: the trajectories that are nearest, by Gauss-Newton sweeps of LQR tracking.

    Args:
        initial_state: `fixed` projects onto the trajectories with x(0) = x_init.
        sweeps: for each projection onto nonlinear dynamics; more than one where a plan is projected once (post hoc).
        bounds: `enforced` keeps to the system's bounds on states and inputs as well.
    """

    label: ClassVar[str] = "known"
    initial_state: InitialState = "free"
    sweeps: int = 1
    bounds: BoundsChoice = "ignored"
    needs: ClassVar[frozenset[str]] = SYSTEM

    def __post_init__(self) -> None:
        if self.sweeps < 1:
            raise ConfigError(f"projector: sweeps is {self.sweeps}; at least one is needed")

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the system.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
        """
        system = sources.system
        notes: dict[str, float] = {"rank": layout.rank}
        if not isinstance(system, AffineSystem):
            return within(Manifold(layout, system, self.sweeps, notes=notes), self.bounds, sources)
        return within(Dynamics(layout, stages_of(system, layout.horizon), notes=notes), self.bounds, sources)


@dataclass(frozen=True)
class Nominal(Known):
    """`Known` dynamics, but of the middle of the robot's family, whatever the robot: a mismatch of the plant."""

    label: ClassVar[str] = "nominal"

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the nominal robot.

        Raises:
            NotApplicableError: if the system is of no family.
        """
        system = sources.system
        if not isinstance(system, Robots) or system.family is None:
            raise NotApplicableError(
                "projector nominal: the system is of no family whose middle could be taken for it; use projector=known"
            )
        return super().find(layout, replace(sources, given_system=system.nominal))


@dataclass(frozen=True)
class KnownTightened(Known):
    """`Known` within bounds that are tightened, as a margin for what the plan does not know (Chisci et al. 2001).

    Diffusion predictive control with constraints does so (Römer et al. 2024).

    Args:
        tightening: the share of half their distance by which bounds move towards each other.
    """

    label: ClassVar[str] = "known_tightened"
    bounds: BoundsChoice = "enforced"
    tightening: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.tightening < 1:
            raise ConfigError(f"projector: tightening is {self.tightening}; it must lie in [0, 1)")

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the system within tightened bounds."""
        found = super().find(layout, sources)
        return replace(found, bounds=found.bounds.tightened(self.tightening)) if isinstance(found, Limited) else found


@dataclass(frozen=True)
class KnownClipped(Known):
    """`Known` dynamics, without regard to bounds; then plans are clipped.

    Args:
        replay: clip inputs only, and recompute the states.
    """

    label: ClassVar[str] = "known_clipped"
    bounds: BoundsChoice = "enforced"
    replay: bool = False

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the system, clipped."""
        found = super().find(layout, sources)
        return Clipped(found.dynamics, found.bounds, replay=self.replay) if isinstance(found, Limited) else found


@dataclass(frozen=True)
class KnownClear(Fitted[Limited]):
    """Known dynamics among discs: keeps clear of the obstacles of E as well; the first two states are a position.

    Args:
        initial_state, sweeps, bounds: as of `Known`.
        margin: by which discs are inflated, in metres.
        rounds: how often discs become half-planes about what was found.
    """

    label: ClassVar[str] = "known_clear"
    initial_state: InitialState = "fixed"
    margin: float = 0.03
    rounds: int = 2
    sweeps: int = 1
    bounds: BoundsChoice = "ignored"
    needs: ClassVar[frozenset[str]] = SYSTEM

    def __post_init__(self) -> None:
        if self.margin < 0 or self.rounds < 1:
            raise ConfigError(f"projector: margin is {self.margin} and rounds {self.rounds}; need >= 0 and >= 1")

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Limited:
        """The trajectories of the system, before it is told of discs.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
        """
        found = Known(sweeps=self.sweeps, bounds=self.bounds).find(layout, sources)
        limited = found if isinstance(found, Limited) else Limited(found)
        return replace(limited, margin=self.margin, rounds=self.rounds)


@dataclass(frozen=True)
class RolloutProjector(Fitted[Rollout]):
    """Keeps the planned inputs and recomputes the states from x_init with known dynamics."""

    label: ClassVar[str] = "rollout"
    needs: ClassVar[frozenset[str]] = SYSTEM
    initial_state: ClassVar[InitialState] = "fixed"

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Rollout:
        """The map u -> F [x_init; u]."""
        stages = stages_of(sources.system, layout.horizon)
        return Rollout(layout, stages, notes={"rank": layout.rank - layout.state_dim})


def within(found: Dynamics | Manifold, bounds: BoundsChoice, sources: Sources) -> Dynamics | Manifold | Limited:
    """What was found, within the system's bounds if they are enforced.

    Raises:
        ConfigError: if it has none.
    """
    if bounds == "ignored":
        return found
    limits = sources.system.bounds
    if not limits.any:
        raise ConfigError(
            "projector: bounds are to be enforced, and the system has none; give it some, such as "
            "system.bounds.input_low=-2 system.bounds.input_high=2, or use projector.bounds=ignored"
        )
    return Limited(found, limits)

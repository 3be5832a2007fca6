"""Projectors that learn dynamics from data by least squares, and trust them, or trust them in part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from dadiff.behaviours.doubt import ROUNDS, Doubted, DoubtedManifold
from dadiff.behaviours.known import BoundsChoice, within
from dadiff.behaviours.least_squares import (
    Offset,
    Regression,
    Transitions,
    least_squares,
    lifted,
    regressed,
    significant,
)
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.projector import NOTHING, RECORDING, SYSTEM, Fitted, Sources, told
from dadiff.behaviours.sets import Dynamics, InitialState, Uncertain
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems.features import Features, Term
from dadiff.trajectory.layout import TrajectoryLayout

LearnFrom = Literal["recording", "demonstrations", "both"]


@dataclass(frozen=True)
class Identified(Fitted[Dynamics | Manifold | Limited]):
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

    label: ClassVar[str] = "identified"
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

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the estimated dynamics.

        Raises:
            ConfigError: if bounds are to be enforced and the system has none.
        """
        data = transitions(layout, sources, self.learn_from)
        notes: dict[str, float] = {"rank": layout.rank}
        if self.features:
            found = regressed(data, self.phi(layout), self.ridge)
            return within(Manifold(layout, found.system, notes=notes), self.bounds, sources)
        estimate = least_squares(data, self.offset, sources.offset(self.offset))
        return within(Dynamics(layout, estimate.stages(layout.horizon), notes=notes), self.bounds, sources)

    def phi(self, layout: TrajectoryLayout) -> Features:
        """The features, with the constant one where an offset is to be carried."""
        return Features(layout.state_dim, layout.input_dim, with_offset(self.features, self.offset), self.angles)


@dataclass(frozen=True)
class IdentifiedSparse(Identified):
    """Nonlinear dynamics of few features: those whose estimates are many standard errors from 0, see `significant`.

    Args:
        significance: how many.
    """

    label: ClassVar[str] = "identified_sparse"
    significance: float = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.features or self.ridge or not 0 <= self.significance < np.inf:
            raise ConfigError(
                f"projector: features are {list(self.features)}, ridge {self.ridge}, significance {self.significance}; "
                "need some features, no ridge, and a number that is not negative"
            )

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Dynamics | Manifold | Limited:
        """The trajectories of the estimated dynamics; see `Identified.find`."""
        found, notes = self.selected(layout, sources)
        return within(Manifold(layout, found.system, notes=notes), self.bounds, sources)

    def selected(self, layout: TrajectoryLayout, sources: Sources) -> tuple[Regression, dict[str, float]]:
        """The dynamics, and the mean number of terms that a robot's have."""
        found = significant(transitions(layout, sources, self.learn_from), self.phi(layout), self.significance)
        terms = float((found.system.theta != 0).sum(axis=(-2, -1)).mean())
        return found, {"rank": layout.rank, "terms": terms}


@dataclass(frozen=True)
class IdentifiedSoft(Identified):
    """Dynamics estimated by least squares, each direction trusted by how well it is known.

    The estimate's posterior covariance says how far a trajectory of the true system may lie from G tau = g, and
    `enforcement=conditional` weighs that against what the denoiser leaves open. With much data it is `Identified`, with
    little it projects hardly. With `features` the dynamics are nonlinear, and so are those of `IdentifiedSparseSoft`.

    Args:
        residual: its covariance is that of `each` plan (`dadiff.behaviours.Doubted`), or `averaged` over the
            demonstrations (`Uncertain`), which long trajectories of linear dynamics need.
    """

    label: ClassVar[str] = "identified_soft"
    residual: Literal["each", "averaged"] = "each"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.features and self.residual == "averaged":
            raise ConfigError(
                "projector identified_soft: the residual of nonlinear dynamics is that of each plan; use "
                "projector.residual=each"
            )

    @property
    def needs(self) -> frozenset[str]:
        """What it learns from; to average, demonstrations, which say what trajectories look like."""
        return super().needs | ({"demonstrations"} if self.residual == "averaged" else set())

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Uncertain | Doubted | DoubtedManifold:
        """The estimated dynamics, and the covariance of the residual."""
        check_unbounded(self)
        data = transitions(layout, sources, self.learn_from)
        if self.features:
            found = regressed(data, self.phi(layout), self.ridge)
            return DoubtedManifold(layout, found.system, ROUNDS, root=found.root, notes={"rank": layout.rank})
        estimate = least_squares(data, self.offset, sources.offset(self.offset))
        if self.residual == "each":
            return Doubted(layout, estimate.stages(layout.horizon), estimate.root, notes={"rank": layout.rank})
        spread = estimate.residual_spread(*layout.split(sources.demonstrations))
        deviation = float(np.sqrt(np.square(spread).sum(axis=-1).mean()))
        notes = {"rank": layout.rank, "residual_deviation": deviation}
        return Uncertain(layout, estimate.stages(layout.horizon), spread, notes=notes)


@dataclass(frozen=True)
class IdentifiedSparseSoft(IdentifiedSparse):
    """`IdentifiedSparse`, each of the terms that are kept trusted by how well it is known; see `IdentifiedSoft`."""

    label: ClassVar[str] = "identified_sparse_soft"

    def find(self, layout: TrajectoryLayout, sources: Sources) -> DoubtedManifold:
        """The estimated dynamics, and the covariance of their terms."""
        check_unbounded(self)
        found, notes = self.selected(layout, sources)
        return DoubtedManifold(layout, found.system, ROUNDS, root=found.root, notes=notes)


@dataclass(frozen=True)
class Koopman(Fitted[Lifted]):
    """Extended dynamic mode decomposition: least squares for psi(x(t+1)) = K psi(x(t)) + B u(t).

    Args:
        features: observables besides the states: trigonometric, products; see `dadiff.systems.features`.
        angles: indices of the states whose sines and cosines are observed.
        ridge: weight of |[K, B]|^2 against the squared residuals, observables scaled to deviation 1.
        offset: `estimated` observes the constant 1, which carries it; `none` does not; `known` is taken from the
            transitions of the system's states, for observables that are the states alone.
    """

    label: ClassVar[str] = "koopman"
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

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Lifted:
        """The trajectories of the lifted dynamics."""
        data = Transitions.of(sources.recording.states, sources.recording.inputs)
        psi = Features(layout.state_dim, 0, with_offset(("identity", *self.features), self.offset), self.angles)
        if (c := sources.offset(self.offset)) is None:
            K, B = lifted(data, psi, self.ridge)
        else:
            K, B = with_constant(*lifted(data.less(c), replace(psi, terms=("identity",)), self.ridge), c)
        return Lifted(layout, psi, K, B, notes={"rank": layout.rank, "observables": psi.count})


def check_unbounded(projector: Identified) -> None:
    """Raise `NotApplicableError` where dynamics that are trusted in part were to be held within bounds."""
    if projector.bounds == "enforced":
        raise NotApplicableError(
            f"projector {projector.label}: dynamics that are trusted in part are not held within bounds; use "
            f"projector={projector.label.removesuffix('_soft')}"
        )


def transitions(layout: TrajectoryLayout, sources: Sources, learn_from: LearnFrom) -> Transitions:
    """What a projector learns dynamics from.

    Raises:
        ConfigError: if a source is missing, or the demonstrations are of many robots.
    """
    found = []
    if learn_from != "demonstrations":
        found.append(Transitions.of(sources.recording.states, sources.recording.inputs))
    if learn_from != "recording":
        robots = found[0].x.shape[:-2] if found else sources.robots
        if robots not in ((), (1,)):
            raise ConfigError(
                f"projector: the demonstrations are of many robots, and say nothing of any one of the {robots[0]} that "
                "are planned for alone; use projector=identified_family, or projector.learn_from=recording"
            )
        states, inputs = layout.split(sources.demonstrations)
        found.append(Transitions.of(states.reshape(*robots, *states.shape), inputs.reshape(*robots, *inputs.shape)))
    return found[0] if len(found) == 1 else found[0] + found[1]


def with_offset(terms: Sequence[Term], offset: Offset) -> tuple[Term, ...]:
    """The terms, and the constant one where an offset is to be carried."""
    return tuple(terms) if offset == "none" or "constant" in terms else (*terms, "constant")


def with_constant(K: np.ndarray, B: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K and B of the observables [x; 1] from those of x, and c (*robots, n)."""
    n = K.shape[-1]
    above = np.concatenate([K, c[..., None]], axis=-1)
    below = np.broadcast_to(np.eye(n + 1)[n:], (*K.shape[:-2], 1, n + 1))
    return np.concatenate([above, below], axis=-2), np.concatenate([B, np.zeros((*B.shape[:-2], 1, B.shape[-1]))], -2)

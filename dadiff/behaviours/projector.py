"""What a projector is, what it is given, and what it holds of each plan."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from dadiff.behaviours.least_squares import Offset
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.sets import InitialState, TrajectorySet
from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError
from dadiff.systems import Recording, System
from dadiff.trajectory.layout import TrajectoryLayout

Given = TypeVar("Given")
Found = TypeVar("Found", covariant=True)

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


@runtime_checkable
class Pinning(Protocol):
    """A projector with a choice of whether x(0) is held at x_init of E; one without it leaves x(0) free."""

    @property
    def initial_state(self) -> InitialState:
        """`fixed` holds x(0) = x_init."""
        ...


def starts_fixed(projector: Projector) -> bool:
    """Whether a projector holds x(0) = x_init."""
    return isinstance(projector, Pinning) and projector.initial_state == "fixed"


def pins(projector: Projector, layout: TrajectoryLayout, x_init: np.ndarray) -> tuple[Pin, ...]:
    """What a projector holds of each plan: x(0) = x_init (*robots, plans..., n), where its initial_state is `fixed`."""
    return (Pin.initial_state(layout, x_init),) if starts_fixed(projector) else ()


@dataclass(frozen=True)
class Sources:
    """What a set may be found from; what is asked for and was not given is refused.

    Args:
        projector: the name that messages call it by.
        given_system, given_recording, given_demonstrations: what there is; trajectories (N, d), in physical units.
    """

    projector: str
    given_system: System | None = None
    given_recording: Recording | None = None
    given_demonstrations: np.ndarray | None = None

    @property
    def system(self) -> System:
        """The robot, or several; raises `ConfigError` if none is given."""
        return self._required(self.given_system, "system")

    @property
    def recording(self) -> Recording:
        """Γ; raises `ConfigError` if none is given."""
        return self._required(self.given_recording, "recording")

    @property
    def demonstrations(self) -> np.ndarray:
        """Trajectories (N, d); raises `ConfigError` if none are given."""
        return self._required(self.given_demonstrations, "dataset")

    def offsetting(self, offset: Offset) -> System | None:
        """The system whose offset is known, or None where none is."""
        return self.system if offset == "known" else None

    def offset(self, offset: Offset) -> np.ndarray | None:
        """c of the system (*robots, n), where the projector is told it."""
        system = self.offsetting(offset)
        return None if system is None else stages_of(system, 1).c[..., 0, :]

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the system, where one is given."""
        return () if self.given_system is None else self.given_system.robots

    def _required(self, value: Given | None, what: str) -> Given:
        if value is None:
            raise ConfigError(
                f"projector {self.projector} needs a {what}, and none is given; choose one with {what}=..."
            )
        return value


class Fitted(ABC, Generic[Found]):
    """A projector that says how it finds its set from its sources.

    Attributes:
        label: the name that messages call it by.
    """

    label: ClassVar[str]

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Found:
        """See `Projector.fit`."""
        return self.find(layout, Sources(self.label, system, recording, demonstrations))

    @abstractmethod
    def find(self, layout: TrajectoryLayout, sources: Sources) -> Found:
        """The set."""


def told(sources: frozenset[str], offset: Offset) -> frozenset[str]:
    """What a projector needs beside its sources: the system, where it is told the offset."""
    return sources | SYSTEM if offset == "known" else sources

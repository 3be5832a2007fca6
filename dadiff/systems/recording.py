"""Recordings: the long experiment Γ = [x(0:S); u(0:S-1)] from which unknown dynamics are learned (Section III-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError, ShapeError
from dadiff.memory import check_fits
from dadiff.randomness import numpy_generator
from dadiff.systems.linear import TimeVarying
from dadiff.systems.system import System


@dataclass(frozen=True)
class Recording:
    """One or several experiments of S inputs each.

    Args:
        states: (*robots, count, S+1, n).
        inputs: (*robots, count, S, m).
        notes: what a reader should know of it, by name, measured with the run.
    """

    states: np.ndarray = field(repr=False)
    inputs: np.ndarray = field(repr=False)
    notes: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        x, u = self.states.shape, self.inputs.shape
        if len(x) < 3 or len(u) != len(x) or x[:-2] != u[:-2] or x[-2] != u[-2] + 1:
            raise ShapeError(f"recording: states {x} and inputs {u}; expected (..., count, S+1, n), (..., count, S, m)")

    @property
    def length(self) -> int:
        """S, the number of inputs."""
        return self.inputs.shape[-2]

    @property
    def count(self) -> int:
        """Number of experiments."""
        return self.inputs.shape[-3]


class Recorder(Protocol):
    """Where recordings come from."""

    def record(self, system: System) -> Recording:
        """Γ of the system, or of each of its robots."""
        ...


@dataclass(frozen=True)
class GaussianExcitation:
    """Experiments from rest under white inputs u(t) ~ N(0, input_std^2 I).

    Args:
        length: S, the number of inputs.
        input_std: in the units of the input.
        process_noise: standard deviation of w(t), a number or one for each state; None takes the system's.
        count: how many experiments, side by side.
        seed: of the inputs and the noise.
    """

    length: int = 100
    input_std: float = 1.0
    process_noise: float | Sequence[float] | None = None
    count: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if self.length < 1 or self.count < 1:
            raise ConfigError(f"recording: length is {self.length} and count {self.count}; both must be at least 1")
        check_fits(16 * self.length * self.count, f"recording: length={self.length}, count={self.count}")
        for name, std in (("input_std", self.input_std), ("process_noise", self.process_noise)):
            if std is not None and not (np.isfinite(std).all() and (np.asarray(std) >= 0).all()):
                raise ConfigError(f"recording: {name} is {std}; a standard deviation is finite and not negative")

    def record(self, system: System) -> Recording:
        """Γ of every robot of the system.

        Raises:
            NotApplicableError: if the system varies in time: what it did says nothing of what it will do.
        """
        if isinstance(system, TimeVarying):
            raise NotApplicableError(
                "recording: the system varies in time, what is learned from recordings does not; use projector=known"
            )
        rng = numpy_generator(self.seed, "recording")
        shape = (*system.robots, self.count, self.length)
        inputs = self.input_std * rng.standard_normal((*shape, system.input_dim))
        std = system.process_noise if self.process_noise is None else self.process_noise
        if np.shape(std) not in ((), (system.state_dim,)):
            raise ShapeError(f"recording: process_noise is {std}; expected a number or {system.state_dim} of them")
        noise = np.asarray(std) * rng.standard_normal((*shape, system.state_dim))
        x_init = np.zeros((*system.robots, self.count, system.state_dim))
        return Recording(system.simulate(x_init, inputs, noise), inputs)

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
from dadiff.systems.rest import at_rest
from dadiff.systems.system import System
from dadiff.trajectory.response import along


@dataclass(frozen=True)
class Recording:
    """One or several experiments of S inputs each, or of at most S where they differ: nan stands after their end.

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
        """S, the number of inputs; of several experiments, those of the longest."""
        return self.inputs.shape[-2]

    @property
    def count(self) -> int:
        """Number of experiments."""
        return self.inputs.shape[-3]

    @property
    def runs(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """States (S+1, n) and inputs (S, m) of each experiment of a single system, as long as it is."""
        lengths = np.isfinite(self.inputs).all(axis=-1).sum(axis=-1)
        return [(x[: S + 1], u[:S]) for x, u, S in zip(self.states, self.inputs, lengths, strict=True)]


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
        inputs, noise = self._drawn(system)
        x_init = np.zeros((*system.robots, self.count, system.state_dim))
        return Recording(system.simulate(x_init, inputs, noise), inputs)

    def _drawn(self, system: System) -> tuple[np.ndarray, np.ndarray]:
        """White inputs (*robots, count, S, m) and process noise (*robots, count, S, n)."""
        rng = numpy_generator(self.seed, "recording")
        shape = (*system.robots, self.count, self.length)
        inputs = self.input_std * rng.standard_normal((*shape, system.input_dim))
        std = system.process_noise if self.process_noise is None else self.process_noise
        if np.shape(std) not in ((), (system.state_dim,)):
            raise ShapeError(f"recording: process_noise is {std}; expected a number or {system.state_dim} of them")
        return inputs, np.asarray(std) * rng.standard_normal((*shape, system.state_dim))


@dataclass(frozen=True)
class FeedbackExcitation(GaussianExcitation):
    """Experiments about a feedback that holds the system where it rests, for those that fall or drift away without.

        u(t) = u_rest + K (x(t) - x_rest) + e(t),   e ~ N(0, input_std^2 I), each draw held for some steps

    K is each robot's LQR gain, as linearised where it rests: whoever recorded it could hold it. Inputs are kept within
    the system's bounds; what is recorded is what was applied.

    Args:
        hold: for how many steps a draw is held.
        state_cost: diagonal of Q, a number for all states, or one for each.
        input_cost: R = input_cost * I.
    """

    hold: int = 1
    state_cost: float | Sequence[float] = 1.0
    input_cost: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold < 1 or not self.input_cost > 0 or not (np.asarray(self.state_cost) >= 0).all():
            raise ConfigError(
                f"recording: hold is {self.hold}, state_cost {self.state_cost} and input_cost {self.input_cost}; "
                "expected at least 1, weights that are not negative, and a positive one"
            )

    def record(self, system: System) -> Recording:
        """Γ of every robot of the system."""
        dither, noise = self._drawn(system)
        dither = dither[..., np.arange(self.length) // self.hold, :]
        rest, still = at_rest(system, np.zeros((*system.robots, 1, 0)))
        K, (low, high) = self.gain(system, rest, still), system.bounds.of_inputs(system.input_dim)
        states, inputs = np.empty((*dither.shape[:-2], self.length + 1, system.state_dim)), np.empty_like(dither)
        states[..., 0, :] = rest
        for t in range(self.length):
            wanted = still + along(K, states[..., t, :] - rest) + dither[..., t, :]
            inputs[..., t, :] = np.clip(wanted, low, high)
            states[..., t + 1, :] = system.step(states[..., t, :], inputs[..., t, :], t) + noise[..., t, :]
        return Recording(states, inputs)

    def gain(self, system: System, rest: np.ndarray, still: np.ndarray) -> np.ndarray:
        """K (*robots, m, n) about x (*robots, 1, n) and u (*robots, 1, m)."""
        import control

        n, m = system.state_dim, system.input_dim
        A, B, _ = system.linearise(rest, still)
        Q = np.diag(np.broadcast_to(np.asarray(self.state_cost, dtype=np.float64), n))
        pairs = zip(A.reshape(-1, n, n), B.reshape(-1, n, m), strict=True)
        K = [-control.dlqr(a, b, Q, self.input_cost * np.eye(m))[0] for a, b in pairs]
        return np.reshape(K, (*system.robots, m, n))

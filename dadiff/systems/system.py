"""What a system is: one step of the dynamics, their linearisation, and what is known of states and inputs.

    x(t+1) = f_t(x(t), u(t)) + w(t)

A system may be several robots of equal sizes. Their number is stated, never guessed from an array's shape, and their
dimension comes first: arrays are (*robots, ..., n) with `robots` = () or (R,). Arrays are numpy float64.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Self

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError, ShapeError
from dadiff.trajectory.layout import TrajectoryLayout

Times = int | np.ndarray
Limits = Mapping[str, float | Sequence[float]]
"""Bounds as they stand in yaml: any of input_low, input_high, state_low, state_high."""


@dataclass(frozen=True)
class Bounds:
    """low <= value <= high for inputs and states; a number holds for all entries, infinite is none.

    Args:
        input_low, input_high: a number or (m,), in the units of the inputs.
        state_low, state_high: a number or (n,), in the units of the states.

    Raises:
        ConfigError: if a bound is nan, or a lower one exceeds the upper one.
    """

    input_low: float | np.ndarray = -np.inf
    input_high: float | np.ndarray = np.inf
    state_low: float | np.ndarray = -np.inf
    state_high: float | np.ndarray = np.inf

    def __post_init__(self) -> None:
        for what in ("input", "state"):
            low, high = (np.asarray(getattr(self, f"{what}_{end}"), dtype=np.float64) for end in ("low", "high"))
            if np.ndim(low) and np.ndim(high) and low.shape != high.shape:
                raise ShapeError(f"system: {what}_low has shape {low.shape}, {what}_high {high.shape}; expected equal")
            if not (low <= high).all():
                raise ConfigError(
                    f"system: {what}_low is {low.tolist()}, {what}_high {high.tolist()}; need low <= high"
                )

    def of_inputs(self, input_dim: int) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), each (m,)."""
        return _spread(self.input_low, input_dim, "input_low"), _spread(self.input_high, input_dim, "input_high")

    def of_states(self, state_dim: int) -> tuple[np.ndarray, np.ndarray]:
        """(low, high), each (n,)."""
        return _spread(self.state_low, state_dim, "state_low"), _spread(self.state_high, state_dim, "state_high")

    @classmethod
    def of(cls, limits: Limits | None) -> Bounds:
        """From a mapping with any of the four; None bounds nothing.

        Raises:
            ConfigError: on a name that is none of the four.
        """
        known = [field.name for field in fields(cls)]
        for name in limits or {}:
            if name not in known:
                raise ConfigError(f"system: bounds.{name} is not known; expected {', '.join(known)}")
        return cls(**{name: np.asarray(value, dtype=np.float64) for name, value in (limits or {}).items()})

    def tightened(self, share: float) -> Bounds:
        """Moved towards each other by a share of half their distance; what has one bound only keeps it.

        Args:
            share: in [0, 1).
        """
        moved: dict[str, np.ndarray] = {}
        for what in ("input", "state"):
            low, high = (np.asarray(getattr(self, f"{what}_{end}"), dtype=np.float64) for end in ("low", "high"))
            with np.errstate(invalid="ignore"):
                by = np.where(np.isfinite(low) & np.isfinite(high), share * (high - low) / 2, 0.0)
            moved |= {f"{what}_low": low + by, f"{what}_high": high - by}
        return Bounds(**moved)

    @property
    def any(self) -> bool:
        """Whether anything is bounded."""
        return any(np.isfinite(bound).any() for bound in vars(self).values())


def turned(points: np.ndarray, angle: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Points (k, 2) of a body turned by angles (...) and moved to places (..., 2), in the plane: (..., k, 2)."""
    cos, sin = np.cos(angle)[..., None], np.sin(angle)[..., None]
    x, y = points[:, 0], points[:, 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + place[..., None, :]


def _spread(value: float | np.ndarray, size: int, name: str) -> np.ndarray:
    """(size,) from a number or (size,)."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (size,)):
        raise ShapeError(f"system: {name} has shape {array.shape}; expected a number or ({size},)")
    return np.broadcast_to(array, size)


def robots_of(given: int | Sequence[int] | None) -> tuple[int, ...]:
    """(R,) from R or (R,), () from None or ()."""
    return () if given is None else tuple(np.atleast_1d(np.asarray(given, dtype=int)).tolist())


@dataclass(frozen=True, kw_only=True)
class System(ABC):
    """One system, or a fleet of them. Subclasses give the sizes, a step and its linearisation.

    Args:
        process_noise: standard deviation of w(t) per step, in the units of the states; a number, or (n,).
        time_step: seconds between x(t) and x(t+1), where they are known.
        bounds: on states and inputs; what enforces them is the planner's.
        state_names, input_names, state_units, input_units: for figures and tables; one for each, or none.
    """

    process_noise: float | Sequence[float] | np.ndarray = 0.0
    time_step: float | None = None
    bounds: Bounds = field(default_factory=Bounds)
    state_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    state_units: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()

    @property
    @abstractmethod
    def state_dim(self) -> int:
        """n."""

    @property
    @abstractmethod
    def input_dim(self) -> int:
        """m."""

    @property
    def robots(self) -> tuple[int, ...]:
        """(R,) for R robots, () for a single system."""
        return ()

    @abstractmethod
    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """f_t(x, u) of shape (*robots, ..., n), without noise.

        Args:
            x: (*robots, ..., n).
            u: (*robots, ..., m).
            t: the time of each point, a whole number or (...) of them; only time-varying systems look at it.
        """

    @abstractmethod
    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(A, B, c) at each point, with c = f(x, u) - A x - B u; arguments as for `step`.

        Returns:
            A (*robots, ..., n, n), B (*robots, ..., n, m), c (*robots, ..., n).
        """

    def simulate(self, x_init: np.ndarray, inputs: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Repeat `step` from x_init, without noise unless it is given.

        Args:
            x_init: (*robots, ..., n); what stands between may broadcast against the inputs.
            inputs: (*robots, ..., T, m).
            noise: (*robots, ..., T, n) or None.

        Returns:
            States x(0:T) of shape (*robots, ..., T+1, n). Values that leave float range stay inf or nan.
        """
        lead = np.broadcast_shapes(x_init.shape[:-1], inputs.shape[:-2])
        states = np.empty((*lead, inputs.shape[-2] + 1, x_init.shape[-1]))
        states[..., 0, :] = x_init
        inputs = np.broadcast_to(inputs, (*lead, *inputs.shape[-2:]))
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(inputs.shape[-2]):
                following = self.step(states[..., t, :], inputs[..., t, :], t)
                states[..., t + 1, :] = following if noise is None else following + noise[..., t, :]
        return states

    def replay(self, x_init: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """What becomes of planned inputs on the robot itself, which may differ from what it was planned for with.

        Arguments and result are those of `simulate`, which it is unless a subclass knows better.
        """
        return self.simulate(x_init, inputs)

    def singular(self, states: np.ndarray) -> np.ndarray | None:
        """At how many steps of states (..., T+1, n) a change of coordinates breaks down, (...); None without one."""
        return None

    def outline(self, states: np.ndarray) -> np.ndarray:
        """What a picture shows of the robot at states (..., n): a line through points (..., k, 2) of the plane.

        One point where nothing is known of the robot's shape.
        """
        return states[..., None, :2]

    def position(self, states: np.ndarray) -> np.ndarray:
        """Where a picture follows the robot at states (..., n), (..., 2), in the plane of its outline."""
        return states[..., :2]

    @property
    def plane(self) -> tuple[str, ...]:
        """What the two axes of that plane are called; () where it is that of the first two states."""
        return ()

    def frames(self, states: np.ndarray) -> np.ndarray | None:
        """Rendered pictures (N, height, width, 3), uint8, of states (N, n); None where nothing renders them."""
        return None

    def take(self, index: Sequence[int] | np.ndarray) -> Self:
        """The robots at `index`, as a system of so many.

        Raises:
            NotApplicableError: if its robots are not told apart, or it is a single one.
        """
        raise NotApplicableError(
            f"system: {type(self).__name__} does not give some of its robots; use one of a family, such as "
            "system=planar_quadrotors"
        )

    def layout(self, horizon: int) -> TrajectoryLayout:
        """The layout of this system's trajectories over T inputs, with its names and units."""
        return TrajectoryLayout(
            self.state_dim,
            self.input_dim,
            horizon,
            state_names=self.state_names,
            input_names=self.input_names,
            state_units=self.state_units,
            input_units=self.input_units,
        )

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Draws of w: (*shape, n)."""
        return np.asarray(self.process_noise) * rng.standard_normal((*shape, self.state_dim))

    def check(self) -> None:
        """Raise unless noise, time step, bounds, names and units fit n and m; to be called in `__post_init__`.

        Raises:
            ConfigError: if the noise is negative or not finite, or the time step is not positive.
            ShapeError: if there is not one entry for each state or input.
        """
        noise = np.asarray(self.process_noise, dtype=np.float64)
        object.__setattr__(self, "process_noise", noise if noise.ndim else float(noise))
        if not (noise >= 0).all() or np.isinf(noise).any():
            raise ConfigError(
                f"system: process_noise is {self.process_noise}; a standard deviation is finite and not negative"
            )
        if noise.shape not in ((), (self.state_dim,)):
            raise ShapeError(f"system: process_noise has shape {noise.shape}; expected a number or ({self.state_dim},)")
        if self.time_step is not None and not 0 < self.time_step < np.inf:
            raise ConfigError(f"system: time_step is {self.time_step}; it must be positive (seconds)")
        self.bounds.of_inputs(self.input_dim), self.bounds.of_states(self.state_dim)
        self.layout(1)  # which counts names and units

"""Families of robots: systems whose parameters are drawn from ranges, so that one data set holds many dynamics.

All robots of a family share n and m. A family says which parameters it has and how its robots, or their (A, B), follow
from them; drawing robots inside and outside the ranges is the same for all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems.linear import Linear
from dadiff.systems.system import Bounds, Limits, System


@dataclass(frozen=True, kw_only=True)
class Robots(System):
    """A fleet, and the parameters that tell its robots apart.

    Args:
        parameters: name -> (robots,).
        distance: how far each lies outside of its family's ranges, in their widths, (robots,); see `Ranges.distance`.
        family: of which they were drawn.
    """

    parameters: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    distance: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    family: Family[Any] | None = field(default=None, repr=False)

    @property
    def nominal(self) -> Robots:
        """As many robots of the middle of the family's ranges.

        Raises:
            ConfigError: if they are of no family.
        """
        if self.family is None:
            raise ConfigError("system: these robots are of no family, so that none of them is nominal")
        return self.family.robots(np.tile(self.family.ranges.middle, (*self.robots, 1)))

    @property
    def parameter_table(self) -> np.ndarray:
        """(robots, p), in the order of their names."""
        return np.stack(list(self.parameters.values()), axis=-1)

    def take(self, index: Sequence[int] | np.ndarray) -> Self:
        """The robots at `index`."""
        parameters = {name: values[index] for name, values in self.parameters.items()}
        return replace(self, parameters=parameters, distance=self.distance[index], **self._taken(index))

    @abstractmethod
    def _taken(self, index: Sequence[int] | np.ndarray) -> dict[str, Any]:
        """Other fields of the robots at `index`, by name."""

    def most_different(self, count: int) -> np.ndarray:
        """Indices of at most `count` robots: the one farthest out, then each as far as possible from those before."""
        table = self.parameter_table
        table = (table - table.mean(axis=0)) / np.maximum(table.std(axis=0), np.finfo(float).tiny)
        chosen = [int(np.linalg.norm(table, axis=-1).argmax())]
        while len(chosen) < min(count, len(table)):
            apart = np.linalg.norm(table[:, None] - table[chosen], axis=-1).min(axis=-1)
            chosen.append(int(apart.argmax()))
        return np.array(chosen)


@dataclass(frozen=True, kw_only=True)
class LinearRobots(Linear, Robots):
    """A fleet of linear systems."""

    take = Robots.take

    def _taken(self, index: Sequence[int] | np.ndarray) -> dict[str, Any]:
        arrays = {name: getattr(self, name)[index] for name in ("A", "B", "c")}
        return {**arrays, "robots": arrays["A"].shape[:1]}


@dataclass(frozen=True)
class Ranges:
    """low <= parameter <= high for each of p named parameters.

    Args:
        bounds: name -> (low, high); equal bounds hold a parameter fixed.
    """

    bounds: Mapping[str, Sequence[float]]

    def __post_init__(self) -> None:
        for name, bounds in self.bounds.items():
            if len(bounds) != 2 or not -np.inf < bounds[0] <= bounds[1] < np.inf:
                raise ConfigError(
                    f"system: the range of {name} is {list(bounds)}; expected [low, high], low <= high, both finite"
                )

    @property
    def low(self) -> np.ndarray:
        """(p,)."""
        return np.array([low for low, _ in self.bounds.values()], dtype=np.float64)

    @property
    def high(self) -> np.ndarray:
        """(p,)."""
        return np.array([high for _, high in self.bounds.values()], dtype=np.float64)

    @property
    def middle(self) -> np.ndarray:
        """(p,)."""
        return (self.low + self.high) / 2

    def inside(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Uniform draws, (count, p)."""
        return rng.uniform(self.low, self.high, size=(count, len(self.bounds)))

    def stretched(self, factor: float) -> tuple[np.ndarray, np.ndarray]:
        """Bounds moved apart by a factor f: [1, 2] to [1/f, 2f], [-1, 2] to [-f, 2f], [0, 3] to [0, 3f]."""
        low = np.where(self.low < 0, self.low * factor, self.low / factor)
        high = np.where(self.high > 0, self.high * factor, self.high / factor)
        return low, high

    def outside(self, count: int, factor: float, rng: np.random.Generator) -> np.ndarray:
        """Draws from the stretched ranges with one parameter, chosen at random, outside its own range; (count, p).

        Raises:
            ConfigError: if stretching moves no bound.
        """
        low, high = self.stretched(factor)
        below, above = self.low - low, high - self.high
        movable = np.flatnonzero(below + above > 0)
        if count and not movable.size:
            raise ConfigError(f"system: ranges {dict(self.bounds)} stretched by {factor} leave no room outside")
        values = rng.uniform(low, high, size=(count, len(self.bounds)))
        if count:
            j = rng.choice(movable, count)
            beyond = rng.uniform(0, (below + above)[j])
            left = beyond < below[j]
            values[np.arange(count), j] = np.where(left, self.low[j] - beyond, self.high[j] + beyond - below[j])
        return values

    def distance(self, values: np.ndarray) -> np.ndarray:
        """How far (..., p) lies outside, in widths of the ranges: 0 inside; (...)."""
        width = np.where(self.high > self.low, self.high - self.low, 1.0)
        excess = np.maximum(np.maximum(self.low - values, values - self.high), 0) / width
        return np.linalg.norm(excess, axis=-1)


Drawn = TypeVar("Drawn", bound=Robots)


class Family(ABC, Generic[Drawn]):
    """A dataclass of ranges and constants, with a yaml in `conf/system/`."""

    state_names: ClassVar[tuple[str, ...]] = ()
    input_names: ClassVar[tuple[str, ...]] = ()

    time_step: float
    process_noise: float | Sequence[float]
    bounds: Limits | None

    def check(self) -> None:
        """Raise `ConfigError` on an empty range (in `Ranges`), a time step or a noise that makes no sense."""
        if not self.ranges.bounds or not self.time_step > 0 or not (np.asarray(self.process_noise) >= 0).all():
            raise ConfigError(
                f"system: time_step is {self.time_step} and process_noise {self.process_noise}; "
                "need a positive number of seconds and a standard deviation of at least 0"
            )

    @property
    @abstractmethod
    def ranges(self) -> Ranges:
        """What is drawn."""

    @abstractmethod
    def robots(self, values: np.ndarray) -> Drawn:
        """The robots with parameters (robots, p)."""

    def named(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """One array (robots,) a parameter from (robots, p), by name, in the order of `ranges`."""
        return dict(zip(self.ranges.bounds, np.moveaxis(values, -1, 0), strict=True))

    def inside(self, count: int, rng: np.random.Generator) -> Drawn:
        """`count` robots drawn uniformly from the ranges."""
        return self.robots(self.ranges.inside(count, rng))

    def outside(self, count: int, factor: float, rng: np.random.Generator) -> Drawn:
        """`count` robots from outside the ranges, see `Ranges.outside`."""
        return self.robots(self.ranges.outside(count, factor, rng))


class LinearFamily(Family[LinearRobots]):
    """A family of linear systems: (A, B) follow from the parameters."""

    @abstractmethod
    def dynamics(self, *parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (robots, n, n) and B (robots, n, m) from one array (robots,) a parameter, in the order of `ranges`."""

    def robots(self, values: np.ndarray) -> LinearRobots:
        """The robots with parameters (robots, p)."""
        parameters = self.named(values)
        A, B = self.dynamics(*parameters.values())
        return LinearRobots(
            A,
            B,
            robots=A.shape[:1],
            process_noise=self.process_noise,
            time_step=self.time_step,
            bounds=Bounds.of(self.bounds),
            state_names=self.state_names,
            input_names=self.input_names,
            parameters=parameters,
            distance=self.ranges.distance(values),
            family=self,
        )


def blocks(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """A matrix a robot from blocks of coefficients (robots,); each stands for itself times I_2, in the plane."""
    coefficients = np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)
    return np.kron(coefficients, np.eye(2))


@dataclass(frozen=True)
class DampedIntegrators(LinearFamily):
    """Planar robots with viscous damping c and input gain b, forward Euler; n = 4, m = 2.

        p(t+1) = p(t) + h v(t),    v(t+1) = (1 - h c) v(t) + h b u(t)

    Args:
        damping: range of c, 1/s.
        gain: range of b.
        time_step: h, in seconds.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: any of input_low, input_high, state_low, state_high; a number, or one for each entry.
    """

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    input_names: ClassVar[tuple[str, ...]] = ("ux", "uy")

    damping: Sequence[float] = (0.0, 3.0)
    gain: Sequence[float] = (0.4, 2.0)
    time_step: float = 0.1
    process_noise: float | Sequence[float] = 0.01
    bounds: Limits | None = None

    def __post_init__(self) -> None:
        self.check()

    @property
    def ranges(self) -> Ranges:
        """Of c and b."""
        return Ranges({"damping": self.damping, "gain": self.gain})

    def dynamics(self, *parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See the class."""
        (c, b), h = parameters, self.time_step
        one, zero = np.ones_like(c), np.zeros_like(c)
        return blocks([[one, h * one], [zero, 1 - h * c]]), blocks([[zero], [h * b]])


@dataclass(frozen=True)
class RotatedIntegrators(LinearFamily):
    """Damped integrators that push in a direction turned by a; n = 4, m = 2. No axis can be planned for alone.

        p(t+1) = p(t) + h v(t),    v(t+1) = (1 - h c) v(t) + h b [[cos a, -sin a], [sin a, cos a]] u(t)

    Args:
        damping: range of c, 1/s.
        gain: range of b.
        angle: range of a, radians.
        time_step: h, in seconds.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: any of input_low, input_high, state_low, state_high; a number, or one for each entry.
    """

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy")
    input_names: ClassVar[tuple[str, ...]] = ("ux", "uy")

    damping: Sequence[float] = (0.0, 3.0)
    gain: Sequence[float] = (0.4, 2.0)
    angle: Sequence[float] = (-1.0, 1.0)
    time_step: float = 0.1
    process_noise: float | Sequence[float] = 0.01
    bounds: Limits | None = None

    def __post_init__(self) -> None:
        self.check()

    @property
    def ranges(self) -> Ranges:
        """Of c, b and a."""
        return Ranges({"damping": self.damping, "gain": self.gain, "angle": self.angle})

    def dynamics(self, *parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See the class."""
        c, b, a = parameters
        A, B = DampedIntegrators(time_step=self.time_step).dynamics(c, b)
        turn = np.stack([np.stack([np.cos(a), -np.sin(a)], -1), np.stack([np.sin(a), np.cos(a)], -1)], -2)
        return A, B @ turn


@dataclass(frozen=True)
class LaggedIntegrators(LinearFamily):
    """Damped integrators whose force f follows the input with a lag; third order, n = 6, m = 2.

        p(t+1) = p(t) + h v(t),  v(t+1) = (1 - h c) v(t) + h f(t),  f(t+1) = e^(-h/l) f(t) + (1 - e^(-h/l)) b u(t)

    Args:
        damping: range of c, 1/s.
        gain: range of b.
        lag: range of l, in seconds, positive.
        time_step: h, in seconds.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: any of input_low, input_high, state_low, state_high; a number, or one for each entry.
    """

    state_names: ClassVar[tuple[str, ...]] = ("x", "y", "vx", "vy", "fx", "fy")
    input_names: ClassVar[tuple[str, ...]] = ("ux", "uy")

    damping: Sequence[float] = (0.0, 3.0)
    gain: Sequence[float] = (0.4, 2.0)
    lag: Sequence[float] = (0.05, 0.4)
    time_step: float = 0.1
    process_noise: float | Sequence[float] = 0.01
    bounds: Limits | None = None

    def __post_init__(self) -> None:
        self.check()
        if not self.lag[0] > 0:
            raise ConfigError(f"system: the range of lag is {list(self.lag)}; a lag is positive (seconds)")

    @property
    def ranges(self) -> Ranges:
        """Of c, b and l."""
        return Ranges({"damping": self.damping, "gain": self.gain, "lag": self.lag})

    def dynamics(self, *parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See the class."""
        (c, b, lag), h = parameters, self.time_step
        one, zero, keep = np.ones_like(c), np.zeros_like(c), np.exp(-h / lag)
        A = blocks([[one, h * one, zero], [zero, 1 - h * c, h * one], [zero, zero, keep]])
        return A, blocks([[zero], [zero], [(1 - keep) * b]])

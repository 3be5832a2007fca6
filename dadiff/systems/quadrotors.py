"""Planar quadrotors: six states, two inputs, and a family of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems.families import Family, Ranges, Robots
from dadiff.systems.nonlinear import STAGES, Continuous, affine
from dadiff.systems.system import Bounds, Limits, Times, turned

GRAVITY = 9.81  # m/s^2
ROTORS_AND_BEAM = 0.1 * np.array([[-4, 1], [-2, 1], [-3, 1], [-3, 0], [3, 0], [3, 1], [2, 1], [4, 1]])  # m


@dataclass(frozen=True, kw_only=True)
class PlanarQuadrotor(Continuous):
    """A quadrotor in a vertical plane, trimmed to hover at u = 0; n = 6, m = 2.

        p' = v,   v' = (g + a u_1) [-sin q; cos q] - [0; g] - c v,   q' = w,   w' = b u_2

    x = [p_x, p_z, q, v_x, v_z, w] in m, rad, m/s, rad/s; u_1 is thrust beyond hover a mass (m/s^2), u_2 torque an
    inertia (rad/s^2), each as the nominal robot (a = b = 1) would answer to it.

    Args:
        thrust_gain, torque_gain, drag: a, b and c (1/s): a number, or (R,) for R robots, all alike.
    """

    thrust_gain: float | np.ndarray = field(default=1.0, repr=False)
    torque_gain: float | np.ndarray = field(default=1.0, repr=False)
    drag: float | np.ndarray = field(default=0.0, repr=False)
    time_step: float | None = 0.05
    state_names: tuple[str, ...] = ("x", "z", "angle", "velocity x", "velocity z", "angular rate")
    input_names: tuple[str, ...] = ("thrust", "torque")
    state_units: tuple[str, ...] = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    input_units: tuple[str, ...] = ("m/s²", "rad/s²")

    @property
    def state_dim(self) -> int:
        """6."""
        return 6

    @property
    def input_dim(self) -> int:
        """2."""
        return 2

    @property
    def robots(self) -> tuple[int, ...]:
        """(R,) where parameters are arrays."""
        return np.shape(self.thrust_gain)

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """As `Continuous.step`, in machine code."""
        from dadiff.systems.quadrotor_steps import steps

        return steps(*self._flat(x, u)).reshape(x.shape)

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `Continuous.linearise`, in machine code."""
        from dadiff.systems.quadrotor_steps import linearised

        J, following = linearised(*self._flat(x, u))
        J = J.reshape(*x.shape, 8)
        return affine(J[..., :6], J[..., 6:], following.reshape(x.shape), x, u)

    def _flat(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]:
        """What the compiled functions ask for; points along one dimension after the robots'."""
        lead = (len(self._each), -1)
        return x.reshape(*lead, 6), u.reshape(*lead, 2), self._each, GRAVITY, self._stages

    @cached_property
    def _each(self) -> np.ndarray:
        """a, b and c of each robot, (R, 3); one row for a single system."""
        return np.stack(np.broadcast_arrays(*np.atleast_1d(self.thrust_gain, self.torque_gain, self.drag)), -1) * 1.0

    @cached_property
    def _stages(self) -> np.ndarray:
        """Of the integrator: shares and weights, (S, 2), in seconds."""
        return (self.time_step or 0.0) * np.array(STAGES[self.integrator])

    def derivative(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt, see the class."""
        a, b, c = self._parameters(x)
        rate = np.empty_like(x)
        angle, thrust = x[..., 2], GRAVITY + a * u[..., 0]
        rate[..., :3] = x[..., 3:]
        rate[..., 3] = -thrust * np.sin(angle) - c * x[..., 3]
        rate[..., 4] = thrust * np.cos(angle) - GRAVITY - c * x[..., 4]
        rate[..., 5] = b * u[..., 1]
        return rate

    def derivative_jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of `derivative`."""
        a, b, c = self._parameters(x)
        sin, cos, thrust = np.sin(x[..., 2]), np.cos(x[..., 2]), GRAVITY + a * u[..., 0]
        f_x, f_u = np.zeros((*x.shape, 6)), np.zeros((*x.shape, 2))
        f_x[..., [0, 1, 2], [3, 4, 5]] = 1.0
        f_x[..., 3, 2], f_x[..., 4, 2] = -thrust * cos, -thrust * sin
        f_x[..., 3, 3] = f_x[..., 4, 4] = -c
        f_u[..., 3, 0], f_u[..., 4, 0], f_u[..., 5, 1] = -a * sin, a * cos, b
        return f_x, f_u

    def outline(self, states: np.ndarray) -> np.ndarray:
        """A beam, and a rotor at each end."""
        return turned(ROTORS_AND_BEAM, states[..., 2], states[..., :2])

    def _parameters(self, x: np.ndarray) -> list[float | np.ndarray]:
        """a, b, c with as many dimensions as the points have: robots first."""
        values = [self.thrust_gain, self.torque_gain, self.drag]
        if not self.robots:
            return values
        return [np.reshape(value, (*self.robots, *(1,) * (x.ndim - 2))) for value in values]


@dataclass(frozen=True, kw_only=True)
class Quadrotors(PlanarQuadrotor, Robots):
    """A fleet of planar quadrotors."""

    def _taken(self, index: Sequence[int] | np.ndarray) -> dict[str, Any]:
        return {name: getattr(self, name)[index] for name in ("thrust_gain", "torque_gain", "drag")}


@dataclass(frozen=True)
class PlanarQuadrotors(Family[Quadrotors]):
    """Planar quadrotors that answer differently to the same inputs, see `PlanarQuadrotor`; n = 6, m = 2.

    Args:
        thrust_gain, torque_gain: ranges of a and b, positive.
        drag: range of c, 1/s.
        time_step: of the integrator (RK4), in seconds.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: any of input_low, input_high, state_low, state_high; a number, or one for each entry.
    """

    state_names: ClassVar[tuple[str, ...]] = PlanarQuadrotor.state_names
    input_names: ClassVar[tuple[str, ...]] = PlanarQuadrotor.input_names

    thrust_gain: Sequence[float] = (0.5, 1.5)
    torque_gain: Sequence[float] = (0.4, 2.0)
    drag: Sequence[float] = (0.0, 1.0)
    time_step: float = 0.05
    process_noise: float | Sequence[float] = 0.01
    bounds: Limits | None = None

    def __post_init__(self) -> None:
        self.check()
        for name in ("thrust_gain", "torque_gain"):
            if not getattr(self, name)[0] > 0:
                raise ConfigError(f"system: the range of {name} is {list(getattr(self, name))}; a gain is positive")

    @property
    def ranges(self) -> Ranges:
        """Of a, b and c."""
        return Ranges({"thrust_gain": self.thrust_gain, "torque_gain": self.torque_gain, "drag": self.drag})

    def robots(self, values: np.ndarray) -> Quadrotors:
        """The robots with parameters (robots, p)."""
        thrust_gain, torque_gain, drag = np.moveaxis(values, -1, 0)
        return Quadrotors(
            thrust_gain=thrust_gain,
            torque_gain=torque_gain,
            drag=drag,
            time_step=self.time_step,
            process_noise=self.process_noise,
            bounds=Bounds.of(self.bounds),
            parameters=self.named(values),
            distance=self.ranges.distance(values),
            family=self,
        )

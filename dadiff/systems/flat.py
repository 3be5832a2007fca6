"""Flat systems: nonlinear robots that are planned for in coordinates in which they are linear (feedback linearisation).

A transformation takes robot coordinates (x, u) to flat ones (z, w), in which z moves as an integrator driven by w, and
back. Plans are made for the integrator; the robot follows its inputs through the inverse, with its own integrator at a
finer rate. Another flat robot is one class of two methods.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems.integrators import double_integrator
from dadiff.systems.linear import Linear
from dadiff.systems.nonlinear import Continuous, integrate
from dadiff.systems.system import Bounds, Limits, turned

ARROWHEAD = 0.1 * np.array([[-1.5, 1.2], [2, 0], [-1.5, -1.2], [-0.8, 0], [-1.5, 1.2]])  # m


@dataclass(frozen=True, kw_only=True)
class Unicycle(Continuous):
    """A robot that drives where it looks; n = 4, m = 2.

        p' = v [cos q; sin q],   q' = w,   v' = a

    x = [p_x, p_y, q, v] in m, rad, m/s; u = [a, w] in m/s^2, rad/s.
    """

    time_step: float | None = 0.1
    state_names: tuple[str, ...] = ("x", "y", "heading", "speed")
    input_names: tuple[str, ...] = ("acceleration", "turn rate")
    state_units: tuple[str, ...] = ("m", "m", "rad", "m/s")
    input_units: tuple[str, ...] = ("m/s²", "rad/s")

    @property
    def state_dim(self) -> int:
        """4."""
        return 4

    @property
    def input_dim(self) -> int:
        """2."""
        return 2

    def derivative(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt, see the class."""
        heading, speed = x[..., 2], x[..., 3]
        return np.stack([speed * np.cos(heading), speed * np.sin(heading), u[..., 1], u[..., 0]], axis=-1)

    def derivative_jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of `derivative`."""
        cos, sin, speed = np.cos(x[..., 2]), np.sin(x[..., 2]), x[..., 3]
        f_x, f_u = np.zeros((*x.shape, 4)), np.zeros((*x.shape, 2))
        f_x[..., 0, 2], f_x[..., 0, 3] = -speed * sin, cos
        f_x[..., 1, 2], f_x[..., 1, 3] = speed * cos, sin
        f_u[..., 2, 1] = f_u[..., 3, 0] = 1.0
        return f_x, f_u

    def outline(self, states: np.ndarray) -> np.ndarray:
        """An arrowhead that points where it looks."""
        return turned(ARROWHEAD, states[..., 2], states[..., :2])


class Transformation(Protocol):
    """Between robot coordinates x (..., n), u (..., m) and flat ones z (..., n), w (..., m)."""

    def forward(self, x: np.ndarray) -> np.ndarray:
        """z from x."""
        ...

    def start(self, z: np.ndarray) -> np.ndarray:
        """x from z, where the robot is put."""
        ...

    def inverse(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """u with which the robot at x moves its flat state as w asks."""
        ...

    def singular(self, z: np.ndarray) -> np.ndarray:
        """Where the inverse is not defined and its continuation is used, (...)."""
        ...


@dataclass(frozen=True)
class UnicycleTransformation:
    """z = [p; p'] and w = p'' of a `Unicycle`.

        a = [cos q, sin q] w,    v turn rate = [-sin q, cos q] w

    At v = 0 no turn rate moves p'' sideways. Below a speed e, 1/v is continued by 2 v / (v^2 + e^2), which is at
    most 1/e: the robot then turns as it can, and leaves the plan.

    Args:
        least_speed: e, in m/s; a speed below it counts as singular.
    """

    least_speed: float = 0.05

    def __post_init__(self) -> None:
        if not self.least_speed > 0:
            raise ConfigError(f"system: least_speed is {self.least_speed}; it must be positive (m/s)")

    def forward(self, x: np.ndarray) -> np.ndarray:
        """[p; v cos q, v sin q]."""
        heading, speed = x[..., 2], x[..., 3]
        return np.stack([x[..., 0], x[..., 1], speed * np.cos(heading), speed * np.sin(heading)], axis=-1)

    def start(self, z: np.ndarray) -> np.ndarray:
        """[p; arg p'; |p'|]: it looks where it goes."""
        heading, speed = np.arctan2(z[..., 3], z[..., 2]), np.hypot(z[..., 2], z[..., 3])
        return np.stack([z[..., 0], z[..., 1], heading, speed], axis=-1)

    def inverse(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """[acceleration, turn rate], see the class."""
        cos, sin, speed = np.cos(x[..., 2]), np.sin(x[..., 2]), x[..., 3]
        along, across = cos * w[..., 0] + sin * w[..., 1], cos * w[..., 1] - sin * w[..., 0]
        over_speed = np.where(
            np.abs(speed) >= self.least_speed,
            1 / np.where(speed == 0, 1.0, speed),
            2 * speed / (speed**2 + self.least_speed**2),
        )
        return np.stack([along, across * over_speed], axis=-1)

    def singular(self, z: np.ndarray) -> np.ndarray:
        """Whether the speed is below the least."""
        return np.hypot(z[..., 2], z[..., 3]) < self.least_speed


@dataclass(frozen=True, kw_only=True)
class Flat(Linear):
    """A robot in flat coordinates: linear when it is planned for, itself when plans are replayed.

    Args:
        robot: the nonlinear system.
        transformation: between its coordinates and the flat ones.
        substeps: of the robot's integrator in one time step.
    """

    robot: Continuous = field(repr=False)
    transformation: Transformation
    substeps: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.substeps < 2 or self.substeps % 2:
            raise ConfigError(f"system: substeps is {self.substeps}; expected an even number, 2 or more")

    def replay(self, x_init: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Flat states (..., T+1, n) of the robot that is driven by flat inputs through the inverse transformation.

        By forward Euler the velocity v(t) is that of the whole step, so that of its middle: w(t) acts from the middle
        of step t to that of step t + 1, which keeps positions within h^2 |w| / 8 of the plan's.
        """
        T, half, h = inputs.shape[-2], self.substeps // 2, (self.time_step or 0.0) / self.substeps
        lead = np.broadcast_shapes(x_init.shape[:-1], inputs.shape[:-2])
        states = np.empty((*lead, T + 1, x_init.shape[-1]))
        states[..., 0, :] = x_init
        x, before = self.transformation.start(states[..., 0, :]), np.zeros_like(inputs[..., 0, :])
        with np.errstate(over="ignore", invalid="ignore"):
            for t in range(T):
                for k in range(self.substeps):
                    w = before if k < half else inputs[..., t, :]
                    x = integrate(self._driven, x, np.broadcast_to(w, (*lead, w.shape[-1])), h, self.robot.integrator)
                states[..., t + 1, :] = self.transformation.forward(x)
                before = inputs[..., t, :]
        return states

    def outline(self, states: np.ndarray) -> np.ndarray:
        """Of the robot at flat states (..., n)."""
        return self.robot.outline(self.transformation.start(states))

    def _driven(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """dx/dt of the robot under the transformation's feedback."""
        return self.robot.derivative(x, self.transformation.inverse(x, w))

    def singular(self, states: np.ndarray) -> np.ndarray:
        """How many steps of flat states (..., T+1, n) are singular, (...)."""
        return self.transformation.singular(states).sum(axis=-1)


def unicycles(
    time_step: float = 0.1, substeps: int = 10, least_speed: float = 0.05, bounds: Limits | None = None
) -> Flat:
    """A unicycle that is planned for as a planar double integrator, without process noise.

    Args:
        time_step: of plans, in seconds.
        substeps: of the robot's own integrator (RK4) in one time step.
        least_speed: below which the transformation is singular, in m/s.
        bounds: of the flat coordinates: input_low, input_high, state_low, state_high.
    """
    flat = double_integrator(time_step=time_step, process_noise=0.0)
    named = {name: getattr(flat, name) for name in ("state_names", "input_names", "state_units", "input_units")}
    return Flat(
        flat.A,
        flat.B,
        time_step=time_step,
        bounds=Bounds.of(bounds),
        robot=Unicycle(time_step=time_step),
        transformation=UnicycleTransformation(least_speed),
        substeps=substeps,
        **named,
    )

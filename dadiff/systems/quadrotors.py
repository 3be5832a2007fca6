"""Planar quadrotors: six states, two inputs, and as many robots as there are sets of parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.systems.nonlinear import Continuous

GRAVITY = 9.81  # m/s^2


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

    def _parameters(self, x: np.ndarray) -> list[np.ndarray]:
        """a, b, c with as many dimensions as the points have: robots first."""
        robots = self.robots
        shape = (*robots, *(1,) * (x.ndim - 1 - len(robots)))
        return [
            np.broadcast_to(value, robots).reshape(shape) for value in (self.thrust_gain, self.torque_gain, self.drag)
        ]

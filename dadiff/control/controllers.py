"""Controllers: u(t) from t and x(t), for a whole batch of episodes at once.

OpenLoop         the planned inputs, without looking (replay)
Tracking         a plan, and gains that hold the state to it
Feedback         u = K_t x + k_t: an optimal controller, as yardstick
Cloned           what demonstrations do in a state, by regression: behaviour cloning
RecedingHorizon  plans anew every k steps from where the robot is
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.system import System
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.response import along
from dadiff.trajectory.subspace import regression

Trajectories = tuple[np.ndarray, np.ndarray]
"""Planned states (*robots, ..., T+1, n) and inputs (*robots, ..., T, m)."""


class Controller(Protocol):
    """Decides the inputs of one batch of episodes; asked at t = 0, 1, ... in this order."""

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """u(t) (*robots, ..., m) from x(t) (*robots, ..., n)."""
        ...


@dataclass(frozen=True)
class OpenLoop:
    """The planned inputs, whatever the state; nothing beyond the plan's end.

    Args:
        inputs: (*robots, ..., T, m).
    """

    inputs: np.ndarray = field(repr=False)

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """u(t)."""
        if t >= self.inputs.shape[-2]:
            raise ShapeError(f"controller: the plan has {self.inputs.shape[-2]} inputs, and input {t} is asked for")
        return self.inputs[..., t, :]


@dataclass(frozen=True)
class Tracking:
    """u(t) = u_plan(t) + K_t (x(t) - x_plan(t)).

    Args:
        states, inputs: the plan.
        gains: K, (*robots, ..., T, m, n), see `tracking_gains`.
    """

    states: np.ndarray = field(repr=False)
    inputs: np.ndarray = field(repr=False)
    gains: np.ndarray = field(repr=False)

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """See the class."""
        deviation = x - self.states[..., t, :]
        return self.inputs[..., t, :] + (self.gains[..., t, :, :] @ deviation[..., None])[..., 0]


@dataclass(frozen=True)
class Feedback:
    """u(t) = K x(t) + offset, the same at every time.

    Args:
        gain: K, (*robots, m, n).
        offset: (*robots, ..., m).
    """

    gain: np.ndarray = field(repr=False)
    offset: np.ndarray = field(repr=False)

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """See the class."""
        return along(self.gain, x) + self.offset


@dataclass
class Cloned:
    """Behaviour cloning (Pomerleau 1988): u(t) = K_t [x(t); goal] + k_t; beyond the horizon as at its end.

    Args:
        gains: K, (T, m, n + c).
        offsets: k, (T, m).
        goal: what else the inputs depend on, (*robots, ..., c).

    Attributes:
        seconds: processor time of each input, for the whole batch.
    """

    gains: np.ndarray = field(repr=False)
    offsets: np.ndarray = field(repr=False)
    goal: np.ndarray = field(repr=False)
    seconds: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, layout: TrajectoryLayout, trajectories: np.ndarray, shown: np.ndarray, goal: np.ndarray) -> Cloned:
        """By least squares at each time.

        Args:
            trajectories: (N, d), of demonstrations.
            shown: what their inputs depend on besides the state, (N, c).
        """
        x, u = layout.split(trajectories)
        gains, offsets = [], []
        for t in range(layout.horizon):
            coefficients, intercept, _ = regression(u[:, t], np.concatenate([x[:, t], shown], axis=-1))
            gains.append(coefficients.T)
            offsets.append(intercept)
        return cls(np.stack(gains), np.stack(offsets), goal)

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """See the class."""
        begun, t = time.process_time(), min(t, len(self.gains) - 1)
        u = np.concatenate([x, self.goal], axis=-1) @ self.gains[t].T + self.offsets[t]
        self.seconds.append(time.process_time() - begun)
        return u


@dataclass
class RecedingHorizon:
    """Plans anew every k steps from the present state, and follows the plan in between.

    Args:
        plan: (x (*robots, ..., n), the last plan moved on by k steps or None) -> states, inputs of the new plan.
        every: k.
        follow: makes the controller that follows a plan; open loop, or with gains.

    Attributes:
        seconds: processor time of each planning, for the whole batch; others may use the machine.
    """

    plan: Callable[[np.ndarray, Trajectories | None], Trajectories]
    every: int = 1
    follow: Callable[[np.ndarray, np.ndarray], Controller] = field(default=lambda states, inputs: OpenLoop(inputs))
    seconds: list[float] = field(default_factory=list)
    _following: Controller | None = None
    _last: Trajectories | None = None
    _since: int = 0

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ConfigError(f"controller: every is {self.every}; plan anew every 1 or more steps")

    def act(self, t: int, x: np.ndarray) -> np.ndarray:
        """See the class."""
        if t % self.every == 0:
            begun = time.process_time()
            start = None if self._last is None else shifted(*self._last, self.every)
            self._last = self.plan(x, start)
            self.seconds.append(time.process_time() - begun)
            self._following, self._since = self.follow(*self._last), t
        if self._following is None:
            raise ConfigError(f"controller: is first asked at t = {t}; an episode begins at t = 0")
        return self._following.act(t - self._since, x)


def shifted(states: np.ndarray, inputs: np.ndarray, steps: int) -> Trajectories:
    """A plan moved on by some steps; at its end the state stays and the input is held."""
    steps = min(steps, inputs.shape[-2])
    held_x, held_u = np.repeat(states[..., -1:, :], steps, -2), np.repeat(inputs[..., -1:, :], steps, -2)
    return (
        np.concatenate([states[..., steps:, :], held_x], axis=-2),
        np.concatenate([inputs[..., steps:, :], held_u], axis=-2),
    )


def tracking_gains(system: System, states: np.ndarray, inputs: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """K_t of LQR tracking about a plan: min sum_t |dx|_Q^2 + |du|_R^2 under the linearised dynamics.

    One Riccati recursion backwards, from Q at the end.

    Args:
        states: (*robots, ..., T+1, n).
        inputs: (*robots, ..., T, m).
        Q: (n, n).
        R: (m, m), positive definite.

    Returns:
        (*robots, ..., T, m, n).
    """
    T = inputs.shape[-2]
    gains = np.empty((*inputs.shape[:-2], T, system.input_dim, system.state_dim))
    P = np.broadcast_to(Q, (*inputs.shape[:-2], *Q.shape))
    for t in range(T - 1, -1, -1):
        A, B, _ = system.linearise(states[..., t, :], inputs[..., t, :], t)
        PB = P @ B
        K = -np.linalg.solve(R + B.swapaxes(-1, -2) @ PB, PB.swapaxes(-1, -2) @ A)
        P = Q + A.swapaxes(-1, -2) @ P @ (A + B @ K)
        gains[..., t, :, :] = K
    return gains

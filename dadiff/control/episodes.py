"""Episodes: a controller on a system, step by step, under given disturbances."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.control.controllers import Controller
from dadiff.errors import ShapeError
from dadiff.systems.system import System


@dataclass(frozen=True)
class Episode:
    """What happened.

    Args:
        states: x(0:K), (*robots, ..., K+1, n); what left float range stays inf or nan.
        inputs: u(0:K-1) as they were applied, (*robots, ..., K, m).
    """

    states: np.ndarray = field(repr=False)
    inputs: np.ndarray = field(repr=False)

    @property
    def steps(self) -> int:
        """K."""
        return self.inputs.shape[-2]


def run(
    system: System,
    controller: Controller,
    x_init: np.ndarray,
    steps: int,
    disturbance: np.ndarray | None = None,
    *,
    delay: int = 0,
) -> Episode:
    """Let a controller act for K steps: u(t) = act(t, x(t)), x(t+1) = f(x(t), u(t)) + w(t).

    Args:
        x_init: (*robots, ..., n).
        steps: K.
        disturbance: w(0:K-1), (*robots, ..., K, n), the same for all controllers that are compared; None for none.
        delay: steps by which an input comes late; until the first arrives, the input is 0.

    Raises:
        ShapeError: if the disturbance has another number of steps.
    """
    if disturbance is not None and disturbance.shape[-2] != steps:
        raise ShapeError(f"episode: the disturbance has {disturbance.shape[-2]} steps; expected {steps}")
    shape = (*x_init.shape[:-1], steps)
    states = np.empty((*x_init.shape[:-1], steps + 1, system.state_dim))
    inputs = np.zeros((*shape, system.input_dim))
    states[..., 0, :] = x_init
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(steps):
            decided = controller.act(t, states[..., t, :])
            if t + delay < steps:
                inputs[..., t + delay, :] = decided
            following = system.step(states[..., t, :], inputs[..., t, :], t)
            states[..., t + 1, :] = following if disturbance is None else following + disturbance[..., t, :]
    return Episode(states, inputs)

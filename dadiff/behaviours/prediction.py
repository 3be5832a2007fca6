"""What a set takes the robot's dynamics for, and how well that predicts states from x(0) and inputs alone."""

from __future__ import annotations

import numpy as np

from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.sets import Dynamics, Span, TrajectorySet
from dadiff.systems import Linear, System, TimeVarying

TINY = float(np.finfo(np.float64).tiny)


def prediction_error(learned: TrajectorySet, truth: System, tau: np.ndarray) -> dict[str, float]:
    """Root mean square of x(1:T) as predicted against the truth, over each state's deviation, and averaged over states.

    Nothing is said of sets that do not determine states by x(0) and inputs.

    Args:
        tau: trajectories (*robots, plans, d) whose starts and inputs are taken.
    """
    states, inputs = learned.layout.split(tau)
    predicted = predicted_by(learned, states[..., 0, :], inputs)
    if predicted is None:
        return {}
    over = tuple(range(states.ndim - 1))
    with np.errstate(over="ignore", invalid="ignore"):
        true = truth.simulate(states[..., 0, :], inputs)[..., 1:, :]
        error = np.square(predicted[..., 1:, :] - true).mean(axis=over)
        error = np.sqrt(error / np.maximum(true.var(axis=over), TINY))
    return {"prediction_error": float(error.mean())}


def predicted_by(learned: TrajectorySet, x_init: np.ndarray, inputs: np.ndarray) -> np.ndarray | None:
    """States (*robots, plans, T+1, n) by dynamics, or by the only trajectory of a span with this x(0) and inputs."""
    layout = learned.layout
    if isinstance(learned, Span) and learned.basis.shape[-1] == layout.rank:
        flat = inputs.reshape(*inputs.shape[:-2], -1)
        projection = learned.bind(pins=(Pin.initial_state(layout, x_init), Pin(layout.all_inputs, flat)))
        return layout.states(projection(np.zeros((*x_init.shape[:-1], layout.size))))
    dynamics = learned if isinstance(learned, Lifted) else model_of(learned)
    return None if dynamics is None else dynamics.simulate(x_init, inputs)


def model_of(behaviour: TrajectorySet | None) -> System | None:
    """The system that a set takes the robot for; None where it says nothing of a step: subspaces, lifted dynamics."""
    if isinstance(behaviour, Limited):
        behaviour = behaviour.dynamics
    if isinstance(behaviour, Manifold):
        return behaviour.system
    if not isinstance(behaviour, Dynamics):
        return None
    stages = behaviour.stages
    if all((M[..., :1, :, :] == M).all() for M in (stages.A, stages.B, stages.c[..., None])):
        return Linear(stages.A[..., 0, :, :], stages.B[..., 0, :, :], stages.c[..., 0, :], robots=behaviour.robots)
    return TimeVarying(stages.A, stages.B, stages.c, robots=behaviour.robots)

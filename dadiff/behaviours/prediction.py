"""What a set takes the robot's dynamics for, and how well that predicts states from x(0) and inputs alone."""

from __future__ import annotations

import numpy as np

from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.sets import Dynamics, TrajectorySet
from dadiff.systems import Linear, System, TimeVarying

TINY = float(np.finfo(np.float64).tiny)


def prediction_error(learned: TrajectorySet, truth: System, tau: np.ndarray) -> dict[str, float]:
    """Root mean square of x(1:T) as predicted against the truth, over each state's deviation, and averaged over states.

    Nothing is said of sets that hold no dynamics.

    Args:
        tau: trajectories (*robots, plans, d) whose starts and inputs are taken.
    """
    dynamics = learned if isinstance(learned, Lifted) else model_of(learned)
    if dynamics is None:
        return {}
    states, inputs = learned.layout.split(tau)
    over = tuple(range(states.ndim - 1))
    with np.errstate(over="ignore", invalid="ignore"):
        predicted, true = (by.simulate(states[..., 0, :], inputs)[..., 1:, :] for by in (dynamics, truth))
        error = np.sqrt(np.square(predicted - true).mean(axis=over) / np.maximum(true.var(axis=over), TINY))
    return {"prediction_error": float(error.mean())}


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

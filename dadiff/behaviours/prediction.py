"""How well estimated dynamics predict: the error of states from x(0) and inputs alone, over the whole horizon."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dadiff.behaviours.bounded import Bounded
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.sets import Dynamics, TrajectorySet
from dadiff.systems import System

TINY = float(np.finfo(np.float64).tiny)


class Simulable(Protocol):
    """A system, or the stages of one."""

    def simulate(self, x_init: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """States (*robots, plans, T+1, n) from x(0) (*robots, plans, n) and inputs (*robots, plans, T, m)."""
        ...


def prediction_error(learned: TrajectorySet, truth: System, tau: np.ndarray) -> dict[str, float]:
    """Root mean square of x(1:T) as predicted against the truth, over each state's deviation, and averaged over states.

    Nothing is said of sets that hold no dynamics.

    Args:
        tau: trajectories (*robots, plans, d) whose starts and inputs are taken.
    """
    dynamics = _dynamics(learned)
    if dynamics is None:
        return {}
    states, inputs = learned.layout.split(tau)
    over = tuple(range(states.ndim - 1))
    with np.errstate(over="ignore", invalid="ignore"):
        predicted, true = (by.simulate(states[..., 0, :], inputs)[..., 1:, :] for by in (dynamics, truth))
        error = np.sqrt(np.square(predicted - true).mean(axis=over) / np.maximum(true.var(axis=over), TINY))
    return {"prediction_error": float(error.mean())}


def _dynamics(learned: TrajectorySet) -> Simulable | None:
    if isinstance(learned, Manifold):
        return learned.system
    if isinstance(learned, Lifted):
        return learned
    dynamics = learned.dynamics if isinstance(learned, Bounded) else learned
    return dynamics.stages if isinstance(dynamics, Dynamics) else None

"""Waypoints and collision avoidance for a planar double integrator: the optimisation problem (Section IV-B).

    min  sum_t w(t) |p(t) - v(t)|^2 + rho sum_t |u(t)|^2     s.t.  |p(t) - o_j| >= r_j,  t = 2..T

w(t) is positive where a waypoint or the target is due. Forward Euler gives u(t) = (p(t+2) - 2 p(t+1) + p(t)) / dt^2:
p(0) and p(1) follow from x_init, u(T-1) moves no position and is 0, so the unknowns are the positions p(2..T).
The printed cost rewards distance from the discs instead of constraining it; `literal` says when that has a minimum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems import Linear, System

TOLERANCE = 1e-7
"""Metres by which a solution may enter an inflated disc."""


class Status(IntEnum):
    """What became of one environment."""

    SOLVED = 0
    NOT_CONVERGED = 1
    INFEASIBLE = 2


@dataclass(frozen=True)
class ObstacleProblem:
    """N environments of one horizon T with at most O discs each.

    Args:
        x_init: (N, 4), positions and velocities.
        goal: v, (N, T+1, 2), read where the weight is positive.
        weight: w, (N, T+1).
        centre: o, (N, O, 2).
        radius: r, planning margin included, (N, O); 0 stands for no obstacle.
        input_cost: rho.
        time_step: dt, in seconds.
    """

    x_init: np.ndarray
    goal: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    input_cost: float
    time_step: float

    @property
    def count(self) -> int:
        """N."""
        return len(self.x_init)

    @property
    def horizon(self) -> int:
        """T."""
        return self.weight.shape[1] - 1

    @property
    def kappa(self) -> float:
        """rho / dt^4, the cost of a squared second difference of positions."""
        return self.input_cost / self.time_step**4

    @property
    def start(self) -> np.ndarray:
        """p(0), p(1), (N, 2, 2): no input reaches them."""
        position, velocity = self.x_init[:, :2], self.x_init[:, 2:]
        return np.stack([position, position + self.time_step * velocity], axis=1)

    def take(self, index: np.ndarray) -> ObstacleProblem:
        """The environments at `index`, with repetitions if it has some."""
        rows = {name: getattr(self, name)[index] for name in ("x_init", "goal", "weight", "centre", "radius")}
        return replace(self, **rows)

    def inputs(self, positions: np.ndarray) -> np.ndarray:
        """u(0:T-1), (N, T, 2), of positions (N, T+1, 2); u(T-1) = 0."""
        u = np.diff(positions, n=2, axis=-2) / self.time_step**2
        return np.concatenate([u, np.zeros_like(u[..., :1, :])], axis=-2)

    def cost(self, positions: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """(N, ...) from positions (N, ..., T+1, 2) and inputs (N, ..., T, 2)."""
        between = (1,) * (positions.ndim - 3)
        goal = self.goal.reshape(self.count, *between, *self.goal.shape[1:])
        weight = self.weight.reshape(self.count, *between, -1)
        tracking = weight * np.square(positions - goal).sum(axis=-1)
        return tracking.sum(axis=-1) + self.input_cost * np.square(inputs).sum(axis=(-2, -1))

    def penetration(self, positions: np.ndarray) -> np.ndarray:
        """r_j - |p(t) - o_j| at t = 2..T, (N, T-1, O), in metres; positive inside a disc."""
        return self.radius[:, None] - np.linalg.norm(positions[:, 2:, None] - self.centre[:, None], axis=-1)

    def feasible(self, positions: np.ndarray) -> np.ndarray:
        """(N,), whether p(2..T) lies outside every disc, up to TOLERANCE."""
        return self.penetration(positions).max(axis=(1, 2), initial=0.0) <= TOLERANCE


@dataclass(frozen=True)
class Solutions:
    """What an expert found, one row an environment.

    Args:
        positions: p(0:T), (N, T+1, 2).
        inputs: u(0:T-1), (N, T, 2).
        cost: (N,).
        status: `Status`, (N,); positions, inputs and cost mean something only where it is SOLVED.
    """

    positions: np.ndarray
    inputs: np.ndarray
    cost: np.ndarray
    status: np.ndarray

    @property
    def solved(self) -> np.ndarray:
        """(N,)."""
        return self.status == Status.SOLVED


def solutions(problem: ObstacleProblem, positions: np.ndarray, status: np.ndarray) -> Solutions:
    """Inputs and cost that belong to positions (N, T+1, 2)."""
    inputs = problem.inputs(positions)
    return Solutions(positions, inputs, problem.cost(positions, inputs), status)


def time_step_of(system: System) -> float:
    """dt of a planar double integrator in forward Euler form, A = [[I, dt I], [0, I]], B = [0; dt I].

    Raises:
        ConfigError: if the system is any other, as positions would not determine its inputs by second differences.
    """
    if isinstance(system, Linear) and system.A.shape == (4, 4) and system.B.shape == (4, 2) and not system.c.any():
        dt, zero, one = float(system.A[0, 2]), np.zeros((2, 2)), np.eye(2)
        A, B = np.block([[one, dt * one], [zero, one]]), np.vstack([zero, dt * one])
        if dt > 0 and np.allclose(system.A, A, atol=1e-12) and np.allclose(system.B, B, atol=1e-12):
            return dt
    raise ConfigError(
        "obstacles: the experts need one planar double integrator by forward Euler (n = 4, m = 2); found "
        f"{type(system).__name__} with n = {system.state_dim}, m = {system.input_dim}; "
        "use system=double_integrator with discretisation=euler, axes=2"
    )

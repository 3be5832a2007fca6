"""The LQR optimum within bounds on states and inputs.

    min  sum_{t=0}^{T-1} |x(t) - x_target|_Q^2 + |u(t)|_R^2  +  |x(T) - x_target|_{Q_T}^2
    s.t. x(t+1) = A_t x(t) + B_t u(t) + c_t,    low <= x(t), u(t) <= high

`optimum_within` solves a quadratic program for each case by Clarabel: references are its, so that projections are held
against what knows none. `many_within` solves thousands by `dadiff.experts.nearest`, as demonstrations need it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from dadiff.errors import InfeasibleError
from dadiff.experts.nearest import Limits, nearest
from dadiff.systems import AffineSystem, Bounds
from dadiff.trajectory.subspace import semidefinite_root


@dataclass(frozen=True)
class Costs:
    """Q (n, n), R (m, m) and Q_T (n, n)."""

    Q: np.ndarray
    R: np.ndarray
    terminal: np.ndarray


LEAST = 1e-6
"""Of the largest weight: what an entry that costs nothing is given, so that it lies somewhere."""


def many_within(system: AffineSystem, costs: Costs, horizon: int, x_init: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The optimum tau (*robots, ..., d) within bounds, up to LEAST; by Clarabel where weights are no diagonals.

    It is the trajectory nearest to rest at the target, as the costs measure it. From where nothing keeps to the bounds
    on states, those on inputs alone are kept.

    Args:
        x_init, target: (*robots, ..., n).
    """
    if not all(np.array_equal(W, np.diag(np.diag(W))) for W in (costs.Q, costs.R, costs.terminal)):
        flat = (end.reshape(*system.robots, -1, system.state_dim) for end in (x_init, target))
        return optimum_within(system, costs, horizon, *flat).reshape(*x_init.shape[:-1], -1)
    layout, N = system.layout(horizon), x_init[..., 0].size
    A, B, c = (M.reshape(-1, *M.shape[len(system.robots) :]) for M in system.matrices(horizon))
    states = np.repeat(np.diag(costs.Q)[None], horizon + 1, axis=0)
    states[-1] = np.diag(costs.terminal)
    weight = layout.flatten(states, np.repeat(np.diag(costs.R)[None], horizon, axis=0))
    scale = np.maximum(weight, LEAST * weight.max()) ** -0.5
    resting = np.repeat(target.reshape(N, 1, -1), horizon + 1, axis=1)
    aim = layout.flatten(resting, np.zeros((N, horizon, system.input_dim)))
    start, places = x_init.reshape(N, -1), np.arange(layout.size)[layout.initial_state]
    limits = Limits.of(layout, N, system.bounds).pinned(places, start)
    found = nearest(layout, aim, A, B, c, limits, scale)
    if not found.found.all():
        inputs = Bounds(system.bounds.input_low, system.bounds.input_high)
        other = nearest(layout, aim, A, B, c, Limits.of(layout, N, inputs).pinned(places, start), scale)
        found.tau[~found.found] = other.tau[~found.found]
    return found.tau.reshape(*x_init.shape[:-1], -1)


def optimum_within(
    system: AffineSystem, costs: Costs, horizon: int, x_init: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """The optimum tau (*robots, cases, d) within the system's bounds.

    Args:
        x_init, target: (*robots, cases, n).

    Raises:
        InfeasibleError: naming the first x_init from which no trajectory stays within bounds.
    """
    A, B, c = (M.reshape(-1, *M.shape[len(system.robots) :]) for M in system.matrices(horizon))
    cases, n = x_init.shape[-2:]
    ends = np.stack([x_init, target], axis=-2).reshape(len(A), cases, 2, n)
    programs = [_Program(system, costs, stages) for stages in zip(A, B, c, strict=True)]
    found = [one.solve(start, aim) for one, row in zip(programs, ends, strict=True) for start, aim in row]
    states, inputs = (np.array(part) for part in zip(*found, strict=True))
    return system.layout(horizon).flatten(states, inputs).reshape(*x_init.shape[:-1], -1)


class _Program:
    """The quadratic program of one robot, set up once; x_init and target are its parameters."""

    def __init__(self, system: AffineSystem, costs: Costs, stages: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
        (A, B, c), n, m = stages, system.state_dim, system.input_dim
        T = len(A)
        self.x, self.u = cp.Variable((T + 1, n)), cp.Variable((T, m))
        self.x_init, self.target = cp.Parameter(n), cp.Parameter(n)
        running, terminal, effort = (semidefinite_root(W) for W in (costs.Q, costs.terminal, costs.R))
        away = self.x - np.ones((T + 1, 1)) @ cp.reshape(self.target, (1, n), order="C")
        cost = cp.sum_squares(away[:-1] @ running) + cp.sum_squares(self.u @ effort)
        rules = [self.x[0] == self.x_init]
        rules += [self.x[t + 1] == A[t] @ self.x[t] + B[t] @ self.u[t] + c[t] for t in range(T)]
        rules += _within(self.x, *system.bounds.of_states(n)) + _within(self.u, *system.bounds.of_inputs(m))
        self.problem = cp.Problem(cp.Minimize(cost + cp.sum_squares(away[-1] @ terminal)), rules)

    def solve(self, x_init: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (T+1, n) and inputs (T, m)."""
        self.x_init.value, self.target.value = x_init, target
        self.problem.solve(solver=cp.CLARABEL)
        states, inputs = self.x.value, self.u.value
        if self.problem.status != cp.OPTIMAL or states is None or inputs is None:
            raise InfeasibleError(
                f"LQR: from x_init = {np.round(x_init, 3).tolist()} no trajectory within the system's "
                f"bounds was found ({self.problem.status}); narrow task.init_range or widen system.bounds"
            )
        return states, inputs


def _within(values: cp.Variable, low: np.ndarray, high: np.ndarray) -> list[cp.Constraint]:
    """low <= values (steps, k) <= high, where these are finite."""
    from_below, from_above = np.flatnonzero(np.isfinite(low)), np.flatnonzero(np.isfinite(high))
    rules = [values[:, k] >= low[k] for k in from_below]
    return rules + [values[:, k] <= high[k] for k in from_above]

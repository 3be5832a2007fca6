"""The cost as printed (the paper's Section IV-B), which pays for distance from discs instead of constraining it.

    min  sum_i w |p(t_i) - v_i|^2 + rho sum_t |u(t)|^2 - sum_{t<T,j} (|p(t) - o_j| - r_j)^2

With p(t) = p_free(t) + G(t) u per axis, its quadratic part is M = rho I + w W - O S, S = sum_{t<T} G(t)' G(t) and
W = sum_i G(t_i)' G(t_i); what remains, 2 r_j |p(t) - o_j| and linear terms, is convex and grows linearly. So the cost
is convex if lambda_min(M) >= 0 and unbounded below if lambda_min(M) < 0.
"""

from __future__ import annotations

import numpy as np

from dadiff.errors import InfeasibleError
from dadiff.experts.obstacles.problem import ObstacleProblem, Solutions, Status, solutions


def response(horizon: int, time_step: float) -> np.ndarray:
    """G, (T+1, T-1): how p(t) of one axis depends on u(0:T-2); u(T-1) moves no position."""
    delay = np.arange(horizon + 1)[:, None] - np.arange(horizon - 1) - 1
    return time_step**2 * np.maximum(delay, 0)


def curvature(problem: ObstacleProblem, index: int, obstacles: int) -> np.ndarray:
    """M of environment `index` if it had that many obstacles, (T-1, T-1)."""
    G = response(problem.horizon, problem.time_step)
    W, S = G.T @ (problem.weight[index][:, None] * G), G[:-1].T @ G[:-1]
    return problem.input_cost * np.eye(len(S)) + W - obstacles * S


def check_bounded(problem: ObstacleProblem, index: int) -> None:
    """Raise unless the printed cost of environment `index` has a minimum.

    Raises:
        InfeasibleError: naming lambda_min(M), the smallest rho and the largest number of obstacles that would do.
    """
    present = int((problem.radius[index] > 0).sum())
    smallest = _smallest_eigenvalue(problem, index, present)
    if smallest >= 0:
        return
    fewest = next((k for k in range(present - 1, -1, -1) if _smallest_eigenvalue(problem, index, k) >= 0), 0)
    raise InfeasibleError(
        f"environment {index}: the printed cost has no minimum, lambda_min(M) = {smallest:.4g} < 0; it needs "
        f"input_cost >= {problem.input_cost - smallest:.4g} or at most {fewest} of its {present} obstacles; "
        "or use task.formulation=constrained"
    )


def _smallest_eigenvalue(problem: ObstacleProblem, index: int, obstacles: int) -> float:
    return float(np.linalg.eigvalsh(curvature(problem, index, obstacles))[0])


def cost(problem: ObstacleProblem, positions: np.ndarray) -> np.ndarray:
    """The printed cost of positions (N, T+1, 2), (N,)."""
    gap = np.linalg.norm(positions[:, :-1, None] - problem.centre[:, None], axis=-1) - problem.radius[:, None]
    reward = (np.square(gap) * (problem.radius > 0)[:, None]).sum(axis=(1, 2))
    return problem.cost(positions, problem.inputs(positions)) - reward


def solve(problem: ObstacleProblem) -> Solutions:
    """The minimum of the printed cost, a second-order cone problem for each environment.

    Raises:
        InfeasibleError: if an environment's cost has no minimum.
    """
    for index in range(problem.count):
        check_bounded(problem, index)
    found = [_solve_one(problem, index) for index in range(problem.count)]
    result = solutions(problem, np.array([p for p, _ in found]), np.array([status for _, status in found]))
    return Solutions(result.positions, result.inputs, cost(problem, result.positions), result.status)


def _solve_one(problem: ObstacleProblem, index: int) -> tuple[np.ndarray, Status]:
    import cvxpy as cp

    G, start = response(problem.horizon, problem.time_step), problem.start[index]
    free = start[0] + np.arange(problem.horizon + 1)[:, None] * (start[1] - start[0])
    present = problem.radius[index] > 0
    centre, radius = problem.centre[index][present], problem.radius[index][present]
    u = cp.Variable((problem.horizon - 1, 2))
    p = free + G @ u
    M = curvature(problem, index, len(radius))
    weight = problem.weight[index][:, None]
    linear = 2 * G.T @ (weight * (free - problem.goal[index]))
    linear -= 2 * G[:-1].T @ (len(radius) * free[:-1] - centre.sum(axis=0))
    objective = cp.sum(cp.multiply(linear, u))
    objective += sum(cp.quad_form(u[:, axis], cp.psd_wrap(M)) for axis in range(2))
    objective += sum(2 * r * cp.sum(cp.norm(p[:-1] - o[None], axis=1)) for o, r in zip(centre, radius, strict=True))
    task = cp.Problem(cp.Minimize(objective))
    task.solve(solver=cp.CLARABEL)
    if task.status != cp.OPTIMAL:
        return free, Status.NOT_CONVERGED
    return free + G @ u.value, Status.SOLVED

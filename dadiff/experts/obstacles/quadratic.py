"""The optimum without obstacles, which is a convex quadratic problem: the compiled kernels' closed form of it."""

from __future__ import annotations

import numpy as np

from dadiff.experts.obstacles.problem import ObstacleProblem


def obstacle_free(problem: ObstacleProblem) -> np.ndarray:
    """argmin sum_t w(t) |p(t) - v(t)|^2 + rho sum_t |u(t)|^2, positions (N, T+1, 2)."""
    from dadiff.experts.obstacles.kernels import minimise_cost

    p = np.empty((problem.count, problem.horizon + 1, 2))
    p[:, :2] = problem.start
    p[:, 2:] = p[:, 1:2]
    minimise_cost(p, problem.goal, problem.weight, problem.kappa)
    return p

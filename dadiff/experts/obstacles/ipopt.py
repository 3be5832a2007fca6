"""IPOPT through CasADi: direct multiple shooting, the oracle of slow tests. An optional extra.

States and inputs are unknowns, the dynamics are equality constraints and the discs inequalities; the nonlinear
program is built once for a shape of problem and solved with other parameters for each environment and start.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dadiff.errors import MissingExtraError
from dadiff.experts.obstacles.problem import TOLERANCE, ObstacleProblem, Solutions
from dadiff.experts.obstacles.starts import best_of_starts

_OPTIONS: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": TOLERANCE / 10,
    "ipopt.bound_relax_factor": 0.0,
}


def solve(problem: ObstacleProblem, *, progress: bool = False) -> Solutions:
    """The cheapest feasible path of each environment over several starts, one nonlinear program after another.

    Raises:
        MissingExtraError: if casadi is not installed.
    """
    return best_of_starts(problem, _program(problem), progress)


def _program(problem: ObstacleProblem) -> Callable[[ObstacleProblem, np.ndarray], np.ndarray | None]:
    """The nonlinear program for problems of this horizon and number of discs, as a function of one start."""
    try:
        import casadi
    except ImportError as error:
        raise MissingExtraError(
            "expert ipopt: casadi is not installed; install it with: pip install 'dadiff[ipopt]'"
        ) from error
    T, discs, dt = problem.horizon, problem.radius.shape[1], problem.time_step
    x, u = casadi.SX.sym("x", 4, T + 1), casadi.SX.sym("u", 2, T)
    x_init, goal, weight = casadi.SX.sym("x0", 4), casadi.SX.sym("v", 2, T + 1), casadi.SX.sym("w", T + 1)
    centre, radius = casadi.SX.sym("o", 2, discs), casadi.SX.sym("r", discs)
    following = x[:, :-1] + dt * casadi.vertcat(x[2:, :-1], u)
    cost = casadi.dot(weight, casadi.sum1((x[:2, :] - goal) ** 2).T) + problem.input_cost * casadi.sumsqr(u)
    gaps = [casadi.sum1((x[:2, 2:] - centre[:, j]) ** 2).T - radius[j] ** 2 for j in range(discs)]
    equalities = casadi.vertcat(x[:, 0] - x_init, casadi.vec(x[:, 1:] - following))
    program: dict[str, Any] = {
        "x": casadi.vertcat(casadi.vec(x), casadi.vec(u)),
        "p": casadi.vertcat(x_init, casadi.vec(goal), weight, casadi.vec(centre), radius),
        "f": cost,
        "g": casadi.vertcat(equalities, *gaps),
    }
    solver = casadi.nlpsol("expert", "ipopt", program, _OPTIONS)
    upper = np.concatenate([np.zeros(equalities.numel()), np.full(discs * (T - 1), np.inf)])
    return lambda one, start: _run(solver, one, start, upper)


def _run(solver: Any, one: ObstacleProblem, start: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
    velocity = np.diff(start, axis=0, append=start[-1:]) / one.time_step
    velocity[-1] = velocity[-2]
    guess = np.concatenate([np.hstack([start, velocity]).ravel(), one.inputs(start[None])[0].ravel()])
    parameters = (one.x_init, one.goal, one.weight, one.centre, one.radius)
    result = solver(x0=guess, p=np.concatenate([part[0].ravel() for part in parameters]), lbg=0, ubg=upper)
    if not solver.stats()["success"]:
        return None
    states = np.asarray(result["x"]).ravel()[: 4 * (one.horizon + 1)].reshape(-1, 4)
    return states[:, :2]

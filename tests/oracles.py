"""Independent solutions of the same problems, written out for IPOPT."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dadiff.systems import System
from dadiff.systems.quadrotors import GRAVITY, PlanarQuadrotor
from dadiff.trajectory import TrajectoryLayout


def ipopt(
    robot: PlanarQuadrotor,
    layout: TrajectoryLayout,
    W: np.ndarray,
    reference: np.ndarray,
    x_init: np.ndarray,
    *,
    expand: bool = True,
) -> tuple[float, float]:
    """See `ipopt_of`, of one quadrotor."""
    import casadi

    def rate(x: Any, u: Any) -> Any:
        thrust = GRAVITY + robot.thrust_gain * u[0]
        forward = -thrust * casadi.sin(x[2]) - robot.drag * x[3]
        upward = thrust * casadi.cos(x[2]) - GRAVITY - robot.drag * x[4]
        return casadi.vertcat(x[3], x[4], x[5], forward, upward, robot.torque_gain * u[1])

    return ipopt_of(robot, rate, layout, W, reference, x_init, expand=expand)


def cart_pole_rate(x: Any, u: Any) -> Any:
    """Of position, angle from upright and their rates; u pushes the cart, 1 kg with a pole of 0.3 kg and 1 m."""
    import casadi

    sin, cos = casadi.sin(x[1]), casadi.cos(x[1])
    a = (u[0] + 0.3 * sin * (x[3] ** 2 - GRAVITY * cos)) / (1 + 0.3 * sin**2)
    return casadi.vertcat(x[2], x[3], a, GRAVITY * sin - cos * a)


def ipopt_of(
    robot: System,
    rate: Callable[[Any, Any], Any],
    layout: TrajectoryLayout,
    W: np.ndarray,
    reference: np.ndarray,
    x_init: np.ndarray,
    *,
    expand: bool = True,
) -> tuple[float, float]:
    """The least (tau - reference)' W (tau - reference) over trajectories within a robot's bounds from x_init.

    Args:
        rate: dx/dt in casadi, integrated by RK4.
        expand: whether casadi's graph is written out in scalars first; unless told so casadi does not.

    Returns:
        The cost, and the processor seconds of solving, without those of writing the problem out.
    """
    import casadi

    problem, h, n, m = casadi.Opti(), robot.time_step, layout.state_dim, layout.input_dim
    x, u = problem.variable(n, layout.horizon + 1), problem.variable(m, layout.horizon)
    for t in range(layout.horizon):
        k1 = rate(x[:, t], u[:, t])
        k2 = rate(x[:, t] + h / 2 * k1, u[:, t])
        k3 = rate(x[:, t] + h / 2 * k2, u[:, t])
        k4 = rate(x[:, t] + h * k3, u[:, t])
        problem.subject_to(x[:, t + 1] == x[:, t] + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    problem.subject_to(x[:, 0] == x_init)
    for values, (low, high) in ((x[:, 1:], robot.bounds.of_states(n)), (u, robot.bounds.of_inputs(m))):
        for k in np.flatnonzero(np.isfinite(low) | np.isfinite(high)):
            problem.subject_to(problem.bounded(low[k], values[int(k), :], high[k]))
    states, inputs = layout.split(reference)
    problem.set_initial(x, states.T)
    problem.set_initial(u, inputs.T)
    delta = casadi.vertcat(casadi.vec(x), casadi.vec(u)) - reference
    problem.minimize(delta.T @ casadi.sparsify(casadi.DM(W)) @ delta)
    options = {"print_time": False, "expand": expand}
    problem.solver("ipopt", options, {"print_level": 0, "sb": "yes", "tol": 1e-10})
    problem.solve()  # sets up what is kept
    begin = time.process_time()
    solution = problem.solve()
    return float(solution.value(problem.f)), time.process_time() - begin

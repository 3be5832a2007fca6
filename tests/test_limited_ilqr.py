"""Iterated LQR within limits: IPOPT finds the same, and what cannot be kept is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import cart_pole_rate, ipopt, ipopt_of

from dadiff.behaviours import Known, Limited, Manifold, Pin, pins
from dadiff.errors import ConfigError
from dadiff.experts.ilqr import Metric
from dadiff.experts.limited_ilqr import LimitedTracking, linearised, solve
from dadiff.systems import Bounds, PlanarQuadrotors
from dadiff.systems.nonlinear import Nonlinear
from dadiff.systems.quadrotors import PlanarQuadrotor
from dadiff.tasks import Manoeuvre
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.covariance import Covariance

HORIZON = 15
INPUTS = Bounds(-1.5, [1.0, 1.2])
STATES = Bounds(-2.5, 2.5, [-np.inf, -np.inf, -0.4, -1.2, -np.inf, -np.inf], [np.inf, np.inf, 0.4, 1.2, np.inf, np.inf])


def problem(robot: PlanarQuadrotor, rng: np.random.Generator, plans: int = 3) -> LimitedTracking:
    """Rough references, and starts at rest near them."""
    layout = robot.layout(HORIZON)
    metric = Metric.diagonal(layout, rng.uniform(0.2, 2, layout.size))
    x_init = rng.uniform(-1, 1, (plans, 6)) * [1, 1, 0.2, 0.3, 0.3, 0.3]
    return LimitedTracking.by_bounds(robot, metric, rng.standard_normal((plans, layout.size)), x_init)


def test_the_cost_is_that_of_the_metric(rng):
    robot = PlanarQuadrotor(bounds=INPUTS)
    layout = robot.layout(HORIZON)
    metric = Metric.diagonal(layout, rng.uniform(0.2, 2, layout.size))
    reference, tau = rng.standard_normal((2, 3, layout.size))
    given = LimitedTracking.by_bounds(robot, metric, reference, tau[:, :6])
    np.testing.assert_allclose(given.cost(tau), metric.squared(tau - reference), rtol=1e-12)


@pytest.mark.parametrize("bounds", [INPUTS, STATES], ids=["inputs", "inputs and states"])
def test_ipopt_finds_the_same_cost(bounds, rng):
    pytest.importorskip("casadi")
    robot = PlanarQuadrotor(thrust_gain=0.7, torque_gain=1.3, drag=0.4, bounds=bounds)
    given = problem(robot, rng)
    layout, found = given.layout, solve(given)
    assert found.converged.all()
    states, inputs = layout.split(found.tau)
    np.testing.assert_array_equal(inputs, np.clip(inputs, *bounds.of_inputs(2)))
    assert (np.abs(inputs - np.clip(inputs, *(0.999999 * b for b in bounds.of_inputs(2)))) > 0).any(), "bounds matter"
    np.testing.assert_allclose(robot.simulate(states[..., 0, :], inputs), states, atol=1e-12)
    low, high = bounds.of_states(6)
    assert np.maximum(low - states, states - high)[:, 1:].max() < 1e-8
    for k in range(len(found.tau)):
        best = ipopt(robot, layout, np.diag(given.scale**-2.0), given.reference[k], states[k, 0])[0]
        assert found.cost[k] == pytest.approx(best, rel=1e-6)


def test_inputs_keep_their_bounds_after_one_sweep_already(rng):
    robot = PlanarQuadrotor(bounds=INPUTS)
    given = problem(robot, rng)
    inputs = given.layout.inputs(solve(given, sweeps=1).tau)
    np.testing.assert_array_equal(inputs, np.clip(inputs, *INPUTS.of_inputs(2)))


def test_inputs_that_are_at_a_bound_do_not_react_and_others_do(rng):
    given = problem(PlanarQuadrotor(bounds=INPUTS), rng)
    step = linearised(given, solve(given, sweeps=1).tau, None)
    low, high = INPUTS.of_inputs(2)
    aim = given.layout.inputs(step.aim)
    assert (aim == low).any()
    assert (aim == high).any()
    np.testing.assert_array_equal(step.K.any(axis=-1)[:, :-1], ((low < aim) & (aim < high))[:, :-1])


def test_where_no_bound_is_near_inputs_react_as_in_the_lqr_problem(rng):
    """Riccati's recursion written out, along the linearised dynamics and with the weights of the distance."""
    robot = PlanarQuadrotor(bounds=Bounds(-1e3, 1e3))
    given = problem(robot, rng, plans=1)
    tau = solve(given, sweeps=1).tau
    (x, u), (Q, R) = given.layout.split(tau[0]), given.layout.split(given.scale**-2.0)
    A, B, _ = robot.linearise(x[:-1], u)
    P, K = np.diag(Q[-1]), linearised(given, tau, None).K[0]
    for t in reversed(range(HORIZON)):
        feedback = -np.linalg.solve(np.diag(R[t]) + B[t].T @ P @ B[t], B[t].T @ P @ A[t])
        P = np.diag(Q[t]) + A[t].T @ P @ (A[t] + B[t] @ feedback)
        np.testing.assert_allclose(K[t], feedback, atol=1e-9)


def test_what_cannot_be_kept_is_said_and_inputs_are_kept(rng):
    fast = Bounds(-0.1, 0.1, -1.0, 1.0)
    robot = PlanarQuadrotor(bounds=fast)
    given, layout = problem(robot, rng, plans=2), robot.layout(HORIZON)
    start = np.zeros((2, 6))
    start[1, 0], start[1, 3] = 0.9, 1.0  # too fast to be stopped before the bound
    given = replace(given, limits=given.limits.pinned(np.arange(6), start), reference=0 * given.reference)
    found = solve(given)
    assert found.converged.tolist() == [True, False]
    assert np.abs(layout.inputs(found.tau)).max() <= 0.1
    np.testing.assert_allclose(robot.simulate(start, layout.inputs(found.tau)), layout.states(found.tau), atol=1e-12)


def test_every_entry_needs_a_weight(rng):
    robot = PlanarQuadrotor(bounds=INPUTS)
    layout = robot.layout(3)
    whole = Metric.diagonal(layout, np.ones(layout.size))
    idle = Metric(layout, 0 * whole.Q, whole.R, whole.U)
    with pytest.raises(ConfigError, match="a positive weight"):
        LimitedTracking.by_bounds(robot, idle, np.zeros((1, layout.size)), np.zeros((1, 6)))


def test_the_manoeuvre_s_expert_keeps_to_bounds_each_robot_by_its_own():
    task, bounds = (
        Manoeuvre(interpolation=3, extrapolation=0, horizon=20),
        {"input_low": -3.0, "input_high": [3.0, 2.0]},
    )
    free, limited = (task.target(PlanarQuadrotors(bounds=given)) for given in (None, bounds))
    rng = np.random.default_rng(0)
    cases = task.cases(limited, 4, rng)
    inputs = limited.layout(20).inputs(cases.reference)
    assert cases.notes["share converged"] == 1
    assert inputs.max(axis=(0, 1, 2)).tolist() == [3.0, 2.0]
    target = cases.get("target")
    cheaper = task.solve(free, cases.environment)
    assert (task.cost(free, cheaper, target) <= task.cost(limited, cases.reference, target) * (1 + 1e-9)).all()
    one = task.solve(limited.take([1]), cases.environment[1:2])
    np.testing.assert_allclose(one[0], cases.reference[1], atol=1e-6)


@pytest.mark.parametrize("weighted", [False, True], ids=["identity", "conditional"])
def test_plans_are_projected_onto_nonlinear_dynamics_within_bounds(weighted, rng):
    gains = {"thrust_gain": np.array([0.5, 1.5]), "torque_gain": np.array([2.0, 0.4]), "drag": np.array([0.0, 1.0])}
    robots = PlanarQuadrotor(**gains, bounds=STATES)
    layout, x_init = robots.layout(HORIZON), 0.2 * rng.standard_normal((2, 3, 6))
    where = Coordinates(rng.standard_normal(layout.size), rng.uniform(0.5, 2, layout.size))
    C = Covariance(rng.uniform(0.2, 2, layout.size), rng.standard_normal((layout.size, 3))) if weighted else None
    known = Known("fixed", sweeps=30, bounds="enforced")
    project = known.fit(layout, robots).bind(where, pins(known, layout, x_init))
    z = rng.standard_normal((2, 3, layout.size))
    found = project(z, C)
    assert (project.info.kind, project.info.unconverged) == ("limited", 0)
    states, inputs = layout.split(where.to_physical(found))
    np.testing.assert_allclose(robots.simulate(x_init, inputs), states, atol=1e-9)
    exceeded = [np.maximum(low - v, v - high).max() for v, (low, high) in
                ((inputs, STATES.of_inputs(2)), (states[..., 1:, :], STATES.of_states(6)))]  # fmt: skip
    assert max(exceeded) < 1e-8
    torch.testing.assert_close(project(torch.tensor(z), C), torch.tensor(found))
    np.testing.assert_allclose(project(found, C, found), found, atol=1e-5)


def test_a_cart_pole_keeps_its_track_and_its_force(rng):
    pytest.importorskip("casadi")

    def rate(x, u):
        sin, cos = x[..., 1].sin(), x[..., 1].cos()
        a = (u[..., 0] + 0.3 * sin * (x[..., 3] ** 2 - 9.81 * cos)) / (1 + 0.3 * sin**2)
        return torch.stack([x[..., 2], x[..., 3], a, 9.81 * sin - cos * a], -1)

    track = Bounds(-3.0, 3.0, [-0.25, -np.inf, -np.inf, -np.inf], [0.25, np.inf, np.inf, np.inf])
    robot = Nonlinear(rate, 4, 1, integrator="rk4", time_step=0.05, bounds=track)
    layout, x_init = robot.layout(25), rng.uniform(-0.1, 0.1, (4, 4))
    metric = Metric.diagonal(layout, np.tile([1.0], layout.size))
    given = LimitedTracking.by_bounds(robot, metric, 0.2 * rng.standard_normal((4, layout.size)), x_init)
    found = solve(given)
    states, inputs = layout.split(found.tau)
    assert found.converged.all()
    assert np.abs(inputs).max() == 3.0
    assert np.abs(states[..., 0]).max() <= 0.25 + 1e-8
    for k in range(4):
        best = ipopt_of(robot, cart_pole_rate, layout, np.eye(layout.size), given.reference[k], x_init[k])[0]
        assert found.cost[k] == pytest.approx(best, rel=1e-6)


def test_one_robot_of_one_input_keeps_clear_of_a_disc_on_curved_dynamics(rng):
    """A unicycle at speed 1 that turns: what it plans through a disc is led around it."""
    robot = Nonlinear(
        lambda x, u: torch.stack([torch.cos(x[..., 2]), torch.sin(x[..., 2]), u[..., 0]], -1),
        3, 1, integrator="rk4", time_step=0.1, bounds=Bounds(-2.0, 2.0),
    )  # fmt: skip
    layout = robot.layout(30)
    straight = layout.flatten(robot.simulate(np.zeros((1, 3)), np.zeros((1, 30, 1))), np.zeros((1, 30, 1)))
    disc = np.array([[[1.5, 0.1, 0.4, 1.0]]])
    target = Limited(Manifold(layout, robot, sweeps=20), robot.bounds, margin=0.02, discs=disc)
    project = target.bind(pins=[Pin.initial_state(layout, np.zeros((1, 3)))])
    found = project(straight)
    states, inputs = layout.split(found)
    assert project.info.unconverged == 0
    assert 2 <= project.info.iterations <= 2 * 20
    assert np.linalg.norm(states[0, :, :2] - disc[0, 0, :2], axis=-1).min() > 0.4
    assert np.abs(inputs).max() <= 2.0
    np.testing.assert_allclose(robot.simulate(np.zeros((1, 3)), inputs), states, atol=1e-12)

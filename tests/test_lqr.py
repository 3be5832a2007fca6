"""Laws of the LQR expert and its task: optimality, by a solver and by its conditions, and the exact law."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from laws import AFFINE, SYSTEMS, fleet, members

from dadiff.behaviours import Known, pins
from dadiff.datasets import Generated
from dadiff.errors import ConfigError, InfeasibleError, NotApplicableError
from dadiff.evaluation import replay
from dadiff.evaluation.errors import dynamics_residual
from dadiff.experts.lqr import ClosedLoopLaw, follow, optimal_feedback, stationary_feedback
from dadiff.randomness import numpy_generator
from dadiff.systems import AffineSystem, Bounds, DampedIntegrators, Linear, TimeVarying, double_integrator
from dadiff.tasks import LQR, Fleet
from dadiff.tasks.obstacles import Obstacles
from dadiff.tasks.quadratic import check_weight, stretched


def task_for(system: Linear, horizon: int = 12, **options) -> LQR:
    return LQR(horizon=horizon, state_cost=tuple(np.linspace(10, 1, system.state_dim)), **options)


def optimum(system: Linear, task: LQR, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """(environment, noise-free optimal trajectories) of a few cases."""
    cases = task.cases(system, count, numpy_generator(0, "test"))
    return cases.environment, cases.reference


def by_qp(system: AffineSystem, task: LQR, E: np.ndarray):
    """States, inputs and cost of the optimum for one E by a solver of quadratic programs."""
    n, T, weights = system.state_dim, task.horizon, task.cost(system)
    x, u = cp.Variable((T + 1, n)), cp.Variable((T, system.input_dim))
    deviation = x - E[None, n:]
    cost = sum(cp.quad_form(deviation[t], cp.psd_wrap(weights.Q)) + cp.quad_form(u[t], weights.R) for t in range(T))
    cost += cp.quad_form(deviation[T], cp.psd_wrap(weights.terminal))
    A, B, c = system.matrices(T)
    dynamics = [x[0] == E[:n], *(x[t + 1] == A[t] @ x[t] + B[t] @ u[t] + c[t] for t in range(T))]
    problem = cp.Problem(cp.Minimize(cost), dynamics)
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    return x.value, u.value, problem.value


def full(size: int, rank: int, seed: int) -> list[list[float]]:
    """Rows of a random matrix, positive semidefinite of a rank."""
    root = np.random.default_rng(seed).standard_normal((size, rank))
    return (root @ root.T).tolist()


def full_task(system: AffineSystem) -> LQR:
    """Full Q and R, a terminal cost, ranges per state."""
    n, m = system.state_dim, system.input_dim
    ranges = {"init_range": [0.5, *[[-1.0, 3.0]] * (n - 1)], "target_range": [2.0] * n}
    costs = {"state_cost": full(n, n - 1, 0), "input_cost": full(m, m + 1, 1), "terminal_cost": full(n, n, 2)}
    return LQR(horizon=12, **costs, **ranges)


@pytest.mark.parametrize("task_of", [task_for, full_task])
def test_the_affine_optimum_is_the_qps(affine, task_of):
    task = task_of(affine)
    (environment,), (tau,) = optimum(affine, task, count=1)
    states, inputs = affine.layout(task.horizon).split(tau)
    x, u, cost = by_qp(affine, task, environment)
    np.testing.assert_allclose(states, x, atol=1e-6)
    np.testing.assert_allclose(inputs, u, atol=1e-6)
    np.testing.assert_allclose(task.cost(affine)(states, inputs, environment[affine.state_dim :]), cost, rtol=1e-8)


@pytest.mark.parametrize("task_of", [task_for, full_task])
def test_the_gradient_of_the_cost_vanishes_at_the_optimum(affine, task_of):
    """With lambda(t) = 2 Q (x(t) - target) + A_t' lambda(t+1), lambda(T) = 2 Q_T (x(T) - target):
    2 R u(t) + B_t' lambda(t+1) = 0."""
    task = task_of(affine)
    environment, tau = optimum(affine, task)
    (A, B, _), cost = affine.matrices(task.horizon), task.cost(affine)
    states, inputs = affine.layout(task.horizon).split(tau)
    deviation = states - environment[:, None, affine.state_dim :]
    multiplier = 2 * deviation[:, -1] @ cost.terminal
    for t in reversed(range(task.horizon)):
        gradient = 2 * inputs[:, t] @ cost.R + multiplier @ B[t]
        np.testing.assert_allclose(gradient, 0, atol=1e-9 * max(1, np.abs(multiplier).max()))
        multiplier = 2 * deviation[:, t] @ cost.Q + multiplier @ A[t]


def test_the_last_input_is_0_since_nothing_costs_at_T(affine):
    task = task_for(affine)
    _, tau = optimum(affine, task)
    assert np.abs(affine.layout(task.horizon).inputs(tau)[:, -1]).max() < 1e-14


def test_no_perturbation_of_the_inputs_is_cheaper(affine, rng):
    system, task = affine, task_for(affine)
    environment, tau = optimum(system, task)
    layout, target = system.layout(task.horizon), environment[:, system.state_dim :]
    cost = task.cost(system)
    best = cost(*layout.split(tau), target)
    for scale in (1e-3, 1.0):
        inputs = layout.inputs(tau) + scale * rng.standard_normal((*tau.shape[:-1], task.horizon, system.input_dim))
        states = system.simulate(environment[:, : system.state_dim], inputs)
        assert (cost(states, inputs, target) > best).all()


def test_for_long_horizons_the_gain_is_that_of_dlqr(system):
    Q, R = np.diag(np.linspace(10, 1, system.state_dim)), np.eye(system.input_dim)
    finite, infinite = optimal_feedback(system, Q, R, 300), stationary_feedback(system, Q, R, 1)
    np.testing.assert_allclose(finite.K[0], infinite.K[0], rtol=1e-9, atol=1e-9)


def test_the_stationary_expert_steers_by_the_deviation_from_the_target(system):
    Q, R = np.eye(system.state_dim), np.eye(system.input_dim)
    feedback = stationary_feedback(system, Q, R, 5)
    assert feedback.horizon == 5
    assert np.array_equal(feedback.L, -feedback.K)
    assert (feedback.K[0] == feedback.K).all()


def test_the_stationary_expert_is_refused_where_something_varies_or_is_added():
    A, B = np.eye(2), np.ones((2, 1))
    varying = TimeVarying(np.stack([A] * 5), np.stack([B] * 5), np.zeros((5, 2)))
    for system in (varying, Linear(A, B, np.ones(2))):
        with pytest.raises(ConfigError, match="expert=stationary is for systems that do not vary"):
            stationary_feedback(system, np.eye(2), np.eye(1), 5)


@pytest.mark.parametrize("solve", [optimal_feedback, stationary_feedback])
def test_a_fleet_is_its_robots_one_by_one(solve):
    robots, (Q, R) = fleet(), (np.diag([3.0, 2.0, 1.0]), np.eye(2))
    together, law = solve(robots, Q, R, 8), ClosedLoopLaw(robots, solve(robots, Q, R, 8))
    for k, robot in enumerate(members(robots)):
        alone = solve(robot, Q, R, 8)
        np.testing.assert_allclose(together.K[k], alone.K, atol=1e-12)
        np.testing.assert_allclose(together.L[k], alone.L, atol=1e-12)
        np.testing.assert_allclose(law.mean_map[k], ClosedLoopLaw(robot, alone).mean_map, atol=1e-12)
        np.testing.assert_allclose(law.noise_map[k], ClosedLoopLaw(robot, alone).noise_map, atol=1e-12)


def test_a_horizon_that_overflows_is_an_infeasible_problem():
    system = Linear([[1e200]], [[1e-200]])
    with pytest.raises(
        InfeasibleError, match="the Riccati recursion of the system leaves float range over horizon T = 9"
    ):
        optimal_feedback(system, np.eye(1), np.eye(1), 9)


# --- the law


def test_the_mean_is_the_closed_loop_without_noise(affine):
    task = task_for(affine)
    environment, tau = optimum(affine, task)
    E = task.condition(affine).unpack(environment)
    followed = follow(affine, task.feedback(affine), E["x_init"], E["target"])
    np.testing.assert_allclose(followed, tau, atol=1e-10)


def test_the_law_is_the_closed_loop_under_noise(monkeypatch, affine, rng):
    """Entry by entry: unit noise through `noise_map`, or along time, is w through the closed loop."""
    task = task_for(affine)
    law, E = task.law(affine), rng.standard_normal((5, 2 * affine.state_dim))
    unit = rng.standard_normal((5, task.horizon, affine.state_dim))
    ends = task.condition(affine).unpack(E)
    noisy = follow(affine, task.feedback(affine), ends["x_init"], ends["target"], affine.process_noise * unit)
    for dense_up_to in (2000, 10):
        monkeypatch.setattr("dadiff.experts.lqr.DENSE_UP_TO", dense_up_to)
        np.testing.assert_allclose(law.mean(E) + law.spread(unit.reshape(5, -1)), noisy, atol=1e-10)


def test_a_plan_of_the_expert_is_its_replay(affine):
    """Whatever varies or is added: the inputs, applied from x_init, give the states."""
    task = task_for(affine)
    cases = task.cases(affine, 3, numpy_generator(0, "test"))
    layout, plans = affine.layout(task.horizon), cases.reference[:, None]
    np.testing.assert_allclose(replay(affine, layout, plans, cases.x_init), plans, atol=1e-10)


@pytest.mark.parametrize("initial_state", ["free", "fixed"])
def test_known_dynamics_keep_what_the_expert_plans_and_mend_what_is_not(affine, initial_state, rng):
    task, projector = task_for(affine), Known(initial_state)
    cases, layout = task.cases(affine, 3, numpy_generator(0, "test")), affine.layout(task.horizon)
    P = projector.fit(layout, affine).bind(pins=pins(projector, layout, cases.x_init))
    np.testing.assert_allclose(P(cases.reference), cases.reference, atol=1e-10)
    mended = P(cases.reference + rng.standard_normal(cases.reference.shape))
    assert dynamics_residual(affine, layout, mended).max() < 1e-20


def test_demonstrations_have_the_laws_mean_and_covariance(affine):
    system = affine
    task, law = task_for(system, horizon=4), task_for(system, horizon=4).law(system)
    count = 20_000
    demonstrations = task.demonstrations(system, count, numpy_generator(0, "test"))
    deviation = demonstrations.trajectories - law.mean(demonstrations.environment)
    sigma = np.sqrt(np.diag(law.covariance))
    assert (np.abs(deviation.mean(axis=0)) <= 5 * sigma / np.sqrt(count) + 1e-12).all()
    spread = np.outer(sigma, sigma)
    error = np.abs(deviation.T @ deviation / count - law.covariance)
    assert (error <= 5 * np.sqrt(2 / count) * spread + 1e-15).all()


def test_the_laws_covariance_is_that_of_the_closed_loop_step_by_step(system):
    """Sigma_x(t+1) = (A + BK) Sigma_x(t) (A + BK)' + std^2 I from Sigma_x(0) = 0."""
    task = task_for(system)
    feedback, law = task.feedback(system), task.law(system)
    layout = system.layout(task.horizon)
    covariance = np.zeros((system.state_dim, system.state_dim))
    for t in range(task.horizon + 1):
        block = layout.states(law.noise_map.T)[:, t]
        np.testing.assert_allclose(block.T @ block, covariance, atol=1e-13)
        if t < task.horizon:
            closed = system.A + system.B @ feedback.K[t]
            covariance = closed @ covariance @ closed.T + system.process_noise**2 * np.eye(system.state_dim)


def test_every_demonstration_starts_at_x_init_and_is_feedback(system):
    task = task_for(system)
    made = task.demonstrations(system, 5, numpy_generator(0, "test"))
    states, inputs = system.layout(task.horizon).split(made.trajectories)
    x_init, target = np.split(made.environment, 2, axis=-1)
    feedback = task.feedback(system)
    np.testing.assert_allclose(states[:, 0], x_init, atol=1e-14)
    for t in range(task.horizon):
        np.testing.assert_allclose(inputs[:, t], states[:, t] @ feedback.K[t].T + target @ feedback.L[t].T, atol=1e-11)


# --- the task


def test_environments_are_uniform_in_the_papers_ranges():
    E = LQR().sample_environments(double_integrator(), (5000,), numpy_generator(0, "test"))
    x_init, target = np.split(E, 2, axis=-1)
    for values, bound in ((x_init, 1.0), (target, 4.0)):
        assert np.abs(values).max() <= bound
        np.testing.assert_allclose(values.std(axis=0), bound / np.sqrt(3), rtol=0.05)


def test_a_realised_reference_is_one_noisy_run():
    system, seed = double_integrator(), 0
    mean, realised = (
        LQR(reference=choice).cases(system, 4, numpy_generator(seed, "test")) for choice in ("mean", "realised")
    )
    assert np.array_equal(mean.environment, realised.environment)
    gap = np.abs(mean.reference - realised.reference).max(axis=-1)
    assert ((gap > 1e-3) & (gap < 1)).all()


def test_the_cost_ratio_is_1_at_the_optimum_and_more_elsewhere(system, rng):
    task = task_for(system)
    cases = task.cases(system, 4, numpy_generator(0, "test"))
    planned = cases.reference[:, None].repeat(3, axis=1)
    ratio = task.score(system, cases, planned, planned).per_plan["cost_ratio"]
    assert ratio.shape == (4, 3)
    np.testing.assert_allclose(ratio, 1, rtol=1e-12)
    stationary = task_for(system, expert="stationary")
    theirs = stationary.cases(system, 4, numpy_generator(0, "test")).reference[:, None]
    assert (stationary.score(system, cases, theirs, theirs).per_plan["cost_ratio"] >= 1 - 1e-12).all()


def test_within_bounds_the_reference_is_the_optimum_among_what_keeps_them(affine):
    m, task = affine.input_dim, full_task(affine)
    largest = np.abs(affine.layout(12).inputs(task.cases(affine, 5, numpy_generator(0, "test")).reference)).max()
    bounded = replace(affine, bounds=Bounds(input_low=-largest / 2, input_high=np.full(m, largest / 2)))
    cases, layout = task.cases(bounded, 5, numpy_generator(0, "test")), bounded.layout(12)
    states, inputs = layout.split(cases.reference)
    np.testing.assert_allclose(np.abs(inputs).max(), largest / 2, rtol=1e-6)
    np.testing.assert_allclose(bounded.simulate(cases.x_init, inputs), states, atol=1e-6 * np.abs(states).max())
    np.testing.assert_allclose(task.solve(bounded, cases.environment), cases.reference, atol=1e-3 * largest)
    planned = np.stack([cases.reference, task.solve(affine, cases.environment)], axis=-2)
    scores = task.score(bounded, cases, planned, planned).per_plan
    np.testing.assert_allclose(scores["bounded_cost_ratio"][:, 0], 1, rtol=1e-12)
    assert scores["cost_ratio"].min() >= 1 - 1e-6  # the free optimum costs least
    assert (scores["bounded_cost_ratio"][:, 1] <= 1 + 1e-6).all()
    wide = replace(affine, bounds=Bounds(input_high=1e3 * largest, state_low=-1e6))
    free = task.mean(affine, cases.environment)
    np.testing.assert_allclose(task.mean(wide, cases.environment), free, atol=1e-4 * np.abs(free).max())


def test_within_bounds_demonstrations_are_noisy_runs_that_saturate():
    bounded, task = replace(SYSTEMS["paper"], bounds=Bounds(-2.0, 2.0)), task_for(SYSTEMS["paper"])
    layout = bounded.layout(task.horizon)
    shown = task.demonstrations(bounded, 50, numpy_generator(0, "training"))
    states, inputs = layout.split(shown.trajectories)
    assert np.abs(inputs).max() == 2.0
    off = states[:, 1:] - bounded.step(states[:, :-1], inputs)
    assert off.std() == pytest.approx(bounded.process_noise, rel=0.1)
    silent = replace(bounded, process_noise=0.0)
    calm = task.realise(silent, shown.environment, numpy_generator(0, "training"))
    np.testing.assert_allclose(calm, task.solve(silent, shown.environment), atol=1e-8)
    stationary = replace(task, expert="stationary").realise(silent, shown.environment, numpy_generator(0, "training"))
    assert np.abs(layout.inputs(stationary)).max() == 2.0


def test_where_no_trajectory_keeps_states_within_bounds_inputs_are_kept():
    system = replace(SYSTEMS["paper"], bounds=Bounds(-0.1, 0.1, state_high=1.0), process_noise=0.0)
    ends = np.zeros((2, 8))
    ends[1, [0, 2]] = 0.9, 1.0  # too fast to be stopped before the bound
    task = task_for(system)
    states, inputs = system.layout(task.horizon).split(task.solve(system, ends))
    assert np.abs(inputs).max() <= 0.1
    assert (states[0] <= 1).all()
    assert states[1].max() > 1


def test_within_bounds_a_fleet_is_its_robots_one_by_one():
    robots = replace(fleet(), bounds=Bounds(input_low=-0.5, input_high=0.5))
    task = task_for(robots)
    E = task.sample_environments(robots, (3, 2), numpy_generator(0, "test"))
    alone = [replace(robot, bounds=robots.bounds) for robot in members(robots)]
    expected = np.stack([task.mean(one, e) for one, e in zip(alone, E, strict=True)])
    np.testing.assert_allclose(task.mean(robots, E), expected, atol=1e-9)


def test_a_start_out_of_bounds_has_no_optimum_and_is_named():
    system = replace(SYSTEMS["paper"], bounds=Bounds(state_high=1.0))
    with pytest.raises(InfeasibleError, match=r"from x_init = \[2.0, 0.0, 0.0, 0.0\] no trajectory within"):
        task_for(system).mean(system, np.array([[2.0, 0, 0, 0, 0, 0, 0, 0]]))


@pytest.mark.parametrize(
    "options",
    [
        {"horizon": 0},
        {"state_cost": (1.0, -1.0, 1.0, 1.0)},
        {"state_cost": (1.0, float("nan"), 1.0, 1.0)},
        {"state_cost": (0.0, 0.0, 0.0, 0.0)},
        {"state_cost": [[1.0, 2.0], [2.0, 1.0]]},
        {"state_cost": [[1.0, 2.0], [0.0, 1.0]]},
        {"state_cost": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]},
        {"state_cost": [[1.0, 0.0], [0.0]]},
        {"input_cost": 0.0},
        {"input_cost": [[1.0, 1.0], [1.0, 1.0]]},
        {"terminal_cost": -1.0},
        {"init_range": [1.0, [2.0, 1.0]]},
        {"init_range": [1.0, [2.0]]},
        {"target_range": [1.0, [0.0, float("nan")]]},
        {"target_range": [1.0, [-float("inf"), 0.0]]},
        {"target_range": [1.0, [0.0, float("inf")]]},
        {"init_range": 0.0, "target_range": [0.0, [0.0, 0.0]]},
        {"input_cost": float("nan")},
        {"init_range": -1.0},
        {"target_range": float("inf")},
    ],
)
def test_values_out_of_range_are_refused_in_one_line(options):
    with pytest.raises(ConfigError, match=r"^task: [^\n]*$"):
        LQR(**options)


@pytest.mark.parametrize(
    ("weight", "found"),
    [([[1.0, 2.0], [2.0, 1.0]], r"its eigenvalues are \[-1.0, 3.0\]"), ((1.0, -2.0), r"\[1.0, -2.0\]"), (-1.0, "-1.0")],
)
def test_of_a_weight_that_is_not_definite_it_is_said_what_is_negative(weight, found):
    with pytest.raises(ConfigError, match=rf"found {found}$"):
        LQR(state_cost=weight)


@pytest.mark.parametrize("state_cost", [(), (1.0, 1.0, 1.0)])
def test_one_weight_a_state(state_cost):
    with pytest.raises(ConfigError, match=rf"state_cost has {len(state_cost)} entries, the system 4 states"):
        LQR(state_cost=state_cost).feedback(double_integrator())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"input_cost": [1.0, 2.0, 3.0]},
            "input_cost has 3 entries, the system 2 inputs; give one",
        ),
        ({"terminal_cost": [[1.0]]}, "terminal_cost has 1 entries, the system 4 states"),
        ({"init_range": [1.0]}, "init_range has 1 items, the system 4 states"),
    ],
)
def test_sizes_that_are_not_the_systems_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        LQR(**options).cases(double_integrator(), 1, numpy_generator(0, "test"))


def test_starts_and_targets_fill_their_ranges():
    task = LQR(init_range=[0.5, [-1.0, 3.0], 0.0, [2.0, 2.0]], target_range=[1.0, 2.0, 3.0, 4.0])
    system = double_integrator()
    E = task.condition(system).unpack(task.sample_environments(system, (4000,), numpy_generator(0, "test")))
    np.testing.assert_allclose(E["x_init"].min(0), [-0.5, -1, 0, 2], atol=0.01)
    np.testing.assert_allclose(E["x_init"].max(0), [0.5, 3, 0, 2], atol=0.01)
    np.testing.assert_allclose(E["target"].max(0), [1, 2, 3, 4], atol=0.02)


def test_demonstrations_along_begin_where_the_expert_passes():
    """Without noise: from any of its states on, the optimum's value is what the expert's controller had left to do."""
    system, task = double_integrator(process_noise=0.0), LQR(horizon=10, init_range=1.0)
    drawn = task.sample_environments(system, (300,), numpy_generator(0, "test"))
    E = task.condition(system).unpack(task.on_the_way(system, drawn, numpy_generator(1, "test")))
    passed = system.layout(10).states(task.law(system).mean(drawn))
    distance = np.linalg.norm(passed - E["x_init"][:, None], axis=-1)
    assert distance.min(axis=1).max() < 1e-9
    times = distance.argmin(axis=1)
    assert np.bincount(times, minlength=11).min() > 0
    np.testing.assert_array_equal(E["target"], task.condition(system).get(drawn, "target"))


def test_a_data_set_begins_along_trajectories_where_it_is_asked_to():
    system, task = double_integrator(), LQR(horizon=10)
    made = [Generated(train_size=500, start_states=start) for start in ("drawn", "along")]
    drawn, along_the_way = (task.condition(system).get(g.train(task, system).environment, "x_init") for g in made)
    assert np.abs(drawn).max() <= 1
    assert np.abs(along_the_way).max() > 2
    assert made[0].determined_by("train") != made[1].determined_by("train")
    assert made[0].determined_by("test") == made[1].determined_by("test")
    fleet_task, family = Fleet(robots=2, horizon=10), DampedIntegrators()
    assert fleet_task.demonstrations_along(family, 3, numpy_generator(0, "test")).trajectories.shape == (6, 64)
    with pytest.raises(NotApplicableError, match="is for task=lqr and task=fleet, found Obstacles"):
        made[1].train(Obstacles(), double_integrator(process_noise=0.0))
    with pytest.raises(NotApplicableError, match="do not vary in time"):
        made[1].train(task_for(AFFINE["time-varying"]), AFFINE["time-varying"])


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e20])
def test_whether_a_weight_is_positive_does_not_depend_on_its_size(size):
    check_weight((size * np.diag([1.0, 1e-6])).tolist(), "weight", positive=True)
    check_weight((size * np.diag([1.0, 0.0])).tolist(), "weight", positive=False)
    for least, positive in ((-1e-6, False), (0.0, True)):
        with pytest.raises(ConfigError, match="must be"):
            check_weight((size * np.diag([1.0, least])).tolist(), "weight", positive=positive)


def test_a_plan_of_one_step_is_a_plan(system):
    task = task_for(system, horizon=1)
    assert task.sample_environments(system, (3,), np.random.default_rng(0)).shape == (3, 2 * system.state_dim)
    assert task.solve(system, np.zeros((1, 2 * system.state_dim))).shape == (1, system.layout(1).size)
    with pytest.raises(ConfigError, match="horizon"):
        task_for(system, horizon=0)


def test_a_stretched_range_keeps_its_middle_and_times_its_width():
    assert stretched(0.5, 3) == 1.5
    assert stretched([0.5, [1.0, 4.0]], 3) == [1.5, [-2.0, 7.0]]

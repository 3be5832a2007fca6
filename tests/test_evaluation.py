"""Laws of evaluation: squared errors along time, the tables they are kept in, and the means that headline them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from laws import fleet, members, trajectories

from dadiff.errors import ConfigError
from dadiff.evaluation import Evaluation, replay, spread, tracking_errors, violations
from dadiff.evaluation.errors import dynamics_residual
from dadiff.evaluation.records import Snapshots, headline, long_table, merged, tables
from dadiff.systems import Bounds
from dadiff.tasks import Cases, Scores
from dadiff.trajectory import Channel, Layout

HORIZON, CASES, SAMPLES = 5, 3, 2


def some_cases(system) -> Cases:
    tau, x_init = trajectories(system, HORIZON, CASES)
    return Cases(Layout((Channel("x_init", system.state_dim),)), x_init, tau)


def scores_of(system, cases: Cases, planned: np.ndarray) -> Scores:
    layout = system.layout(HORIZON)
    return tracking_errors(system, layout, cases, planned, replay(system, layout, planned, cases.x_init))


def test_a_plan_that_is_the_reference_has_no_error(system):
    cases = some_cases(system)
    scores = scores_of(system, cases, cases.reference[:, None].repeat(SAMPLES, axis=1))
    for name, values in {**scores.per_step, **scores.per_plan}.items():
        assert np.nanmax(values) < 1e-20, name
        assert values.shape[:2] == (CASES, SAMPLES)


def test_errors_are_squared_norms_against_the_reference_of_the_case(system, rng):
    cases, layout = some_cases(system), system.layout(HORIZON)
    planned = cases.reference[:, None] + rng.standard_normal((CASES, SAMPLES, layout.size))
    scores = scores_of(system, cases, planned)
    x, u = layout.split(planned[2, 1])
    x_ref, u_ref = layout.split(cases.reference[2])
    rolled = system.simulate(cases.x_init[2], u)
    by_hand = {
        "planned_state_error": [np.sum((x[t] - x_ref[t]) ** 2) for t in range(HORIZON + 1)],
        "planned_input_error": [np.sum((u[t] - u_ref[t]) ** 2) for t in range(HORIZON)] + [np.nan],
        "rollout_state_error": [np.sum((rolled[t] - x_ref[t]) ** 2) for t in range(HORIZON + 1)],
        "gap": [np.sum((x[t] - rolled[t]) ** 2) for t in range(HORIZON + 1)],
        "dynamics_residual": [np.sum((x[t + 1] - system.A @ x[t] - system.B @ u[t]) ** 2) for t in range(HORIZON)]
        + [np.nan],
    }
    assert set(by_hand) == set(scores.per_step)
    for name, expected in by_hand.items():
        np.testing.assert_allclose(scores.per_step[name][2, 1], expected, rtol=1e-9, atol=1e-20)
    initial = scores.per_plan["initial_state_error"][2, 1]
    np.testing.assert_allclose(initial, np.sum((x[0] - cases.x_init[2]) ** 2))


def test_a_replay_keeps_the_inputs_and_obeys_the_dynamics_from_x_init(system, rng):
    layout = system.layout(HORIZON)
    x_init = rng.standard_normal((CASES, system.state_dim))
    planned = rng.standard_normal((CASES, SAMPLES, layout.size))
    rolled = replay(system, layout, planned, x_init)
    assert np.array_equal(layout.inputs(rolled), layout.inputs(planned))
    assert np.array_equal(
        layout.states(rolled)[:, :, 0], np.broadcast_to(x_init[:, None], (CASES, SAMPLES, system.state_dim))
    )
    assert dynamics_residual(system, layout, rolled).max() < 1e-20


def test_a_fleet_is_its_robots_one_by_one(rng):
    robots = fleet()
    cases = some_cases(robots)
    planned = rng.standard_normal((3, CASES, SAMPLES, robots.layout(HORIZON).size))
    together = scores_of(robots, cases, planned)
    for k, robot in enumerate(members(robots)):
        own = Cases(cases.condition, cases.environment[k], cases.reference[k])
        alone = scores_of(robot, own, planned[k])
        for name, values in {**alone.per_step, **alone.per_plan}.items():
            both = {**together.per_step, **together.per_plan}[name][k]
            np.testing.assert_allclose(both, values, rtol=1e-9, atol=1e-20)


def test_tables_have_a_row_an_entry(rng):
    values = rng.random((2, 3, 4, 5))
    table = long_table({"error": values}, ("case", "sample", "t"))
    assert list(table.columns) == ["robot", "case", "sample", "t", "error"]
    assert len(table) == values.size
    row = table[(table.robot == 1) & (table.case == 2) & (table["sample"] == 3) & (table.t == 4)]
    np.testing.assert_allclose(row.error.item(), values[1, 2, 3, 4], rtol=1e-6)
    assert "robot" not in long_table({"error": values[0]}, ("case", "sample", "t"))


def test_headlines_are_means_that_leave_out_what_is_not_defined():
    steps, plans = np.array([[[1.0, 3.0, np.nan]]]), np.array([[5.0]])
    scores = merged(Scores(per_step={"a": steps}), Scores(per_plan={"b": plans}))
    assert headline(scores) == {"a": 2.0, "b": 5.0}
    assert {name: len(table) for name, table in tables(scores).items()} == {"per_step": 3, "per_plan": 1}


def test_snapshots_run_from_noise_to_the_plan():
    alpha_bar = np.linspace(1, 0, 21)
    snapshots = Snapshots(alpha_bar, (1,))
    for j in range(19, -1, -1):
        for stage in ("predict", "project"):
            snapshots(j, stage, torch.full((2, 3), float(j)))
    steps, plans = snapshots.stacked()
    assert list(steps) == snapshots.steps[1:]  # noise itself is no step that is reached
    assert steps[-1] == 0
    assert (plans[-1] == 0).all()
    assert plans.shape == (len(steps), 3)


def test_snapshots_of_a_short_chain_bear_the_steps_that_it_visits():
    snapshots = Snapshots(np.linspace(1, 0, 1001), (0,))
    for j in range(900, -1, -100):
        snapshots(j, "project", torch.full((1, 3), float(j)))
    snapshots(0, "end", torch.full((1, 3), -1.0))
    steps, plans = snapshots.stacked()
    assert len(set(steps)) == len(steps) > 3
    np.testing.assert_array_equal(plans[:-1, 0], steps[:-1])
    assert (steps[-1], plans[-1, 0]) == (0, -1)


@pytest.mark.parametrize(
    "options", [{"samples": 0}, {"divergence_bound": 0.0}, {"divergence_bound": float("nan")}, {"examples": -1}]
)
def test_values_out_of_range_are_refused_in_one_line(options):
    with pytest.raises(ConfigError, match=r"^evaluation: [^\n]*$"):
        replace(Evaluation(), **options)


def test_spread_is_the_trace_of_the_covariance_of_a_cases_plans():
    rng = np.random.default_rng(0)
    deviation, cases = np.array([1.0, 2.0, 0.5]), 400
    planned = rng.standard_normal((cases, 1, 3)) * 100 + rng.standard_normal((cases, 5, 3)) * deviation
    found = spread(planned, covariance_trace=float((deviation**2).sum())).per_plan
    np.testing.assert_allclose(found["spread"].mean(axis=-1), planned.var(axis=-2, ddof=1).sum(axis=-1))
    np.testing.assert_allclose(found["spread"].mean(), (deviation**2).sum(), rtol=0.1)
    np.testing.assert_allclose(found["spread_ratio"].mean(), 1, rtol=0.1)
    assert spread(planned).per_plan.keys() == spread(planned, covariance_trace=0.0).per_plan.keys() == {"spread"}
    assert spread(planned[:, :1]).per_plan == {}


def test_a_violation_is_the_largest_of_a_plan_over_entries_and_time(system, rng):
    cases, layout = some_cases(system), system.layout(HORIZON)
    bounded = replace(system, bounds=Bounds(input_high=0.5, state_low=-1.0))
    planned = rng.standard_normal((CASES, SAMPLES, layout.size))
    planned[0, 0] = 0.25
    x, u = layout.split(planned)
    expected = np.maximum((u - 0.5).max((-2, -1)), (-1.0 - x).max((-2, -1))).clip(0)
    rollout = replay(system, layout, planned, cases.x_init)
    scores = violations(bounded, layout, planned, rollout)
    np.testing.assert_allclose(scores.per_plan["violation"], expected)
    np.testing.assert_array_equal(scores.per_plan["violating"], expected > 0)
    assert scores.per_plan["violating"][0, 0] == 0
    assert headline(scores)["largest_violation"] == expected.max()
    assert (scores.per_plan["rollout_violation"] >= (u - 0.5).max((-2, -1)).clip(0)).all()
    assert violations(system, layout, planned, rollout) == Scores()

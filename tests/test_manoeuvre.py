"""The manoeuvre: optima of nonlinear robots, what is scored and refused, and a run from configuration to result."""

from __future__ import annotations

import numpy as np
import pytest
from laws import composed

from dadiff.behaviours import Nominal, model_of
from dadiff.errors import ConfigError
from dadiff.evaluation import replay
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.systems import DampedIntegrators, PlanarQuadrotor, PlanarQuadrotors
from dadiff.tasks import Manoeuvre, manoeuvre

SMALL = {"horizon": 10, "robots": 4, "interpolation": 3, "extrapolation": 2}
TINY = ["task=manoeuvre", "task.robots=4", "task.interpolation=3", "task.extrapolation=2", "task.horizon=10"]
TINY += ["dataset.train_size=5", "dataset.test_size=2", "training.steps=5", "denoiser.width=8", "denoiser.blocks=1"]
TINY += ["sampler.num_steps=4", "progress=false"]


@pytest.fixture
def task() -> Manoeuvre:
    return Manoeuvre(**SMALL)


def test_references_are_feasible_and_optimal(task, rng):
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 3, rng)
    layout = robots.layout(task.horizon)
    states, inputs = layout.split(cases.reference)
    np.testing.assert_array_equal(states[..., 0, :], cases.x_init)
    np.testing.assert_array_equal(robots.simulate(cases.x_init, inputs), states)
    assert cases.notes == {"share converged": 1.0}
    nearby = inputs[:, :, None] + 0.1 * rng.standard_normal((5, 3, 20, task.horizon, 2))
    rollout = layout.flatten(robots.simulate(cases.x_init[:, :, None], nearby), nearby)
    scores = task.score(robots, cases, rollout, rollout)
    assert scores.per_plan["cost_ratio"].shape == (5, 3, 20)
    assert (scores.per_plan["cost_ratio"] > 1).all()


def test_every_robot_is_given_the_same_cases_and_demonstrations_are_of_others(task, rng):
    family = PlanarQuadrotors()
    robots = task.target(family)
    cases = task.cases(robots, 3, rng)
    assert (cases.environment == cases.environment[0]).all()
    assert list(robots.distance > 0) == [False] * 3 + [True] * 2
    demonstrations = task.demonstrations(family, 3, rng)
    assert demonstrations.trajectories.shape == (12, robots.layout(10).size)
    assert demonstrations.notes == {"robots": 4.0, "demonstrations a robot": 3.0, "share converged": 1.0}
    condition = task.condition(robots)
    targets = condition.get(demonstrations.environment, "target")
    path = robots.layout(10).states(demonstrations.trajectories)[..., :2]
    away = np.linalg.norm(path - targets[:, None], axis=-1).mean(axis=0)
    assert away[-1] < away[0]


def test_robots_are_taken_one_by_one(rng):
    robots = PlanarQuadrotors().outside(5, 1.5, rng)
    x, u = rng.standard_normal((5, 2, 6)), rng.standard_normal((5, 2, 2))
    chosen = robots.take([3, 1])
    np.testing.assert_array_equal(chosen.step(x[[3, 1]], u[[3, 1]]), robots.step(x, u)[[3, 1]])
    np.testing.assert_array_equal(chosen.distance, robots.distance[[3, 1]])


def test_the_cost_is_the_stated_one(task, rng):
    robots = task.target(PlanarQuadrotors())
    layout = robots.layout(task.horizon)
    tau, target = rng.standard_normal((5, 1, layout.size)), np.array([1.0, -1.0])
    x, u = layout.split(tau[0, 0])
    deviation = (x - [1.0, -1.0, 0, 0, 0, 0]) ** 2 @ task.state_cost
    expected = deviation[:-1].sum() + 50 * deviation[-1] + 0.05 * (u**2).sum()
    assert task.cost(robots, tau, target)[0, 0] == pytest.approx(expected)


@pytest.mark.parametrize(("told", "length"), [("nothing", 8), ("robot_parameters", 11), ("recording", 8 + 4 * 14)])
def test_what_is_told_of_the_robot_follows_start_and_target(told, length, rng):
    task = Manoeuvre(condition_on=told, recording_length=4, **SMALL)
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 2, rng)
    assert task.condition(robots).size == cases.environment.shape[-1] == length
    if told == "robot_parameters":
        np.testing.assert_array_equal(cases.get("parameters")[:, 0], robots.parameter_table)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Manoeuvre(horizon=0), "horizon is 0"),
        (lambda: Manoeuvre(input_cost=0.0), "input_cost is 0"),
        (lambda: Manoeuvre(state_cost=(-1.0,)), "state_cost is"),
        (lambda: Manoeuvre(robots=0), "robots is 0"),
        (lambda: Manoeuvre(**SMALL).target(PlanarQuadrotor()), "draws robots from a family, found a single system"),
        (lambda: Manoeuvre(**SMALL).target(DampedIntegrators()), "state_cost has 6 entries, the system 4 states"),
        (
            lambda: Manoeuvre(**SMALL, target_range=(1.0, 1.0, 1.0)).target(PlanarQuadrotors()),
            r"with its 3 leading states held it rests nowhere near \[1.0, 1.0, 1.0\]",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize("overrides", [[], ["projector=none"], ["enforcement=post_hoc", "projector.sweeps=4"]])
def test_a_run_plans_for_nonlinear_robots(overrides, tmp_path):
    run = execute(Experiment.of(composed(*TINY, *overrides, f"output_dir={tmp_path}")))
    metrics = run.record.metrics
    assert metrics["cost_ratio"] >= 0.99
    if "projector=none" not in overrides:
        assert metrics["gap"] < 1e-12
        assert metrics["initial_state_error"] < 1e-24


def test_in_closed_loop_the_expert_plans_anew(task, rng):
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 3, rng)
    np.testing.assert_allclose(task.solve(robots, cases.environment), cases.reference, atol=1e-12)
    goal = task.goal(robots, cases.environment)
    np.testing.assert_array_equal(goal[..., :2], cases.get("target"))
    np.testing.assert_array_equal(goal[..., 2:], 0)
    Q, R = task.weights(robots)
    np.testing.assert_array_equal(np.diag(Q), [1, 1, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_array_equal(R, 0.05 * np.eye(2))


def test_the_expert_begins_where_it_is_told_and_may_be_wrong_about_the_robot(task, rng):
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 3, rng)
    near = cases.reference + 1e-3 * rng.standard_normal(cases.reference.shape)
    found = task.solve(robots, cases.environment, start=near)
    np.testing.assert_allclose(found, cases.reference, atol=1e-4)
    once, thrice = (task.solve(robots, cases.environment, start=near, sweeps=k) - cases.reference for k in (1, 3))
    assert np.abs(thrice).max() < np.abs(once).max()
    nominal = Nominal("fixed").fit(robots.layout(task.horizon), robots)
    model = model_of(nominal)
    np.testing.assert_array_equal(model.parameter_table, np.broadcast_to([1.0, 1.2, 0.5], (5, 3)))
    planned = task.solve(robots, cases.environment, model)[..., None, :]
    rollout = replay(robots, robots.layout(task.horizon), planned, cases.x_init)
    assert (task.score(robots, cases, planned, rollout).per_plan["cost_ratio"] > 1).all()


def test_states_may_cost_nothing_and_starts_and_targets_may_be_given():
    task = Manoeuvre(state_cost=(1, 1, 0, 0, 0, 0), init_range=(1, 1, 0, 0, 0, 0), target_range=(0, 0), **SMALL)
    drawn = task._draw((50,), np.random.default_rng(0))
    np.testing.assert_array_equal(drawn.any(axis=0), [True, True] + 6 * [False])


@pytest.mark.parametrize(("plans", "at_once", "robots"), [(1, 1, 1), (3, 7, 2), (3, 2, 1), (2, 500, 5)])
def test_problems_are_solved_so_many_side_by_side_but_never_less_than_a_robots(
    plans, at_once, robots, task, rng, monkeypatch
):
    sizes, solve = [], manoeuvre.solve
    family, environment = task.target(PlanarQuadrotors()), task._draw((5, plans), rng)
    together = task.optimum(family, environment)
    monkeypatch.setattr(manoeuvre, "_CHUNK", at_once)
    monkeypatch.setattr(manoeuvre, "solve", lambda one, *a, **k: sizes.append(len(one.x_init)) or solve(one, *a, **k))
    apart = task.optimum(family, environment)
    assert max(sizes) == robots
    assert sum(sizes) == 5
    np.testing.assert_allclose(apart.tau, together.tau, atol=1e-9)


LOOP = ["evaluation=closed_loop", "evaluation.replan_every=[5]", "evaluation.steps=10"]
ROUGH = ["recording=quadrotor", "projector.features=[constant,identity,trigonometric,control_affine]"]
ROUGH += ["projector.angles=[2]", "projector.ridge=0.01", "projector.initial_state=fixed"]


@pytest.mark.parametrize("overrides", [[], ["projector=nominal"], ["projector=identified", *ROUGH]])
def test_a_run_closes_the_loop_with_whatever_robot_the_planner_believes_in(overrides, tmp_path):
    controllers = "evaluation.controllers=[receding,tracking,modelled,realtime,optimal]"
    delayed = ["evaluation.delay=1"] if not overrides else []
    configuration = composed(*TINY, *LOOP, controllers, *delayed, *overrides, f"output_dir={tmp_path}")
    metrics = execute(Experiment.of(configuration)).record.metrics
    assert metrics["closed_loop_optimal_5"] == 1
    assert metrics["closed_loop_same_realtime_5"] == pytest.approx(1, abs=0.05)
    for controller in ("receding", "tracking", "modelled"):
        assert np.isfinite(metrics[f"closed_loop_same_{controller}_5"])
    assert ("model_cost_ratio" in metrics) == bool(overrides)
    if overrides:
        assert metrics["closed_loop_same_modelled_5"] != 1
        assert metrics["model_cost_ratio"] > 1
        assert metrics["prediction_error"] > 0


def test_a_manoeuvre_of_one_step_is_one():
    assert Manoeuvre(**{**SMALL, "horizon": 1}).horizon == 1

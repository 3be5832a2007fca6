"""Closed loop: the same disturbances for all, the expert as yardstick, chains that begin from the last plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dadiff.behaviours import Known
from dadiff.denoisers import Gaussian
from dadiff.diffusion.chain import Start
from dadiff.diffusion.enforcement import CleanEstimate
from dadiff.diffusion.samplers import DDIM
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.evaluation import ClosedLoop
from dadiff.evaluation.closed_loop import Bench, latencies, means
from dadiff.planning import Planner
from dadiff.randomness import numpy_generator
from dadiff.systems import DampedIntegrators, TimeVarying, double_integrator
from dadiff.tasks import LQR, Fleet
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory.coordinates import physical

SYSTEM, TASK, SCHEDULE = double_integrator(), LQR(), paper_linear()
LAYOUT = SYSTEM.layout(TASK.horizon)
CASES = TASK.cases(SYSTEM, 4, numpy_generator(0, "cases"))
PLANNER = Planner(
    TASK, SYSTEM, SCHEDULE, DDIM(10), Gaussian().exact(TASK.law(SYSTEM), physical(LAYOUT), SCHEDULE), physical(LAYOUT),
    Known("fixed").fit(LAYOUT, system=SYSTEM), CleanEstimate(), True,
)  # fmt: skip


def bench(**settings: object) -> Bench:
    return Bench(PLANNER, CASES, ClosedLoop(**{"replan_every": (1, 10), "disturbance": 0.05, **settings}))


def test_a_row_for_each_controller_interval_and_case():
    table = bench().table()
    assert len(table) == 3 * 2 * 4
    assert set(table["controller"]) == {"receding", "tracking", "optimal"}
    best = table[(table["controller"] == "optimal") & (table["every"] == 1)]
    np.testing.assert_array_equal(best["cost_ratio"], 1)
    np.testing.assert_array_equal(table[table["controller"] == "optimal"]["cost_ratio_same"], 1)
    found = means(table)
    for one in ("closed_loop_optimal_1", "closed_loop_same_optimal_10", "closed_loop_time_optimal_1"):
        assert found[one] == 1
    assert found["closed_loop_same_receding_10"] == pytest.approx(
        table[(table["controller"] == "receding") & (table["every"] == 10)]["cost_ratio_same"].mean()
    )
    assert found["closed_loop_time_receding_1"] > 0


def test_exact_plans_replanned_at_each_step_cost_what_the_optimum_costs():
    """The exact denoiser knows the law of optimal runs, so its plans are optimal up to the spread of the law."""
    table = bench(disturbance=0.01, replan_every=(1,), controllers=("receding",)).table()
    assert table["cost_ratio"].mean() < 1.02


def test_gains_help_where_plans_are_seldom():
    table = bench(disturbance=0.1, replan_every=(30,), controllers=("receding", "tracking")).table()
    mean = table.groupby("controller")["cost_ratio"].mean()
    assert mean["tracking"] < mean["receding"]


def test_an_expert_that_is_quicker_than_the_clock_has_no_share_of_time(monkeypatch):
    monkeypatch.setattr("dadiff.control.controllers.time.process_time", lambda: 1.0)
    table = bench(replan_every=(30,), controllers=("receding",)).table()
    assert table["time_share"].isna().all()
    assert table["cost_ratio"].notna().all()


def test_costs_are_over_those_of_the_expert_at_the_shortest_interval():
    table = bench(replan_every=(10, 5), controllers=("optimal",)).table()
    mean = table.groupby("every")["cost_ratio"].mean()
    assert mean[5] == 1
    assert mean[10] > 1


def test_with_the_right_model_the_expert_is_the_expert_and_with_a_wrong_one_it_pays():
    table = bench(disturbance=0.05, controllers=("modelled",)).table()
    np.testing.assert_allclose(table["cost_ratio_same"], 1)
    wrong = double_integrator(time_step=0.3)
    planner = replace(PLANNER, behaviour=Known("fixed").fit(LAYOUT, system=wrong))
    wronged = Bench(planner, CASES, ClosedLoop(replan_every=(10,), controllers=("modelled",))).table()
    assert (wronged["cost_ratio_same"] > 1.01).all()


def test_every_controller_meets_the_same_disturbances():
    first, second = bench(), bench(replan_every=(5,))
    np.testing.assert_array_equal(first._disturbance(), second._disturbance())
    assert not np.array_equal(first._disturbance(), bench(seed=1)._disturbance())


def test_same_seed_same_episodes():
    one, two = (bench().episode("receding", 10) for _ in range(2))
    np.testing.assert_array_equal(one.states, two.states)


def test_an_episode_may_be_longer_than_a_plan():
    episode = bench(steps=70).episode("receding", 10)
    assert episode.steps == 70
    goal = CASES.get("target")
    assert np.linalg.norm(episode.states[:, -1] - goal, axis=-1).max() < 5


def test_a_fleet_has_a_row_for_each_robot():
    task, family = Fleet(robots=5, interpolation=2, extrapolation=1), DampedIntegrators()
    robots = task.target(family)
    cases = task.cases(robots, 2, numpy_generator(0, "cases"))
    planner = Planner(
        task, robots, SCHEDULE, DDIM(5), lambda tau, i, E: 0 * tau, physical(LAYOUT),
        Known("fixed").fit(LAYOUT, system=robots), CleanEstimate(), True,
    )  # fmt: skip
    table = Bench(planner, cases, ClosedLoop(replan_every=(10,), controllers=("receding",))).table()
    assert sorted(set(zip(table["robot"], table["case"], strict=True))) == [(r, c) for r in range(3) for c in range(2)]
    assert (table["cost_ratio"] > 1).all()  # a denoiser that knows nothing


def test_what_cannot_be_planned_for_again_is_refused():
    wrong = replace(PLANNER, task=Obstacles())
    with pytest.raises(ConfigError, match="closed_loop needs a task that steers to a goal"):
        Bench(wrong, CASES, ClosedLoop()).table()
    A, B, c = SYSTEM.matrices(TASK.horizon)
    with pytest.raises(NotApplicableError, match="each time from t = 0, but the system varies"):
        Bench(replace(PLANNER, system=TimeVarying(A, B, c)), CASES, ClosedLoop()).table()


BAD = [
    ({"replan_every": ()}, "replan_every is []"),
    ({"replan_every": (0,)}, "replan_every is [0]"),
    ({"steps": 0}, "steps is 0"),
    ({"delay": -1}, "delay -1"),
    ({"rate": 0.0}, "rate is 0"),
    ({"disturbance": -1.0}, "disturbance -1"),
]


@pytest.mark.parametrize(("settings", "message"), BAD, ids=[message for _, message in BAD])
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ConfigError) as caught:
        ClosedLoop(**settings)
    assert message in str(caught.value)


def test_a_start_is_noised_to_its_signal_and_leaves_few_steps():
    tau = torch.full((50_000, 1), 3.0, dtype=torch.float64)
    steps = DDIM(50, spacing="log_snr").steps(SCHEDULE)
    generator = torch.Generator().manual_seed(0)
    noised, left = Start(tau, 0.5).noised(steps, SCHEDULE, lambda: torch.randn(tau.shape, generator=generator))
    a = SCHEDULE.alpha_bar[left[0].i]
    assert 0.5 <= a < SCHEDULE.alpha_bar[left[1].i]
    assert len(left) <= len(steps) / 2
    assert float(noised.mean()) == pytest.approx(a**0.5 * 3, abs=0.02)
    assert float(noised.std()) == pytest.approx((1 - a) ** 0.5, abs=0.02)


def test_latencies_are_those_of_single_plans():
    seconds = latencies(PLANNER, CASES.environment[:1], count=4)
    assert len(seconds) == 4
    assert (seconds > 0).all()

"""The fleet: families of robots, the task's laws, projections of many robots at once, and stored runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from dadiff.behaviours import HankelLowRank, Identified, Known, Pin, pins
from dadiff.config.composed import plain
from dadiff.config.settings import GROUPS
from dadiff.datasets import Generated, NpzRecordings, NpzTrajectories
from dadiff.denoisers import RecordingMLP
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import ConfigError, DataError, InfeasibleError, ShapeError
from dadiff.launching import register
from dadiff.randomness import torch_generator
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.running.identity import identify
from dadiff.systems import (
    DampedIntegrators,
    GaussianExcitation,
    LaggedIntegrators,
    Linear,
    RotatedIntegrators,
    double_integrator,
)
from dadiff.systems.families import Ranges
from dadiff.tasks import LQR, Fleet
from dadiff.tasks.lqr import ends_layout
from dadiff.tasks.robots import robot_table, transitions
from dadiff.trajectory import Channel, Layout

CONF = Path(__file__).parents[1] / "conf"
FAMILIES = [DampedIntegrators(), RotatedIntegrators(), LaggedIntegrators()]
SMALL = {"robots": 6, "interpolation": 3, "extrapolation": 2}
TINY = ["task=fleet", "task.robots=4", "task.interpolation=2", "task.extrapolation=2", "dataset.train_size=5"]
TINY += ["dataset.test_size=3", "training.steps=3", "denoiser.width=8", "denoiser.blocks=1", "sampler.num_steps=5"]


def fleet_for(family: object, **changes: object) -> Fleet:
    weights = (10, 10, 1, 1, 0, 0) if isinstance(family, LaggedIntegrators) else (10, 10, 1, 1)
    return Fleet(**{"state_cost": weights, "horizon": 8, **SMALL, **changes})


def composed(*overrides: str) -> dict:
    GlobalHydra.instance().clear()
    register()
    with initialize_config_dir(str(CONF.absolute()), version_base="1.3"):
        config = compose("config", [*overrides, "progress=false"], return_hydra_config=True)
    return plain(config, {group: str(config.hydra.runtime.choices[group]) for group in GROUPS})


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: type(f).__name__)
class TestFamilies:
    def test_inside_draws_lie_in_the_ranges_and_outside_draws_do_not(self, family, rng):
        assert (family.ranges.distance(family.inside(50, rng).parameter_table) == 0).all()
        far = family.outside(50, 1.5, rng).parameter_table
        low, high = family.ranges.stretched(1.5)
        assert (family.ranges.distance(far) > 0).all()
        assert ((far >= low) & (far <= high)).all()

    def test_outside_draws_leave_every_range_on_every_open_side(self, family, rng):
        ranges, far = family.ranges, family.outside(500, 1.5, rng).parameter_table
        low, high = ranges.stretched(1.5)
        assert ((far < ranges.low).any(axis=0) == (low < ranges.low)).all()
        assert ((far > ranges.high).any(axis=0) == (high > ranges.high)).all()

    def test_a_robot_alone_is_the_robot_in_the_fleet(self, family, rng):
        robots = family.inside(5, rng)
        alone = family.robots(robots.parameter_table[3:4])
        np.testing.assert_array_equal(alone.A[0], robots.A[3])
        np.testing.assert_array_equal(robots.take([3]).B, alone.B)

    def test_projecting_many_robots_equals_projecting_each(self, family, rng):
        robots = family.inside(4, rng)
        layout = robots.layout(8)
        plans, x_init = rng.standard_normal((4, 7, layout.size)), rng.standard_normal((4, 7, layout.state_dim))
        recording = GaussianExcitation(length=60, process_noise=0.01).record(robots)
        for projector in (Known(), Known("fixed"), HankelLowRank("fixed"), Identified()):
            together = projector.fit(layout, robots, recording).bind(None, pins(projector, layout, x_init))(plans)
            for k in range(4):
                alone = recording.__class__(recording.states[[k]], recording.inputs[[k]])
                one = projector.fit(layout, robots.take([k]), alone).bind(None, pins(projector, layout, x_init[[k]]))
                np.testing.assert_allclose(one(plans[[k]])[0], together[k], atol=1e-9)

    def test_references_are_optimal_and_demonstrations_obey_each_robots_dynamics(self, family, rng):
        quiet = type(family)(process_noise=0.0)
        task = fleet_for(family)
        robots = task.target(quiet)
        cases = task.cases(robots, 4, rng)
        layout = robots.layout(task.horizon)
        known = Known().fit(layout, robots).bind(None, [Pin.initial_state(layout, cases.x_init)])
        np.testing.assert_allclose(known(cases.reference), cases.reference, atol=1e-9)
        nearby = known(cases.reference + 0.01 * rng.standard_normal(cases.reference.shape))
        assert (task.score(robots, cases, nearby[:, :, None], nearby[:, :, None]).per_plan["cost_ratio"] >= 1).all()
        at_optimum = task.score(robots, cases, cases.reference[:, :, None], cases.reference[:, :, None])
        np.testing.assert_allclose(at_optimum.per_plan["cost_ratio"], 1)


def test_the_default_family_is_the_stated_one():
    robots = DampedIntegrators().robots(np.array([[3.0, 2.0]]))
    x, u = np.array([1.0, 2.0, 3.0, 4.0]), np.array([5.0, 6.0])
    expected = [1.3, 2.4, 0.7 * 3 + 0.2 * 5, 0.7 * 4 + 0.2 * 6]
    np.testing.assert_allclose(robots.A[0] @ x + robots.B[0] @ u, expected)


def test_an_undamped_robot_of_unit_gain_is_the_papers_system():
    robots, paper = DampedIntegrators().robots(np.array([[0.0, 1.0]])), double_integrator()
    np.testing.assert_allclose(robots.A[0], paper.A, atol=1e-15)
    np.testing.assert_allclose(robots.B[0], paper.B, atol=1e-15)


def test_the_lag_settles_at_the_gain_times_the_input():
    robots = LaggedIntegrators(process_noise=0.0).robots(np.array([[1.0, 0.7, 0.2]]))
    states = robots.simulate(np.zeros((1, 6)), np.ones((1, 100, 2)))
    np.testing.assert_allclose(states[0, -1, 4:], 0.7)
    np.testing.assert_allclose(states[0, -1, 2:4], 0.7, rtol=1e-3)  # force over damping


def test_stretched_ranges():
    low, high = Ranges({"a": (1, 2), "b": (-1, 2), "c": (0, 3), "d": (-4, -2)}).stretched(2)
    assert low.tolist() == [0.5, -2, 0, -8]
    assert high.tolist() == [4, 4, 6, -1]


class TestTask:
    family = DampedIntegrators()

    def test_the_training_robots_do_not_move_the_test_robots(self):
        few, many = (fleet_for(self.family, robots=k).target(self.family).A for k in (3, 30))
        np.testing.assert_array_equal(few, many)

    def test_every_robot_is_given_the_same_cases(self, rng):
        task = fleet_for(self.family)
        cases = task.cases(task.target(self.family), 5, rng)
        assert cases.environment.shape == (5, 5, 8)
        np.testing.assert_array_equal(cases.x_init[0], cases.x_init[4])
        assert np.abs(cases.reference[0] - cases.reference[4]).max() > 0.1

    @pytest.mark.parametrize("robot", [0, 4])
    def test_the_first_and_the_last_robot_may_be_alone(self, robot):
        everyone, one = (fleet_for(self.family, alone=alone).target(self.family) for alone in (None, robot))
        np.testing.assert_array_equal(one.A, everyone.A[[robot]])

    def test_alone_is_the_same_robot_with_the_same_cases(self):
        everyone, one = fleet_for(self.family), fleet_for(self.family, alone=3)
        cases, only = (Generated(5, 4).test(task, task.target(self.family)) for task in (everyone, one))
        np.testing.assert_array_equal(only.reference[0], cases.reference[3])
        tau = Generated(5, 4).train(one, self.family).trajectories
        assert tau.shape[0] == 5
        assert robot_table(one.target(self.family))["group"].tolist() == ["extrapolation"]

    @pytest.mark.parametrize("told", ["nothing", "robot_parameters", "recording"])
    def test_the_condition_has_the_stated_length(self, told, rng):
        task = fleet_for(self.family, condition_on=told)
        robots = task.target(self.family)
        train, test = task.demonstrations(self.family, 3, rng), task.cases(robots, 2, rng)
        assert train.environment.shape == (18, task.condition(robots).size)
        assert test.environment.shape == (5, 2, task.condition(robots).size)

    def test_the_network_is_told_the_right_robot(self, rng):
        task = fleet_for(self.family, condition_on="robot_parameters")
        robots = task.target(self.family)
        told = task.cases(robots, 2, rng).get("parameters")
        np.testing.assert_array_equal(told[:, 1], robots.parameter_table)

    def test_transitions_determine_the_robot(self):
        robots = DampedIntegrators(process_noise=0.0).robots(np.array([[1.0, 0.7], [2.0, 0.5]]))
        told = transitions(GaussianExcitation(length=6, count=2, process_noise=0.0).record(robots)).reshape(2, 12, 10)
        for k, (c, b) in enumerate(robots.parameter_table):
            np.testing.assert_allclose(told[k, :, 8:], 0.1 * (b * told[k, :, 4:6] - c * told[k, :, 2:4]), atol=1e-12)

    def test_groups_follow_from_the_distance(self):
        table = robot_table(fleet_for(self.family).target(self.family))
        assert table["group"].tolist() == ["interpolation"] * 3 + ["extrapolation"] * 2
        assert ((table["distance"] > 0) == (table["group"] == "extrapolation")).all()


def test_the_recording_denoiser_ignores_the_order_of_transitions():
    layout = DampedIntegrators().inside(1, np.random.default_rng(0)).layout(4)
    condition = Layout((Channel("x_init", 4), Channel("target", 4), Channel("recording", 10, 0, 2)))
    recipe = RecordingMLP(width=8, blocks=1, context=4)
    denoiser = recipe.build(layout, condition, paper_linear(), torch_generator(0, "test"))
    E = torch.randn(5, 38, generator=torch_generator(0, "E"), dtype=torch.float64)
    denoiser.standardise_by(E.numpy())
    swapped = torch.cat([E[:, :8], E[:, 18:28], E[:, 8:18], E[:, 28:]], dim=-1)
    tau = torch.ones(5, layout.size, dtype=torch.float64)
    torch.testing.assert_close(denoiser(tau, 10, E), denoiser(tau, 10, swapped))
    assert not torch.equal(denoiser(tau, 10, E), denoiser(tau, 10, E.flip(0)))


class TestBadInput:
    family = DampedIntegrators()

    @pytest.mark.parametrize(
        ("changes", "text"),
        [
            ({"damping": (3.0, 0.0)}, r"range of damping is \[3.0, 0.0\]"),
            ({"gain": (1.0,)}, "range of gain"),
            ({"time_step": 0.0}, "time_step is 0"),
        ],
    )
    def test_ranges(self, changes, text):
        with pytest.raises(ConfigError, match=text):
            DampedIntegrators(**changes)

    @pytest.mark.parametrize(
        ("changes", "text"),
        [
            ({"robots": 0}, "robots is 0"),
            ({"interpolation": 0, "extrapolation": 0}, "one to test"),
            ({"extrapolation_factor": 1.0}, "extrapolation_factor is 1.0"),
            ({"alone": 40}, "the test robots are 0 to 39"),
            ({"horizon": 0}, "horizon is 0"),
        ],
    )
    def test_task(self, changes, text):
        with pytest.raises(ConfigError, match=text):
            Fleet(**changes)

    def test_one_robot_to_learn_from_and_one_to_test_is_a_fleet(self):
        assert Fleet(robots=1, interpolation=1, extrapolation=0).robots == 1

    def test_no_room_to_extrapolate(self):
        with pytest.raises(ConfigError, match="no room outside"):
            fleet_for(self.family).target(DampedIntegrators(damping=(0, 0), gain=(0, 0)))

    def test_robots_of_different_sizes(self):
        with pytest.raises(ShapeError, match="rows, robots and steps must be alike"):
            Linear([np.eye(2), np.eye(3)], [np.ones((2, 1)), np.ones((3, 1))])

    def test_a_single_system(self):
        with pytest.raises(ConfigError, match="found another system; choose system=damped_integrators"):
            Fleet().target(double_integrator())

    def test_a_task_of_one_system_given_a_family(self, tmp_path):
        experiment = Experiment.of(composed("system=damped_integrators", f"output_dir={tmp_path}"))
        with pytest.raises(ConfigError, match="use task=fleet"):
            _ = experiment.target

    def test_a_projector_of_other_robots(self, rng):
        robots = self.family.inside(3, rng)
        projection = Known().fit(robots.layout(5), robots).bind()
        with pytest.raises(ShapeError, match="made for trajectories of shape"):
            projection(np.zeros((6, 4, robots.layout(5).size)))
        with pytest.raises(ShapeError, match="made for trajectories of shape"):
            projection(np.zeros((3, 4, robots.layout(6).size)))

    def test_state_cost_of_another_length(self):
        lagged = LaggedIntegrators()
        with pytest.raises(ConfigError, match="give one weight for each state"):
            Fleet().demonstrations(lagged, 2, np.random.default_rng(0))

    def test_an_unstable_robot(self):
        A = np.stack([np.eye(2), 1e9 * np.eye(2)])
        system = Linear(A, np.zeros((2, 2, 1)), robots=2)
        with pytest.raises(InfeasibleError, match="robot 1 leaves float range"):
            LQR(state_cost=(1, 1)).feedback(system)

    def test_missing_recordings_are_named(self, tmp_path, rng):
        robots = self.family.inside(3, rng)
        recording = GaussianExcitation(length=7).record(robots)
        for k in (0, 2):
            (tmp_path / f"robot_{k}").mkdir()
            np.savez(tmp_path / f"robot_{k}" / "a.npz", states=recording.states[k, 0], inputs=recording.inputs[k, 0])
        with pytest.raises(DataError, match="no recordings for robot_1;"):
            NpzRecordings(str(tmp_path)).record(robots)
        read = NpzRecordings(str(tmp_path)).record(robots.take([0]))
        np.testing.assert_array_equal(read.states, recording.states[[0]])

    def test_trajectories_from_files(self, tmp_path):
        with pytest.raises(ConfigError, match="belong to one system"):
            NpzTrajectories(str(tmp_path)).train(Fleet(), self.family)

    def test_a_recording_denoiser_without_recordings(self):
        layout = double_integrator().layout(4)
        with pytest.raises(ConfigError, match="condition_on=recording"):
            RecordingMLP().build(layout, ends_layout(double_integrator()), paper_linear(), torch_generator(0, "test"))


def test_one_training_serves_all_projectors_and_recording_lengths():
    base = identify(composed(*TINY))
    others = ["projector=none", "enforcement=post_hoc", "projector.initial_state=fixed"]
    others += ["projector=hankel_lowrank", "sampler=ddpm"]
    cells = [identify(composed(*TINY[:-1], other)) for other in others]
    lengths = [identify(composed(*TINY, "projector=hankel_lowrank", f"recording.length={S}")) for S in (100, 300)]
    assert {cell.denoiser.key for cell in [*cells, *lengths]} == {base.denoiser.key}
    assert len({cell.key for cell in [*cells, *lengths]}) == 7
    assert lengths[0].recording.key != lengths[1].recording.key
    assert identify(composed(*TINY, "task.robots=5")).denoiser.key != base.denoiser.key


@pytest.mark.parametrize("told", ["nothing", "recording"])
def test_a_stored_run(tmp_path, told):
    denoiser = [f"denoiser={'mlp_recording' if told == 'recording' else 'mlp'}", f"task.condition_on={told}"]
    run = execute(Experiment.of(composed(*denoiser, *TINY, f"output_dir={tmp_path}", "projector.initial_state=fixed")))
    assert run.record.counts == {"cases": 3, "samples": 1, "robots": 4}
    assert run.metrics["gap"] < 1e-18
    assert {"median_cost_ratio", "robots_served"} <= set(run.metrics)
    plans, robots, stored = run.table("per_plan"), run.table("robots"), run.arrays()
    assert list(robots.columns) == ["robot", "group", "distance", "damping", "gain"]
    assert set(plans["robot"]) == set(robots["robot"]) == {0, 1, 2, 3}
    assert stored["states"].shape == (3, 3, 1, 31, 4)
    assert stored["reference_states"].shape == (3, 3, 31, 4)
    assert len(set(stored["robots"])) == 3
    np.testing.assert_array_equal(stored["environment_x_init"][0, 0], stored["environment_x_init"][2, 0])
    assert (run.folder / "examples.npz").stat().st_size < 1e6

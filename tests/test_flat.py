"""Flat systems: the unicycle in the coordinates of a double integrator, its replay, and where the map breaks down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from laws import composed

from dadiff.errors import ConfigError
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.systems import Continuous, Simulated, double_integrator
from dadiff.systems.flat import Flat, Unicycle, UnicycleTransformation, unicycles
from dadiff.tasks.obstacles import Obstacles

MAP = UnicycleTransformation()


def robots(rng, count=50):
    """States at speeds that are not singular."""
    x = rng.standard_normal((count, 4))
    x[:, 3] = rng.uniform(0.1, 3, count)
    return x


def test_the_jacobian_agrees_with_differences(rng):
    robot, u = Unicycle(), rng.standard_normal((50, 2))
    x = robots(rng)
    for found, expected in zip(robot.linearise(x, u), Simulated(robot.step, 4, 2).linearise(x, u), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8)


def test_flat_coordinates_move_as_an_integrator(rng):
    """d forward(x) / dt = [p'; w] along the robot's dynamics under inverse(x, w)."""
    x, w, h = robots(rng), rng.standard_normal((50, 2)), 1e-6
    rate = Unicycle().derivative(x, MAP.inverse(x, w))
    found = (MAP.forward(x + h * rate) - MAP.forward(x - h * rate)) / (2 * h)
    np.testing.assert_allclose(found, np.concatenate([MAP.forward(x)[:, 2:], w], axis=-1), atol=1e-7)


def test_the_robot_starts_where_the_plan_does(rng):
    z = rng.standard_normal((50, 4))
    np.testing.assert_allclose(MAP.forward(MAP.start(z)), z, atol=1e-14)


def test_replay_follows_plans_that_keep_moving(rng):
    system = unicycles()
    z, inputs = np.array([0.0, 0.0, 2.0, 0.0]), 2 * rng.standard_normal((20, 30, 2))
    planned, replayed = system.simulate(z, inputs), system.replay(np.broadcast_to(z, (20, 4)), inputs)
    moving = ~(np.hypot(planned[..., 2], planned[..., 3]) < 0.3).any(axis=-1)
    assert moving.sum() > 5
    np.testing.assert_array_equal(system.singular(replayed[moving]), 0)
    apart = np.linalg.norm((planned - replayed)[moving][..., :2], axis=-1).max()
    assert apart < system.time_step**2 * np.linalg.norm(inputs[moving], axis=-1).max()


def test_a_straight_line_is_driven_exactly():
    system = unicycles()
    z, inputs = np.array([[0.0, 0.0, 3.0, 4.0]]), np.zeros((1, 10, 2))
    np.testing.assert_allclose(system.replay(z, inputs), system.simulate(z, inputs), atol=1e-12)


def test_at_rest_the_map_is_singular_and_continued():
    """From rest, looking along x, the robot cannot be pushed along y, whatever is asked of it."""
    system = unicycles()
    inputs = np.tile([0.0, 1.0], (1, 5, 1))
    states = system.replay(np.zeros((1, 4)), inputs)
    np.testing.assert_array_equal(states, 0)
    np.testing.assert_array_equal(system.singular(states), [6])
    x = np.zeros((200, 4))
    x[:, 3] = np.linspace(-0.2, 0.2, 200)
    rate = MAP.inverse(x, np.tile([0.0, 1.0], (200, 1)))[:, 1]
    assert np.abs(rate).max() <= 1 / MAP.least_speed
    assert np.abs(np.diff(rate)).max() < 0.1 / MAP.least_speed


def test_obstacles_are_avoided_after_replay_as_in_flat_coordinates(rng):
    """No more collisions than in flat coordinates plus 1 %."""
    system, task = unicycles(), Obstacles()
    cases = task.cases(system, 200, rng)
    layout, planned = system.layout(task.horizon), cases.reference[:, None]
    inputs = layout.inputs(planned)
    replayed = layout.flatten(system.replay(cases.x_init[:, None], inputs), inputs)
    scores = task.score(system, cases, planned, replayed).per_plan
    assert scores["collision_rollout"].mean() <= scores["collision_planned"].mean() + 0.01


@dataclass(frozen=True, kw_only=True)
class Boat(Continuous):
    """A point in the plane that water holds back: p' = v, v' = u - |v| v."""

    time_step: float | None = 0.1
    state_dim, input_dim = 4, 2

    def derivative(self, x, u):
        v = x[..., 2:]
        return np.concatenate([v, u - np.linalg.norm(v, axis=-1, keepdims=True) * v], axis=-1)

    def derivative_jacobian(self, x, u):
        raise NotImplementedError


@dataclass(frozen=True)
class BoatTransformation:
    """z = x and w = v': thrust makes up for the water. Nowhere singular."""

    def forward(self, x):
        return x

    def start(self, z):
        return z

    def inverse(self, x, w):
        v = x[..., 2:]
        return w + np.linalg.norm(v, axis=-1, keepdims=True) * v

    def singular(self, z):
        return np.zeros(z.shape[:-1], dtype=bool)


def test_another_flat_robot_is_one_class_beside_its_dynamics(rng):
    flat, task = double_integrator(time_step=0.1, process_noise=0.0), Obstacles()
    boat = Flat(flat.A, flat.B, time_step=0.1, robot=Boat(), transformation=BoatTransformation())
    cases = task.cases(boat, 20, rng)
    layout, planned = boat.layout(task.horizon), cases.reference[:, None]
    states, inputs = layout.split(planned)
    replayed = boat.replay(cases.x_init[:, None], inputs)
    apart = np.linalg.norm((states - replayed)[..., :2], axis=-1).max()
    assert apart < 0.1**2 * np.linalg.norm(inputs, axis=-1).max()
    drifting = Boat().simulate(cases.x_init[:, None], inputs)
    assert np.linalg.norm((states - drifting)[..., :2], axis=-1).max() > 10 * apart
    np.testing.assert_array_equal(boat.singular(replayed), 0)
    scores = task.score(boat, cases, planned, layout.flatten(replayed, inputs)).per_plan
    assert scores["collision_rollout"].mean() <= scores["collision_planned"].mean() + 0.01


def test_a_run_reports_where_the_map_broke_down(tmp_path):
    tiny = ["task=obstacles", "system=unicycles", "dataset.train_size=20", "dataset.test_size=3", "training.steps=3"]
    tiny += ["denoiser.width=8", "denoiser.blocks=1", "sampler=ddim", "sampler.num_steps=3", "progress=false"]
    tiny += ["evaluation.samples=2", f"output_dir={tmp_path}"]
    metrics = execute(Experiment.of(composed(*tiny))).record.metrics
    assert metrics["singular_steps"] >= 0
    assert metrics["gap"] > 1e-8  # the robot is none of the planner's


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ConfigError, match="substeps is 3"):
        unicycles(substeps=3)
    with pytest.raises(ConfigError, match="least_speed is 0"):
        unicycles(least_speed=0.0)

"""Animations: robots are drawn where the replay of their plans brings them, one picture for each state."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from dadiff.diffusion.samplers import DDIM
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import DataError
from dadiff.planning import Planner, Plans
from dadiff.planning.animation import Scene, animate, drawn
from dadiff.systems import Linear, PlanarQuadrotors, System, double_integrator
from dadiff.systems.flat import unicycles
from dadiff.tasks import LQR, Manoeuvre, Task
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory.coordinates import physical

ROBOTS = {
    "points": (LQR(horizon=6), double_integrator(), 1),
    "unicycle": (Obstacles(), unicycles(), 5),
    "quadrotors": (Manoeuvre(horizon=6, robots=2, interpolation=3, extrapolation=0), PlanarQuadrotors(), 8),
}


def planned(task: Task, system: System) -> tuple[Planner, Plans, np.ndarray]:
    """The expert's plan for one condition."""
    target = task.target(system)
    cases = task.cases(target, 1, np.random.default_rng(0))
    layout = target.layout(task.horizon)
    planner = Planner(task, target, paper_linear(), DDIM(2), lambda tau, i, E: 0 * tau, physical(layout))
    plans = Plans(layout, cases.reference, 0, time_step=target.time_step)
    return planner, plans, cases.environment.reshape(-1, cases.environment.shape[-1])[0]


@pytest.mark.parametrize(("task", "system", "points"), ROBOTS.values(), ids=ROBOTS)
def test_robots_are_drawn_where_their_replay_brings_them(task, system, points):
    planner, plans, E = planned(task, system)
    scene = Scene.of(planner, plans, E)
    executed = planner.system.replay(planner.condition.get(E, "x_init"), plans.inputs)
    executed = executed.reshape(-1, *executed.shape[-2:])
    assert scene.outlines.shape == (*executed.shape[:2], points, 2)
    np.testing.assert_array_equal(scene.executed, executed[..., :2])
    away = np.linalg.norm(scene.outlines.mean(axis=-2) - executed[..., :2], axis=-1)
    assert away.max() < 0.15  # metres; the middle of a line is not the robot's
    np.testing.assert_array_equal(scene.target, planner.condition.get(E, "target")[:2])
    assert scene.discs.shape[-1] == scene.waypoints.shape[-1] == 3


def test_a_tilted_quadrotor_is_drawn_tilted():
    robot = PlanarQuadrotors().inside(1, np.random.default_rng(0))
    level, tilted = robot.outline(np.array([[[0.0] * 6, [1, 2, np.pi / 2, 0, 0, 0]]]))[0]
    np.testing.assert_allclose(tilted, level @ [[0, 1], [-1, 0]] + np.array([1, 2]), atol=1e-12)


def test_a_unicycle_is_drawn_as_it_looks():
    tip = unicycles().outline(np.array([0.0, 0.0, 0.0, -2.0]))[1]
    np.testing.assert_allclose(tip, [0, -0.2], atol=1e-12)


def test_a_film_has_a_picture_for_each_state_at_the_pace_of_the_plan(tmp_path):
    planner, plans, E = planned(*ROBOTS["quadrotors"][:2])
    with Image.open(animate(planner, plans, E, tmp_path / "plan.gif")) as film:
        assert film.n_frames == 7
        assert film.info["duration"] == 50
    with pytest.raises(DataError, match=r"written as \.gif or \.mp4"):
        animate(planner, plans, E, tmp_path / "plan.avi")
    with pytest.raises(DataError, match="cannot be written"):
        animate(planner, plans, E, tmp_path / "nowhere" / "plan.gif")


def test_the_trail_ends_where_the_robot_is():
    planner, plans, E = planned(*ROBOTS["points"][:2])
    figure, update = drawn(Scene.of(planner, plans, E))
    update(4)
    lines = figure.axes[0].lines
    trail, body = lines[-2:]
    np.testing.assert_allclose(trail.get_xydata()[-1], body.get_xydata()[0])
    assert len(trail.get_xydata()) == 5


def test_without_a_plane_there_is_no_film():
    system = Linear([[0.9]], [[1.0]], time_step=0.1)
    with pytest.raises(DataError, match="a plane needs two"):
        Scene.of(*planned(LQR(horizon=3, state_cost=1.0), system))

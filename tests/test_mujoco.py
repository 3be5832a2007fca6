"""Robots in MuJoCo: the simulator's own steps, what a model may be, and what is refused."""

from __future__ import annotations

import os
import pickle
import sys
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from laws import composed

from dadiff.diffusion.samplers import DDIM
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import ConfigError, DataError, MissingExtraError
from dadiff.evaluation import closed_loop
from dadiff.planning import Planner, Plans
from dadiff.planning.animation import Scene, animate, drawn
from dadiff.planning.codec import Decoder, Encoder
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.systems import (
    FeedbackExcitation,
    GaussianExcitation,
    MujocoFamily,
    MujocoRobot,
    Simulated,
    mujoco_robot,
    rendering,
)
from dadiff.systems.mjcf import Mjcf, located, mujoco
from dadiff.systems.rest import at_rest
from dadiff.tasks import Manoeuvre
from dadiff.trajectory.coordinates import physical

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

ARM = ("joint0", "joint1")
WITHIN_60_PERCENT = dict.fromkeys(("mass", "damping", "gear"), (0.4, 1.6))
MODEL = """
<mujoco><compiler meshdir="shapes"/><option timestep="0.01"/>
  <asset><mesh name="body" file="body.obj"/></asset>
  <worldbody><include file="body.xml"/></worldbody>
  <actuator><motor name="push" joint="swing" ctrlrange="-1 1"/><position joint="slide" kp="3"/></actuator>
</mujoco>"""
BODY = """
<mujocoinclude><body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1"/>
  <body><joint name="swing" axis="0 1 0" range="-30 30"/><geom type="mesh" mesh="body" pos="0 0 -0.2"/></body>
</body></mujocoinclude>"""
SHAPE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def pendulum() -> MujocoRobot:
    return mujoco_robot("inverted_pendulum")


@pytest.fixture(scope="module")
def reacher() -> MujocoRobot:
    return mujoco_robot("reacher", ARM)


@pytest.fixture
def own(tmp_path):
    """A model of one's own, in three files."""
    (tmp_path / "shapes").mkdir()
    (tmp_path / "robot.xml").write_text(MODEL)
    (tmp_path / "body.xml").write_text(BODY)
    (tmp_path / "shapes" / "body.obj").write_text(SHAPE)
    return tmp_path / "robot.xml"


def points(robot: MujocoRobot, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    lead = (*robot.robots, count)
    return 0.3 * rng.standard_normal((*lead, robot.state_dim)), 0.3 * rng.standard_normal((*lead, robot.input_dim))


@pytest.mark.parametrize(("name", "path"), [("pendulum", "inverted_pendulum"), ("reacher", "reacher")])
def test_it_steps_as_the_simulator_does(name, path, request):
    """One point at a time; the reacher of the wheel carries its target along, which does not move."""
    import mujoco as package

    robot, model = request.getfixturevalue(name), package.MjModel.from_xml_path(str(located(path)))
    k, data = robot.state_dim // 2, package.MjData(model)
    for x, u in zip(*points(robot, 5), strict=True):
        package.mj_resetData(model, data)
        data.qpos[:k], data.qvel[:k], data.ctrl[:] = x[:k], x[k:], u
        package.mj_step(model, data, nstep=2)
        reached = np.concatenate([data.qpos[:k], data.qvel[:k]])
        np.testing.assert_allclose(robot.step(x, u), reached, atol=1e-12)


def test_names_units_and_ranges_are_the_models(pendulum, reacher):
    assert pendulum.state_names == ("slider", "hinge", "slider velocity", "hinge velocity")
    assert pendulum.state_units == ("m", "rad", "m/s", "rad/s")
    assert pendulum.input_names == ("slide",)
    assert pendulum.bounds.of_inputs(1)[1] == [3]
    np.testing.assert_allclose(pendulum.bounds.of_states(4)[1], [1, np.pi / 2, np.inf, np.inf])
    assert reacher.input_names == ("motor of joint0", "motor of joint1")
    np.testing.assert_array_equal(reacher.bounds.of_states(4)[0], [-np.inf, -3, -np.inf, -np.inf])
    assert (reacher.time_step, pendulum.time_step) == (0.02, 0.04)
    narrow = mujoco_robot("inverted_pendulum", bounds={"input_high": 1.0})
    assert narrow.bounds.of_inputs(1) == ([-3], [1])


def test_threads_and_batches_change_nothing(monkeypatch):
    robots = MujocoFamily("inverted_pendulum", **WITHIN_60_PERCENT).inside(3, np.random.default_rng(0))
    x, u = points(robots, 200)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    alone = robots.step(x, u)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    np.testing.assert_array_equal(robots.step(x, u), alone)
    for k in (0, 2):
        np.testing.assert_array_equal(robots.take([k]).step(x[[k], :2], u[[k], :2]), alone[[k], :2])


def test_derivatives_are_those_of_central_differences(reacher):
    x, u = points(reacher, 20)
    central = Simulated(reacher.step, 4, 2, difference=1e-5).linearise(x, u)
    for found, expected in zip(reacher.linearise(x, u), central, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_factors_act_on_mass_damping_and_gear(pendulum):
    """All forces and all masses times k leave a motion as it is; the gear alone scales what an input does."""
    x, u = points(pendulum, 20)
    twice = replace(pendulum, mass=2.0, damping=2.0)  # of gravity the masses take care
    np.testing.assert_allclose(twice.step(x, 2 * u), pendulum.step(x, u), atol=1e-9)
    np.testing.assert_allclose(replace(twice, gear=2.0).step(x, u), pendulum.step(x, u), atol=1e-9)
    assert np.abs(replace(pendulum, damping=2.0).step(x, u) - pendulum.step(x, u)).max() > 1e-3


def test_what_diverges_is_nan_and_nothing_is_written(pendulum, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.array([[0.0, 0.1, 0.0, 1e7], [np.nan, 0, 0, 0], [0.0, 0.1, 0.0, 0.0]])
    states = pendulum.simulate(x, np.full((3, 9, 1), 0.1))
    assert not np.isfinite(states[0, -1]).all()
    assert np.isnan(states[1, 1:]).all()
    assert np.isfinite(states[2]).all()
    assert not list(tmp_path.iterdir())


def test_a_robot_can_be_sent_and_stored(reacher):
    x, u = points(reacher, 3)
    expected = reacher.step(x, u)
    encode = Encoder()
    plain = encode(reacher, "system")
    for copy in (pickle.loads(pickle.dumps(reacher)), Decoder(encode.arrays, "file")(plain)):
        np.testing.assert_array_equal(copy.step(x, u), expected)


def test_a_model_of_ones_own_in_several_files(own):
    robot = mujoco_robot(str(own))
    assert robot.state_names[:2] == ("slide", "swing")
    assert robot.input_names == ("push", "motor of slide")
    np.testing.assert_allclose(robot.bounds.of_states(4)[1][1], np.pi / 6)
    before = MujocoFamily(str(own)).fingerprint()
    step = robot.step(*points(robot, 3))
    encode = Encoder()
    plain = encode(robot, "system")
    for file in (own, own.parent / "body.xml"):
        file.write_text(file.read_text() + " ")
    assert MujocoFamily(str(own)).fingerprint() != before
    for file in own.parent.rglob("*.*"):
        file.unlink()
    again = Decoder(encode.arrays, "file")(plain)  # needs none of the files
    np.testing.assert_array_equal(again.step(*points(robot, 3)), step)
    with pytest.raises(DataError, match=r"MuJoCo cannot read the model .*swing"):  # which a motor moves
        replace(robot, mjcf=replace(robot.mjcf, joints=("slide",)))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: mujoco_robot("reachr"), ConfigError, "no model 'reachr'; expected a path ending in .xml, or one of"),
        (
            lambda: mujoco_robot("reacher", ["elbow"]),
            ConfigError,
            "no joint elbow; the model has joint0, joint1, target_x",
        ),
        (lambda: mujoco_robot("ant"), ConfigError, "joint root of the model is free or a ball"),
        (lambda: mujoco_robot("nowhere/robot.xml"), DataError, "nowhere/robot.xml: cannot be read"),
        (lambda: mujoco_robot("reacher", frame_skip=0), ConfigError, "frame_skip is 0"),
        (lambda: MujocoFamily("reacher", mass=(0.0, 1.0)), ConfigError, "factors are positive"),
    ],
)
def test_what_is_no_robot_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("<mujoco", "is no MJCF"),
        ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco/>', "declares entities"),
        ('<mujoco><include file="/etc/passwd"/></mujoco>', "lies outside of the model's folder"),
        ('<mujoco><include file="../robot.xml"/></mujoco>', "lies outside of the model's folder"),
        ('<mujoco><include file="pipe"/></mujoco>', "is no plain file"),
        ('<mujoco><asset><mesh name="m" file="no.stl"/></asset></mujoco>', "no.stl: cannot be read"),
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "MuJoCo cannot read the model"),
        ("<mujoco><worldbody/></mujoco>", "a model needs joints and actuators"),
    ],
)
def test_files_are_judged_before_they_are_read(model, message, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "robot.xml").write_text(model)
    with pytest.raises((DataError, ConfigError), match=message):
        mujoco_robot(str(tmp_path / "robot.xml"))


def test_a_stored_text_looks_for_nothing_on_the_disk(own):
    for text in (MODEL, f'<mujoco><include file="{own}"/></mujoco>'):
        with pytest.raises(DataError, match="which is not stored with it"):
            Mjcf(text).compiled()


def test_without_the_extra_the_message_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"mujoco is not installed; .*pip install 'dadiff\[mujoco\]'"):
        mujoco()
    with pytest.raises(MissingExtraError, match=r"dadiff\[mujoco\]"):
        MujocoFamily("reacher").inside(1, np.random.default_rng(0))


def test_where_it_rests():
    robots = MujocoFamily("inverted_pendulum", **WITHIN_60_PERCENT).inside(3, np.random.default_rng(0))
    held = np.linspace(-0.5, 0.5, 6).reshape(3, 2, 1)
    x, u = at_rest(robots, held)
    np.testing.assert_array_equal(x[..., :1], held)
    np.testing.assert_allclose(robots.step(x, u), x, atol=1e-8)
    np.testing.assert_allclose(x[..., 1], -0.001 / 0.6, rtol=1e-4)  # its pole is drawn askew
    with pytest.raises(ConfigError, match=r"with its 2 leading states held it rests nowhere near \[0.0, 0.5\]"):
        at_rest(robots, np.tile([0.0, 0.5], (3, 1, 1)))


def test_a_recording_about_a_feedback_stays_where_the_robot_rests_and_obeys_it():
    weak = {"input_low": -1.0, "input_high": 1.0}
    robots = MujocoFamily("inverted_pendulum", bounds=weak, **WITHIN_60_PERCENT).inside(5, np.random.default_rng(0))
    recorder = FeedbackExcitation(length=200, input_std=0.5, state_cost=(1.0, 1.0, 0.1, 0.1), input_cost=0.05, count=2)
    recording = recorder.record(robots)
    assert recording.states.shape == (5, 2, 201, 4)
    np.testing.assert_array_equal(
        robots.step(recording.states[:, :, :-1], recording.inputs), recording.states[:, :, 1:]
    )
    assert np.abs(recording.states[..., 1]).max() < 1.0
    assert np.abs(recording.inputs).max() == 1.0  # no more than the motor gives
    held = replace(recorder, hold=20, input_std=0.1).record(robots)
    assert held.states.std() != recording.states.std()
    fallen = GaussianExcitation(length=200, input_std=0.1).record(robots)
    assert np.abs(fallen.states[..., 1]).max(axis=(1, 2)).min() > 1.0
    with pytest.raises(ConfigError, match="hold is 0"):
        FeedbackExcitation(hold=0)


TINY = ["task.robots=3", "task.interpolation=2", "task.horizon=8", "dataset.train_size=4", "dataset.test_size=2"]
TINY += ["training.steps=5", "denoiser.width=8", "denoiser.blocks=1", "sampler.num_steps=2", "progress=false"]
TERMS = ["projector.initial_state=fixed", "projector.features=[constant,identity,trigonometric,control_affine]"]
EPISODES = ["evaluation.replan_every=[4]", "evaluation.steps=8", "evaluation.disturbance=0.001"]
LEARNED = {
    "known_fixed": ["projector.bounds=enforced", "evaluation=closed_loop", *EPISODES],
    "identified": [*TERMS, "projector.angles=[1]", "projector.ridge=1e-8"],
    "koopman": [],
    "hankel_lowrank": ["projector.initial_state=fixed", "projector.offset=estimated"],
}


@pytest.mark.parametrize(("task", "projector"), zip(2 * ["pendulums", "reachers"], LEARNED, strict=True))
def test_a_run_plans_and_replays_in_the_simulator(task, projector, tmp_path, monkeypatch):
    monkeypatch.setattr(closed_loop, "TIMED_SECONDS", 0.0)
    words = [f"task=manoeuvre_{task}", f"projector={projector}", *LEARNED[projector], "recording.length=100"]
    run = execute(Experiment.of(composed(*TINY, *words, f"output_dir={tmp_path}")))
    metrics = run.record.metrics
    assert metrics["cost_ratio"] > 0.99
    assert metrics["initial_state_error"] < 1e-12
    if projector == "known_fixed":
        assert metrics["gap_nrmse"] < 1e-6
        assert metrics["violation"] == 0
        assert 0.5 < metrics["closed_loop_receding_4"] < 2
    else:
        assert metrics["prediction_error"] < 0.1
    assert Planner.load(run.folder).system.robots == (2,)


def reaching(time_step: float = 0.02) -> tuple[Planner, Plans, np.ndarray]:
    """A reacher that moves from rest, its planner and its E."""
    family, task = (
        MujocoFamily("reacher", ARM),
        Manoeuvre(
            horizon=6, robots=1, interpolation=1, extrapolation=0, state_cost=(1, 1, 0.1, 0.1), init_range=(1, 1, 0, 0)
        ),
    )
    robots = task.target(family)
    cases = task.cases(robots, 1, np.random.default_rng(0))
    layout = robots.layout(task.horizon)
    planner = Planner(task, robots, paper_linear(), DDIM(2), lambda tau, i, E: 0 * tau, physical(layout))
    return planner, Plans(layout, cases.reference, 0, time_step=time_step), cases.environment[0, 0]


def test_a_robot_is_drawn_as_its_links_lie(pendulum, reacher):
    x = np.array([0.3, 0.2, 0.0, 0.0])
    cart, tip = np.array([0.3, 0.0]), 0.6 * np.array([np.sin(0.2), np.cos(0.2)])
    np.testing.assert_allclose(pendulum.outline(x)[-2:], [cart, cart + tip], atol=2e-3)
    np.testing.assert_allclose(pendulum.position(x), cart + tip, atol=2e-3)
    assert (pendulum.plane, reacher.plane) == (("x [m]", "z [m]"), ("x [m]", "y [m]"))
    elbow = 0.1 * np.array([np.cos(0.3), np.sin(0.3)])
    hand = elbow + 0.11 * np.array([np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(reacher.outline(x)[[0, 1, -1]], [[0, 0], elbow, hand], atol=1e-9)


def test_it_is_filmed_rendered_where_that_is_possible(tmp_path, monkeypatch):
    planner, plans, E = reaching()
    scene = Scene.of(planner, plans, E)
    assert scene.executed.shape == (1, 7, 2)
    goal = planner.task.goal(planner.system, E)
    np.testing.assert_allclose(scene.target, planner.system.position(goal).reshape(2))
    monkeypatch.setattr(rendering, "_context", contextmanager(lambda: iter([None])))
    bare = Scene.of(planner, plans, E)
    assert bare.frames is None
    if scene.frames is not None:  # there is EGL or OSMesa
        assert scene.frames.shape == (7, 320, 320, 3)
        assert (scene.frames[0] != scene.frames[-1]).any()
    for k, one in enumerate([scene, bare]):
        figure, update = drawn(one)
        update(6)
        figure.savefig(tmp_path / f"{k}.png")
    assert animate(planner, plans, E, tmp_path / "reacher.gif").stat().st_size > 1000

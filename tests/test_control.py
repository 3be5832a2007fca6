"""Controllers and episodes: open loop is replay, feedback is optimal, receding horizons plan where the robot is."""

from __future__ import annotations

import numpy as np
import pytest

from dadiff.control import Feedback, OpenLoop, RecedingHorizon, Tracking, run
from dadiff.control.controllers import shifted, tracking_gains
from dadiff.errors import ConfigError, ShapeError
from dadiff.randomness import numpy_generator
from dadiff.systems import double_integrator
from dadiff.tasks import LQR

SYSTEM, TASK = double_integrator(), LQR()
LAYOUT = SYSTEM.layout(TASK.horizon)
CASES = TASK.cases(SYSTEM, 6, numpy_generator(0, "cases"))
STATES, INPUTS = LAYOUT.split(CASES.reference)
Q, R = TASK.weights(SYSTEM)


def disturbance(steps: int, size: float = 0.05) -> np.ndarray:
    return size * numpy_generator(1, "disturbance").standard_normal((6, steps, SYSTEM.state_dim))


def cost(states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    return TASK.cost(SYSTEM)(states, inputs, CASES.get("target"))


def test_open_loop_is_replay_with_and_without_disturbance():
    for w in (None, disturbance(30)):
        episode = run(SYSTEM, OpenLoop(INPUTS), CASES.x_init, 30, w)
        np.testing.assert_allclose(episode.states, SYSTEM.simulate(CASES.x_init, INPUTS, w), atol=1e-12)
        np.testing.assert_array_equal(episode.inputs, INPUTS)


def test_an_open_loop_ends_with_its_plan():
    with pytest.raises(ShapeError, match="the plan has 30 inputs, and input 30 is asked for"):
        run(SYSTEM, OpenLoop(INPUTS), CASES.x_init, 31)


def test_tracking_keeps_to_the_plan_where_open_loop_leaves_it():
    gains = tracking_gains(SYSTEM, STATES, INPUTS, TASK.cost(SYSTEM).Q, np.eye(2))
    assert gains.shape == (6, 30, 2, 4)
    tracked = run(SYSTEM, Tracking(STATES, INPUTS, gains), CASES.x_init, 30, disturbance(30))
    blind = run(SYSTEM, OpenLoop(INPUTS), CASES.x_init, 30, disturbance(30))
    away = [np.abs(episode.states - STATES).max() for episode in (tracked, blind)]
    assert away[0] < away[1] / 2
    undisturbed = run(SYSTEM, Tracking(STATES, INPUTS, gains), CASES.x_init, 30)
    np.testing.assert_allclose(undisturbed.states, STATES, atol=1e-10)


def test_tracking_gains_solve_the_riccati_equation():
    """The first gains of a long horizon are those of the stationary problem, by python-control."""
    import control

    x, u = np.zeros((1, 401, 4)), np.zeros((1, 400, 2))
    gains = tracking_gains(SYSTEM, x, u, TASK.cost(SYSTEM).Q, np.eye(2))
    A, B, _ = SYSTEM.linearise(x[:, 0], u[:, 0])
    expected = control.dlqr(A[0], B[0], TASK.cost(SYSTEM).Q, np.eye(2))[0]
    np.testing.assert_allclose(-gains[0, 0], expected, atol=1e-8)


def test_replanning_from_where_the_robot_is_is_the_affine_feedback():
    """Optimal plans replanned at each step follow the optimal feedback of a moving horizon."""
    law = TASK.law(SYSTEM)
    feedback = TASK.feedback(SYSTEM)

    def plan(x, start):
        E = CASES.condition.pack(x_init=x, target=CASES.get("target"))
        return LAYOUT.split(E @ law.mean_map.T)

    receding = run(SYSTEM, RecedingHorizon(plan, 1), CASES.x_init, 30, disturbance(30))
    offset = CASES.get("target") @ feedback.L[0].T
    moving = run(SYSTEM, Feedback(feedback.K[0], offset), CASES.x_init, 30, disturbance(30))
    np.testing.assert_allclose(receding.states, moving.states, atol=1e-9)


def test_replanning_costs_less_than_replay_under_disturbances():
    law = TASK.law(SYSTEM)

    def plan(x, start):
        return LAYOUT.split(CASES.condition.pack(x_init=x, target=CASES.get("target")) @ law.mean_map.T)

    costs = {}
    for every in (1, 10, 30):
        episode = run(SYSTEM, RecedingHorizon(plan, every), CASES.x_init, 30, disturbance(30, 0.2))
        costs[every] = cost(episode.states, episode.inputs).mean()
    assert costs[1] < costs[10] < costs[30]


def test_plans_are_asked_for_every_k_steps_from_the_plan_moved_on():
    asked = []

    def plan(x, start):
        asked.append((x.copy(), start))
        return STATES, INPUTS

    controller = RecedingHorizon(plan, 7)
    episode = run(SYSTEM, controller, CASES.x_init, 30)
    assert len(asked) == len(controller.seconds) == 5  # at t = 0, 7, 14, 21, 28
    assert asked[0][1] is None
    for k, (x, start) in enumerate(asked[1:], 1):
        np.testing.assert_array_equal(x, episode.states[:, 7 * k])
        np.testing.assert_array_equal(start[0], shifted(STATES, INPUTS, 7)[0])


def test_a_shifted_plan_begins_later_and_holds_its_end():
    states, inputs = shifted(STATES, INPUTS, 4)
    np.testing.assert_array_equal(states[:, :-4], STATES[:, 4:])
    np.testing.assert_array_equal(inputs[:, :-4], INPUTS[:, 4:])
    np.testing.assert_array_equal(states[:, -4:], np.repeat(STATES[:, -1:], 4, 1))
    assert states.shape == STATES.shape
    assert inputs.shape == INPUTS.shape


def test_a_delay_moves_the_inputs():
    episode = run(SYSTEM, OpenLoop(INPUTS), CASES.x_init, 30, delay=2)
    np.testing.assert_array_equal(episode.inputs[:, 2:], INPUTS[:, :-2])
    np.testing.assert_array_equal(episode.inputs[:, :2], 0)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ConfigError, match="every is 0"):
        RecedingHorizon(lambda x, start: (STATES, INPUTS), 0)
    with pytest.raises(ShapeError, match="the disturbance has 29 steps; expected 30"):
        run(SYSTEM, OpenLoop(INPUTS), CASES.x_init, 30, disturbance(29))

"""Laws of systems and recordings: the paper's A and B, the noise they are given, and what is refused."""

from __future__ import annotations

import control
import numpy as np
import pytest
from laws import (
    AFFINE,
    OWN,
    component,
    composed,
    fleet,
    members,
    presets,
    shipped_system,
    tolerance,
    varying_system,
)
from scipy.linalg import expm

from dadiff.behaviours import Transitions, least_squares
from dadiff.config import build
from dadiff.errors import ConfigError, ExcitationError, NotApplicableError, ShapeError
from dadiff.systems import (
    Bounds,
    GaussianExcitation,
    Linear,
    Recording,
    Robots,
    System,
    TimeVarying,
    double_integrator,
    from_control,
)
from dadiff.systems.nonlinear import Simulated


def test_A_and_B_are_the_papers():
    system = double_integrator()
    I, O = np.eye(2), np.zeros((2, 2))  # noqa: E741
    assert np.array_equal(system.A, np.block([[I, 0.1 * I], [O, I]]))
    assert np.array_equal(system.B, np.vstack([O, 0.1 * I]))
    assert system.process_noise == 0.01


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_zero_order_hold_is_the_matrix_exponential(axes):
    system = double_integrator(axes, time_step=0.3, discretisation="zoh")
    I, O = np.eye(axes), np.zeros((axes, axes))  # noqa: E741
    exact = expm(0.3 * np.block([[O, I, O], [O, O, I], [O, O, O]]))
    np.testing.assert_allclose(system.A, exact[: 2 * axes, : 2 * axes], atol=1e-14)
    np.testing.assert_allclose(system.B, exact[: 2 * axes, 2 * axes :], atol=1e-14)


@pytest.mark.parametrize(
    ("A", "B", "message"),
    [
        (np.ones((2, 3)), np.ones((2, 1)), r"A has shape \(2, 3\)"),
        (np.eye(3), np.ones((2, 1)), r"B \(2, 1\)"),
        (np.eye(2), np.ones(2), r"B \(2,\)"),
        ([[1, 0], [1]], np.ones((2, 1)), r"parts of A have shapes \[\(1,\), \(2,\)\]"),
        (1.0, 1.0, r"A has shape \(\); a Linear system has \(n, n\)"),
    ],
)
def test_matrices_that_do_not_fit_are_refused(A, B, message):
    with pytest.raises(ShapeError, match=message):
        Linear(A, B)


def test_sizes_of_a_fleet_must_agree():
    with pytest.raises(ShapeError, match=r"expected \(5, n, n\), \(5, n, m\) and \(5, n\)"):
        Linear(np.ones((5, 2, 2)), np.ones((4, 2, 1)), robots=5)
    with pytest.raises(ShapeError, match=r"c \(3,\); expected \(n, n\), \(n, m\) and \(n\)"):
        Linear(np.eye(2), np.ones((2, 1)), np.ones(3))


def test_a_fleet_and_a_system_that_varies_are_told_apart_by_type():
    A, B = np.ones((30, 4, 4)), np.ones((30, 4, 2))
    with pytest.raises(ShapeError, match=r"for 30 robots give robots=30, .* T = 30 steps use TimeVarying"):
        Linear(A, B)
    with pytest.raises(ShapeError, match=r"robots=R \(R, T, n, n\), here robots is 30; .* use Linear with robots=R"):
        TimeVarying(A, B, robots=30)
    with pytest.raises(ShapeError, match=r"robots is None; .* use Linear"):
        TimeVarying(A[None], B[None])
    with pytest.raises(ShapeError, match="use TimeVarying"):
        Linear(A[None], B[None], robots=1)
    assert (Linear(A, B, robots=30).robots, TimeVarying(A, B).robots) == ((30,), ())
    assert TimeVarying(A[None], B[None], robots=1).robots == (1,)


def test_a_system_that_varies_ends_where_its_matrices_end(rng):
    system = varying_system(3, 2, 5, seed=0)
    x_init, inputs = rng.standard_normal(3), rng.standard_normal((6, 2))
    system.simulate(x_init, inputs[:5])
    for ask in (lambda: system.simulate(x_init, inputs), lambda: system.matrices(6)):
        with pytest.raises(ShapeError, match=r"given for steps 0\.\.4, asked for step 5"):
            ask()


def test_robots_of_a_linear_fleet_are_taken_by_their_numbers(rng):
    robots, x, u = fleet(), rng.standard_normal((3, 2, 3)), rng.standard_normal((3, 2, 2))
    np.testing.assert_array_equal(robots.take([2, 0]).step(x[[2, 0]], u[[2, 0]]), robots.step(x, u)[[2, 0]])
    with pytest.raises(NotApplicableError, match="Linear does not give some of its robots"):
        double_integrator().take([0])


def test_of_a_system_that_varies_nothing_is_recorded():
    with pytest.raises(NotApplicableError, match=r"varies in time, .* use projector=known"):
        GaussianExcitation(length=4).record(varying_system(3, 2, 5, seed=0))


ALL = {**AFFINE, "fleet": fleet(), "time-varying fleet": varying_system(3, 2, 12, 3, 4)}


@pytest.mark.parametrize("system", ALL.values(), ids=ALL.keys())
def test_steps_linearisations_and_simulations_agree(system, rng):
    """For a batch of points at one time, and for trajectories at times 0..T-1."""
    n, m, T = system.state_dim, system.input_dim, 6
    x_init, inputs = rng.standard_normal((*system.robots, 5, n)), rng.standard_normal((*system.robots, 5, T, m))
    x = system.simulate(x_init, inputs)
    assert x.shape == (*system.robots, 5, T + 1, n)
    np.testing.assert_allclose(System.simulate(system, x_init, inputs), x, atol=1e-12)
    np.testing.assert_allclose(system.step(x[..., :-1, :], inputs, np.arange(T)), x[..., 1:, :], atol=1e-12)
    A, B, c = system.linearise(x[..., :-1, :], inputs, np.arange(T))
    assert (A.shape, B.shape, c.shape) == ((*x[..., 1:, :].shape, n), (*inputs.shape[:-1], n, m), x[..., 1:, :].shape)
    following = (A @ x[..., :-1, :, None] + B @ inputs[..., None])[..., 0] + c
    np.testing.assert_allclose(following, x[..., 1:, :], atol=1e-12)
    for t in (0, T - 1):
        A, B, c = system.linearise(x[..., t, :], inputs[..., t, :], t)
        one = (A @ x[..., t, :, None] + B @ inputs[..., t, :, None])[..., 0] + c
        np.testing.assert_allclose(one, x[..., t + 1, :], atol=1e-12)


@pytest.mark.parametrize("preset", [preset for preset in presets("system") if preset != "unknown"])
class TestShippedSystems:
    """Whatever lies in conf/system/: linearised as it steps, simulated as it steps, robots in one go as alone."""

    def points(self, system: System, rng) -> tuple[np.ndarray, np.ndarray]:
        """Within the system's bounds."""
        n, m, lead = system.state_dim, system.input_dim, (*system.robots, 4)
        x, u = rng.standard_normal((*lead, n)), rng.standard_normal((*lead, 5, m))
        within = zip((x, u), (system.bounds.of_states(n), system.bounds.of_inputs(m)), strict=True)
        x, u = (np.clip(part, 0.9 * low, 0.9 * high) for part, (low, high) in within)
        return x, u

    def test_the_linearisation_is_the_derivative_of_the_step(self, preset, rng):
        system = shipped_system(preset)
        x, u = self.points(system, rng)
        u, robots = u[..., 0, :], system.robots[0] if system.robots else None
        difference = Simulated(system.step, system.state_dim, system.input_dim, robots=robots)
        for found, expected in zip(system.linearise(x, u), difference.linearise(x, u), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-7)

    def test_simulating_is_stepping(self, preset, rng):
        system = shipped_system(preset)
        x, u = self.points(system, rng)
        noise = rng.standard_normal((*u.shape[:-1], system.state_dim))
        states = system.simulate(x, u, noise)
        for t in range(u.shape[-2]):
            np.testing.assert_allclose(states[..., t, :], x, rtol=1e-9, atol=1e-9)
            x = system.step(x, u[..., t, :], t) + noise[..., t, :]

    def test_the_layout_has_the_systems_sizes_and_names(self, preset, rng):
        system = shipped_system(preset)
        layout = system.layout(7)
        assert (layout.state_dim, layout.input_dim, layout.horizon) == (system.state_dim, system.input_dim, 7)
        assert layout.channel("x").labels == system.state_names
        x, u = self.points(system, rng)
        assert layout.size == 8 * x.shape[-1] + 7 * u.shape[-1]
        assert system.time_step is None or system.time_step > 0

    def test_a_fleet_is_its_robots(self, preset, rng):
        system = shipped_system(preset)
        x, u = self.points(system, rng)
        if not isinstance(system, Robots):
            pytest.skip("a single system")
        for k in range(system.robots[0]):
            one = system.take([k])
            np.testing.assert_allclose(one.simulate(x[[k]], u[[k]]), system.simulate(x, u)[[k]], atol=1e-12)
            assert one.bounds == system.bounds


def test_a_system_of_ones_own_from_yaml():
    words = [
        "system.c=[0.5,0]",
        "system.process_noise=[0.0,0.1]",
        "system.bounds={input_high: 2}",
        "system.time_step=0.1",
    ]
    config = composed("system=inline", "system.A=[[1,0.1],[0,1]]", "system.B=[[0],[0.1]]", *words)
    system = build(config["system"], "system")
    assert isinstance(system, Linear)
    assert (system.A.tolist(), system.c.tolist(), system.time_step) == ([[1, 0.1], [0, 1]], [0.5, 0], 0.1)
    assert system.bounds.of_inputs(1)[1].tolist() == [2]
    assert config["recording"]["process_noise"] == [0.0, 0.1]
    assert build(config["recording"], "recording").record(system).states.shape == (1, 101, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"B": [[1.0]]}, r"system: A has shape \(2, 2\), B \(1, 1\) and c \(2,\)"),
        ({"A": [[1.0, 0.0], [1.0]]}, "parts of A have shapes"),
        ({"A": [[1.0, "a"], [1.0, 1.0]]}, "A is 'a'"),
        ({"bounds": {"input_max": 1.0}}, "bounds.input_max is not known; expected input_low, input_high"),
        ({"bounds": {"input_high": [1.0, 2.0]}}, r"input_high has shape \(2,\)"),
        ({"state_names": ["p"]}, "1 labels for 2 entries"),
    ],
)
def test_a_system_of_ones_own_that_does_not_fit_is_refused(changes, message):
    with pytest.raises((ConfigError, ShapeError), match=message):
        component("system", "inline", **{**OWN, **changes})


def test_a_state_space_system_is_discretised():
    A, B = [[0.0, 1.0], [-2.0, -0.3]], [[0.0], [1.0]]
    ss = control.ss(A, B, np.eye(2), 0, states=["angle", "rate"], inputs=["torque"])
    system = from_control(ss, 0.1, process_noise=0.01)
    exact = expm(0.1 * np.block([[np.array(A), np.array(B)], [np.zeros((1, 3))]]))
    np.testing.assert_allclose(np.hstack([system.A, system.B]), exact[:2], atol=1e-14)
    assert (system.state_names, system.input_names) == (("angle", "rate"), ("torque",))
    assert system.time_step == 0.1
    again = from_control(control.c2d(ss, 0.1))
    np.testing.assert_allclose(again.A, system.A, atol=1e-14)
    assert again.time_step == 0.1
    assert from_control(control.ss(A, B, np.eye(2), 0, True), 0.2).time_step == 0.2
    assert from_control(control.ss(A, B, np.eye(2), 0), 0.2).state_names == ()


@pytest.mark.parametrize(
    ("dt", "time_step", "message"),
    [
        (0, None, "continuous and time_step is missing"),
        (True, None, "discrete without a stated step and time_step is missing"),
        (0.1, 0.2, r"dt = 0.1 s, time_step is 0.2; leave time_step out"),
        (None, 0.2, "set its dt"),
    ],
)
def test_a_state_space_system_of_another_step_is_refused(dt, time_step, message):
    with pytest.raises(ConfigError, match=message):
        from_control(control.ss(np.eye(2), np.ones((2, 1)), np.eye(2), 0, dt), time_step)
    with pytest.raises(ConfigError, match=r"takes a StateSpace, found a TransferFunction; convert it by control\.ss"):
        from_control(control.tf([1], [1, 1]), 0.1)


@pytest.mark.parametrize(
    ("description", "error", "message"),
    [
        (
            {"process_noise": [0.1, 0.2, 0.3]},
            ShapeError,
            r"process_noise has shape \(3,\); expected",
        ),
        ({"process_noise": [0.1, -0.2]}, ConfigError, "process_noise"),
        ({"time_step": 0.0}, ConfigError, "time_step is 0"),
        ({"state_names": ("a",)}, ShapeError, "1 labels for 2 entries"),
        ({"input_units": ("N", "N")}, ShapeError, "2 units for 1 entries"),
        (
            {"bounds": Bounds(input_low=[0.0, 0.0])},
            ShapeError,
            r"input_low has shape \(2,\); expected",
        ),
    ],
)
def test_what_does_not_describe_a_system_is_refused(description, error, message):
    with pytest.raises(error, match=message):
        Linear(np.eye(2), np.ones((2, 1)), **description)


def test_bounds():
    bounds = Bounds(input_high=3.0, state_low=[-1.0, -np.inf])
    low, high = bounds.of_states(2)
    assert low.tolist() == [-1, -np.inf]
    assert high.tolist() == [np.inf, np.inf]
    assert bounds.of_inputs(2)[1].tolist() == [3, 3]
    assert bounds.any
    assert not Bounds().any
    with pytest.raises(ConfigError, match=r"input_low is 1.0, input_high -1.0; need low <= high"):
        Bounds(input_low=1.0, input_high=-1.0)


def test_names_and_units_reach_the_layout():
    system = Linear(np.eye(2), np.ones((2, 1)), state_names=("p", "v"), state_units=("m", "m/s"), input_names=("f",))
    layout = system.layout(3)
    assert layout.channel("x").labels == ("p", "v")
    assert layout.channel("x").units == ("m", "m/s")
    assert layout.channel("u").labels == ("f",)
    assert layout == Linear(np.eye(2), np.ones((2, 1))).layout(3)


def test_noise_of_each_state():
    system = Linear(np.eye(2), np.ones((2, 1)), process_noise=[0.0, 2.0])
    drawn = system.noise((4000,), np.random.default_rng(0))
    assert (drawn[:, 0] == 0).all()
    np.testing.assert_allclose(drawn[:, 1].std(), 2, rtol=0.05)
    recording = GaussianExcitation(length=50, input_std=0.0).record(system)
    assert (recording.states[..., 0] == 0).all()
    assert recording.states[..., 1].std() > 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: double_integrator(axes=0),
        lambda: double_integrator(time_step=0.0),
        lambda: double_integrator(time_step=float("nan")),
        lambda: double_integrator(process_noise=-0.1),
        lambda: double_integrator(process_noise=float("nan")),
        lambda: double_integrator(process_noise=float("inf")),
        lambda: Linear([[np.nan]], [[1.0]]),
        lambda: GaussianExcitation(length=0),
        lambda: GaussianExcitation(count=0),
        lambda: GaussianExcitation(input_std=float("nan")),
        lambda: GaussianExcitation(process_noise=-1.0),
    ],
)
def test_values_out_of_range_are_refused_in_one_line(make):
    with pytest.raises(ConfigError, match=r"^(system|recording): [^\n]*$"):
        make()


def test_a_recording_obeys_the_dynamics_and_starts_from_rest(system):
    recording = GaussianExcitation(length=50, process_noise=0.0, count=3).record(system)
    assert (recording.length, recording.count) == (50, 3)
    assert recording.states.shape == (3, 51, system.state_dim)
    assert (recording.states[:, 0] == 0).all()
    np.testing.assert_allclose(system.simulate(recording.states[:, 0], recording.inputs), recording.states, atol=1e-12)


def test_a_recording_takes_the_systems_noise_unless_told_otherwise():
    def residual(process_noise: float | None) -> float:
        recording = GaussianExcitation(length=4000, process_noise=process_noise).record(system)
        x, u = recording.states[0], recording.inputs[0]
        return float((x[1:] - x[:-1] @ system.A.T - u @ system.B.T).std())

    system = double_integrator(process_noise=0.03)
    np.testing.assert_allclose(residual(None), 0.03, rtol=0.05)
    np.testing.assert_allclose(residual(0.2), 0.2, rtol=0.05)
    assert residual(0.0) < 1e-10


def test_the_same_seed_gives_the_same_recording(system):
    one, two, other = (GaussianExcitation(length=9, seed=seed).record(system) for seed in (3, 3, 4))
    assert np.array_equal(one.states, two.states)
    assert np.array_equal(one.inputs, two.inputs)
    assert not np.array_equal(one.inputs, other.inputs)


def test_recordings_of_a_fleet_have_a_robot_dimension():
    recording = GaussianExcitation(length=20, process_noise=0.0, count=2).record(fleet())
    assert recording.states.shape == (3, 2, 21, 3)
    for k, robot in enumerate(members(fleet())):
        rolled = robot.simulate(recording.states[k, :, 0], recording.inputs[k])
        np.testing.assert_allclose(rolled, recording.states[k], atol=1e-12)


@pytest.mark.parametrize("states", [(2, 10, 4), (2, 11, 4, 1), (11, 4), (3, 11, 4)])
def test_a_recording_has_one_state_more_than_inputs(states):
    with pytest.raises(ShapeError, match=r"recording: states .* expected \(\.\.\., count, S\+1, n\)"):
        Recording(np.zeros(states), np.zeros((2, 10, 2)))


def learned(recording: Recording, offset="none", known=None):
    return least_squares(Transitions.of(recording.states, recording.inputs), offset, known)


def test_least_squares_finds_A_and_B(system):
    recording = GaussianExcitation(length=60, process_noise=0.0, count=2).record(system)
    estimate = learned(recording)
    A, B = estimate.A, estimate.B
    atol = tolerance(size=60, conditioning=1e3)
    np.testing.assert_allclose(A, system.A, atol=atol)
    np.testing.assert_allclose(B, system.B, atol=atol)


def test_least_squares_comes_closer_with_length():
    system = double_integrator(process_noise=0.05)
    errors = [np.abs(learned(GaussianExcitation(length=S).record(system)).A - system.A).max() for S in (30, 3000)]
    assert errors[1] < errors[0] / 3


def test_recordings_under_feedback_cannot_identify(system):
    x = GaussianExcitation(length=60, process_noise=0.01).record(system).states
    gain = np.ones((system.input_dim, system.state_dim))
    with pytest.raises(ExcitationError, match=rf"span {system.state_dim} dimensions, n \+ m = "):
        learned(Recording(x, x[:, :-1] @ gain.T))


def test_forward_euler_is_python_controls():
    import control

    for axes in (1, 2, 3):
        system = double_integrator(axes, time_step=0.3)
        zero, one = np.zeros((axes, axes)), np.eye(axes)
        continuous = control.ss(np.block([[zero, one], [zero, zero]]), np.vstack([zero, one]), np.eye(2 * axes), 0)
        discrete = control.c2d(continuous, 0.3, method="euler")
        np.testing.assert_array_equal(system.A, discrete.A)
        np.testing.assert_array_equal(system.B, discrete.B)

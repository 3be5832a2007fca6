"""The nearest trajectory within limits: held against a general solver, and its own laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import tolerance

from dadiff.errors import ConfigError, ShapeError
from dadiff.experts.nearest import Limits, Nearest, Status, half_planes, nearest
from dadiff.systems import Linear, double_integrator
from dadiff.trajectory.layout import TrajectoryLayout

SYSTEM, T, COUNT = double_integrator(process_noise=0.0), 20, 12
LAYOUT = SYSTEM.layout(T)
STAGES = (np.tile(SYSTEM.A, (T, 1, 1)), np.tile(SYSTEM.B, (T, 1, 1)), np.zeros((T, 4)))


def stages(system: Linear) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and an offset for each of T steps, which differ a little from step to step."""
    rng = np.random.default_rng(0)
    n = len(system.A)
    A = system.A + 0.05 * rng.normal(size=(T, n, n))
    return A, np.tile(system.B, (T, 1, 1)), 0.1 * rng.normal(size=(T, n))


@pytest.fixture(scope="module")
def estimates() -> np.ndarray:
    """Simulated trajectories with noise on every entry, (N, d)."""
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(COUNT, T, 2))
    states = SYSTEM.simulate(rng.uniform(-1, 1, size=(COUNT, 4)), inputs)
    return LAYOUT.flatten(states, inputs) + 0.03 * rng.normal(size=(COUNT, LAYOUT.size))


def discs_near(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two discs that the path (N, T+1, 2) enters a little: centres (N, 2, 2) and radii (N, 2)."""
    return path[:, [10, 15]] + np.array([0.3, 0.2]), np.full((len(path), 2), 0.45)


def limits(tau: np.ndarray, *, inputs: float = np.inf, velocity: float = np.inf, discs: bool = False) -> Limits:
    """x(0) pinned to where the estimates start, bounds on inputs and velocities, and discs near the path."""
    free = Limits.nothing(LAYOUT, len(tau))
    state, control = np.full((len(tau), T + 1, 4), np.inf), np.full((len(tau), T, 2), inputs)
    state[:, 1:, 2:] = velocity
    high, low = LAYOUT.flatten(state, control), LAYOUT.flatten(-state, -control)
    x_init = np.clip(LAYOUT.states(tau)[:, 0], -0.9 * velocity, 0.9 * velocity)
    low[:, LAYOUT.initial_state] = high[:, LAYOUT.initial_state] = x_init
    if not discs:
        return Limits(low, high, free.normal, free.offset)
    path = LAYOUT.states(tau)[..., :2]
    normal, offset = half_planes(path, *discs_near(path))
    offset[:, :4] = -np.inf
    return Limits(low, high, normal, offset)


def optimum(
    tau: np.ndarray, given: Limits, k: int, A: np.ndarray, B: np.ndarray, c: np.ndarray, scale: np.ndarray
) -> float:
    """The squared distance of plan k to the nearest admissible trajectory, by Clarabel; inf where there is none."""
    import cvxpy as cp

    z = cp.Variable(LAYOUT.size)
    n = LAYOUT.channel("x").size
    x, u = cp.reshape(z[:n], (T + 1, 4), order="C"), cp.reshape(z[n:], (T, 2), order="C")
    constraints = [x[t + 1] == A[t] @ x[t] + B[t] @ u[t] + c[t] for t in range(T)]
    above, below = np.isfinite(given.low[k]), np.isfinite(given.high[k])
    constraints += [z[above] >= given.low[k][above], z[below] <= given.high[k][below]]
    for t, j in np.argwhere(np.isfinite(given.offset[k])):
        constraints.append(given.normal[k, t, j] @ x[t, :2] >= given.offset[k, t, j])
    problem = cp.Problem(cp.Minimize(cp.sum_squares((z - tau[k]) / scale)), constraints)
    return float(problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11))


def residual(tau: np.ndarray, A: np.ndarray, B: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Of the dynamics, (N, T, n)."""
    x, u = LAYOUT.split(tau)
    return np.einsum("tij,ktj->kti", A, x[:, :-1]) + np.einsum("tij,ktj->kti", B, u) + c - x[:, 1:]


CASES = {
    "pinned": {},
    "inputs": {"inputs": 0.8},
    "inputs and velocities": {"inputs": 1.2, "velocity": 0.9},
    "discs": {"discs": True},
    "all": {"inputs": 3.0, "velocity": 2.0, "discs": True},
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("scaled", [False, True])
def test_it_is_the_optimum_and_keeps_its_limits(case: dict, scaled: bool, estimates: np.ndarray) -> None:
    given, (A, B, c) = limits(estimates, **case), stages(SYSTEM)
    scale = np.random.default_rng(2).uniform(0.5, 2, size=LAYOUT.size) if scaled else np.ones(LAYOUT.size)
    found = nearest(LAYOUT, estimates, A, B, c, given, scale)
    assert (found.status == Status.FOUND).any()
    good = np.flatnonzero(found.status == Status.FOUND)
    assert np.abs(residual(found.tau[good], A, B, c)).max() < 1e-8
    assert (given.low <= found.tau + 1e-12)[good].all()
    assert (found.tau - 1e-12 <= given.high)[good].all()
    margin = np.einsum("ktjd,ktd->ktj", given.normal, LAYOUT.states(found.tau)[..., :2]) - given.offset
    assert margin[good].min(initial=0.0) > -1e-10
    for k in range(6):
        best = optimum(estimates, given, k, A, B, c, scale)
        assert found.status[k] == Status.FOUND or not best < 1e3  # what is nearly infeasible is given up
        if found.status[k] == Status.FOUND:
            assert np.square((found.tau[k] - estimates[k]) / scale).sum() == pytest.approx(best, rel=1e-6)


def test_without_limits_it_is_the_orthogonal_projection(estimates: np.ndarray) -> None:
    found = nearest(LAYOUT, estimates, *STAGES, Limits.nothing(LAYOUT, COUNT))
    impulses = np.eye(LAYOUT.rank)
    basis = LAYOUT.flatten(
        SYSTEM.simulate(impulses[:, :4], impulses[:, 4:].reshape(-1, T, 2)), impulses[:, 4:].reshape(-1, T, 2)
    ).T
    expected = (basis @ np.linalg.lstsq(basis, estimates.T, rcond=None)[0]).T
    np.testing.assert_allclose(found.tau, expected, atol=1e-10)
    assert found.iterations.max() <= 2


def test_what_lies_outside_of_half_planes_lies_outside_of_discs(estimates: np.ndarray) -> None:
    path = LAYOUT.states(estimates)[..., :2]
    centre, radius = discs_near(path)
    found = nearest(LAYOUT, estimates, *STAGES, limits(estimates, discs=True))
    good = np.flatnonzero(found.status == Status.FOUND)
    assert len(good) > COUNT // 2
    distance = np.linalg.norm(LAYOUT.states(found.tau)[:, 4:, None, :2] - centre[:, None], axis=-1) - radius[:, None]
    assert distance[good].min() > -1e-9


def test_half_planes_touch_their_disc_on_the_side_of_the_path() -> None:
    path = np.tile([2.0, 0.0], (1, 3, 1))
    normal, offset = half_planes(path, np.zeros((1, 2, 2)), np.array([[0.5, 0]]))
    np.testing.assert_allclose(normal[0, 2, 0], [1, 0])
    nothing = -np.inf
    np.testing.assert_array_equal(offset[0], [[nothing, nothing], [nothing, nothing], [0.5, nothing]])


def ends_at(tau: np.ndarray, distance: float, inputs: float) -> Limits:
    """x(0) pinned, inputs bounded, and x(T) pinned that far away."""
    given = limits(tau, inputs=inputs)
    target = LAYOUT.states(given.low)[:, 0] + np.array([distance, 0, 0, 0])
    low, high = given.low.copy(), given.high.copy()
    end = np.arange(LAYOUT.size)[LAYOUT.all_states][-4:]
    low[:, end] = high[:, end] = target
    return Limits(low, high, given.normal, given.offset)


def test_what_cannot_be_reached_is_said(estimates: np.ndarray) -> None:
    far = nearest(LAYOUT, estimates, *STAGES, ends_at(estimates, 30.0, 1.0))
    np.testing.assert_array_equal(far.status, Status.INFEASIBLE)
    near = nearest(LAYOUT, estimates, *STAGES, ends_at(estimates, 0.5, 20.0))
    np.testing.assert_array_equal(near.status, Status.FOUND)


def test_half_planes_that_contradict_each_other_are_said(estimates: np.ndarray) -> None:
    given = limits(estimates)
    normal, offset = np.zeros((COUNT, T + 1, 2, 2)), np.full((COUNT, T + 1, 2), -np.inf)
    normal[:, 9], offset[:, 9] = [[1, 0], [-1, 0]], 1.0
    found = nearest(LAYOUT, estimates, *STAGES, Limits(given.low, given.high, normal, offset))
    np.testing.assert_array_equal(found.status, Status.INFEASIBLE)


def same(one: Nearest, other: Nearest, rows: slice = slice(None)) -> None:
    np.testing.assert_allclose(one.tau, other.tau[rows], atol=tolerance(size=LAYOUT.size, conditioning=1e3))
    np.testing.assert_array_equal(one.status, other.status[rows])


def test_a_batch_gives_what_its_plans_give_alone_and_dynamics_may_be_each_plans_own(estimates: np.ndarray) -> None:
    given = limits(estimates, inputs=0.8)
    together = nearest(LAYOUT, estimates, *STAGES, given)
    own = [np.tile(M, (COUNT, *(1,) * M.ndim)) for M in STAGES]
    same(nearest(LAYOUT, estimates, *own, given), together)
    alone = Limits(given.low[3:4], given.high[3:4], given.normal[3:4], given.offset[3:4])
    same(nearest(LAYOUT, estimates[3:4], *STAGES, alone), together, slice(3, 4))


def test_the_multipliers_of_a_solution_are_the_solution_again_at_once(estimates: np.ndarray) -> None:
    given = limits(estimates, inputs=0.8)
    once = nearest(LAYOUT, estimates, *STAGES, given)
    again = nearest(LAYOUT, estimates, *STAGES, given, start=once.multiplier)
    assert again.iterations.max() == 0
    same(again, once)


def test_plans_of_another_shape_are_refused(estimates: np.ndarray) -> None:
    with pytest.raises(ShapeError, match="expected \\(N, 124\\)"):
        nearest(LAYOUT, estimates[None], *STAGES, Limits.nothing(LAYOUT, COUNT))
    with pytest.raises(ShapeError):
        nearest(TrajectoryLayout(4, 2, T + 1), estimates, *STAGES, Limits.nothing(LAYOUT, COUNT))


def test_an_entry_without_a_scale_is_refused(estimates: np.ndarray) -> None:
    scale = np.ones(LAYOUT.size)
    scale[5] = 0.0
    with pytest.raises(ConfigError, match="no positive scale"):
        nearest(LAYOUT, estimates, *STAGES, Limits.nothing(LAYOUT, COUNT), scale)


def test_limits_say_what_is_exceeded(estimates: np.ndarray) -> None:
    given = limits(estimates, inputs=0.8, discs=True)
    found = nearest(LAYOUT, estimates, *STAGES, given)
    np.testing.assert_allclose(given.exceeded(LAYOUT, found.tau)[found.found], 0, atol=1e-9)
    tau = given.clip(estimates)
    tau[:, -1] += 1.3 - tau[:, -1]  # the last input, whose bound is 0.8
    free = Limits.nothing(LAYOUT, COUNT)
    boxes = Limits(given.low, given.high, free.normal, free.offset)
    np.testing.assert_allclose(boxes.exceeded(LAYOUT, tau), 0.5)


def test_what_a_plan_lacks_to_keep_its_limits_is_added_up():
    """x(t) = t along the first axis; a bound of 1 on it, and a wall that asks for 2 or more of the second at t = 2."""
    layout = TrajectoryLayout(2, 1, 2)
    tau = layout.flatten(np.array([[[0.0, 0], [1, 0], [2, 0.5]]]), np.array([[[3.0], [-4.0]]]))
    none = Limits.nothing(layout, 1)
    walls = replace(none, normal=np.tile([0.0, 1.0], (1, 3, 1, 1)), offset=np.array([[[-np.inf], [-np.inf], [2.0]]]))
    low, high = (layout.flatten(np.full((1, 3, 2), x), np.full((1, 2, 1), u)) for x, u in ((-np.inf, -1.0), (1.0, 1.0)))
    assert none.exceeded(layout, tau) == 0
    assert walls.exceeded(layout, tau) == 1.5
    assert replace(none, low=low, high=high).exceeded(layout, tau) == 1 + 2 + 3
    assert replace(walls, low=low, high=high).exceeded(layout, tau) == 1.5 + 1 + 2 + 3

"""Laws of the batched obstacle solver: linear algebra, derivatives, and what every solution must satisfy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dadiff.compiling import compiled
from dadiff.errors import ConfigError
from dadiff.experts.obstacles import batched, kernels
from dadiff.experts.obstacles.problem import ObstacleProblem, time_step_of
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.systems import Linear, double_integrator
from dadiff.tasks.obstacles import Obstacles


def draw(count: int, seed: int = 0, **settings: object) -> ObstacleProblem:
    """Problems of drawn environments."""
    task = Obstacles(**settings)  # type: ignore[arg-type]
    environments, _ = task.distribution_for(0.1).sample(count, np.random.default_rng(seed))
    return task.problem(environments, 0.1)


def dense(diagonal: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The block pentadiagonal matrix with blocks [[a, b], [b, d]], (2K, 2K)."""
    K = len(diagonal)
    M = np.zeros((K, 2, K, 2))
    for k, (a, b, d) in enumerate(diagonal):
        M[k, :, k] = [[a, b], [b, d]]
        for below, entry in ((1, first), (2, second)):
            if k >= below:
                M[k, :, k - below] = M[k - below, :, k] = entry[k] * np.eye(2)
    return M.reshape(2 * K, 2 * K)


@pytest.mark.parametrize("K", [1, 2, 3, 12])
def test_block_factor_solves_as_dense_numpy(K: int) -> None:
    rng = np.random.default_rng(K)
    for _ in range(5):
        first, second = rng.normal(size=(2, K))
        diagonal = rng.normal(size=(K, 3)) + np.array([9, 0, 9])
        M, right = dense(diagonal, first, second), rng.normal(size=(K, 2))
        inverse, lower, found = np.empty((K, 3)), np.empty((K, 4)), right.copy()
        assert kernels.factorise(diagonal, first, second, inverse, lower)
        kernels.substitute(inverse, lower, second, found)
        np.testing.assert_allclose(M @ found.ravel(), right.ravel(), atol=1e-12)


@pytest.mark.parametrize(("at", "pivot", "definite"), [(0, 3.0, True), (0, -1.0, False), (4, -0.5, False)])
def test_block_factor_tells_whether_the_matrix_is_definite(at: int, pivot: float, definite: bool) -> None:
    diagonal = np.tile([3.0, 0.0, 3.0], (6, 1))
    diagonal[at, 2] = pivot
    first, second = np.full(6, 0.5), np.full(6, 0.2)
    assert definite == (np.linalg.eigvalsh(dense(diagonal, first, second))[0] > 0)
    assert kernels.factorise(diagonal, first, second, np.empty((6, 3)), np.empty((6, 4))) == definite


@pytest.mark.parametrize("K", [1, 2, 3, 7])
def test_the_hessian_of_second_differences_is_that_of_the_dense_matrix(K: int) -> None:
    D = np.eye(K) - 2 * np.eye(K, k=-1) + np.eye(K, k=-2)
    nothing, diagonal = np.zeros((K, 0)), np.empty((K, 3))
    one = kernels.One(np.zeros((K + 2, 2)), np.zeros(K + 2), np.zeros((0, 2)), np.zeros(0), 0.7)
    kernels.blocks(one, np.zeros((K + 2, 2)), nothing, 1.0, 1.0, diagonal)
    np.testing.assert_allclose(dense(diagonal, *kernels.band(K, 0.7)), np.kron(1.4 * D.T @ D, np.eye(2)), atol=1e-12)


def test_obstacle_free_optimum_is_the_least_squares_optimum_in_closed_form() -> None:
    problem = draw(4)
    found = obstacle_free(problem)
    T, dt = problem.horizon, problem.time_step
    delay = np.arange(T + 1)[:, None] - np.arange(T) - 1
    G = dt**2 * np.maximum(delay, 0)
    for i in range(problem.count):
        free = problem.x_init[i, :2] + dt * np.arange(T + 1)[:, None] * problem.x_init[i, 2:]
        root = np.sqrt(problem.weight[i])[:, None]
        stacked = np.vstack([root * G, np.sqrt(problem.input_cost) * np.eye(T)])
        right = np.vstack([root * (problem.goal[i] - free), np.zeros((T, 2))])
        u = np.linalg.lstsq(stacked, right, rcond=None)[0]
        np.testing.assert_allclose(found[i], free + G @ u, atol=1e-9)


Point = tuple[kernels.One, np.ndarray, np.ndarray]


@pytest.fixture(params=range(3))
def point(request: pytest.FixtureRequest) -> Point:
    """An environment, a path that enters discs, and multipliers; the penalty is 2."""
    problem = draw(3, horizon=12, waypoint_times=[5, 10]).take(np.array([request.param]))
    rng = np.random.default_rng(request.param)
    one = kernels.One(problem.goal[0], problem.weight[0], problem.centre[0], problem.radius[0], problem.kappa)
    path = obstacle_free(problem)[0] + 0.1 * rng.normal(size=(13, 2))
    return one, path, rng.uniform(0, 0.5, size=(11, 4))


def value(point: Point, p: np.ndarray) -> float:
    """L(p)."""
    one, _, multiplier = point
    s = np.empty_like(multiplier)
    kernels.force(one, p, multiplier, 2.0, s)
    return kernels.lagrangian(one, p, multiplier, 2.0, s)


def slope(point: Point, p: np.ndarray) -> np.ndarray:
    """dL/dq, (K, 2)."""
    one, _, multiplier = point
    s, found = np.empty_like(multiplier), np.empty((len(multiplier), 2))
    kernels.force(one, p, multiplier, 2.0, s)
    kernels.gradient(one, p, s, found)
    return found


def differences(function: Callable[[np.ndarray], np.ndarray | float], p: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Central differences along q = p(2..T), stacked along the first axis."""
    rows = []
    for k in range(2, len(p)):
        for axis in range(2):
            ahead, behind = p.copy(), p.copy()
            ahead[k, axis] += h
            behind[k, axis] -= h
            rows.append((np.asarray(function(ahead)) - np.asarray(function(behind))) / (2 * h))
    return np.array(rows)


def test_gradient_agrees_with_finite_differences(point: Point) -> None:
    numeric = differences(lambda p: value(point, p), point[1])
    np.testing.assert_allclose(slope(point, point[1]).ravel(), numeric, atol=1e-6)


def test_newton_hessian_agrees_with_finite_differences(point: Point) -> None:
    one, p, multiplier = point
    s, diagonal = np.empty_like(multiplier), np.empty((len(multiplier), 3))
    kernels.force(one, p, multiplier, 2.0, s)
    assert (s > 0).any()
    kernels.blocks(one, p, s, 2.0, 1.0, diagonal)
    numeric = differences(lambda q: slope(point, q), p).reshape(2 * len(s), -1)
    np.testing.assert_allclose(dense(diagonal, *kernels.band(len(s), one.kappa)), numeric, atol=1e-5)


def test_a_function_that_finds_no_place_for_its_machine_code_still_runs() -> None:
    """As in a read-only installation without a home: here, because its source lies in no file."""
    names: dict[str, Any] = {}
    exec("def double(x):\n    return 2 * x", names)
    assert compiled(names["double"])(3) == 6


@pytest.fixture(scope="module", params=["default", "uniform", "hard"])
def solved(request: pytest.FixtureRequest) -> tuple[ObstacleProblem, object]:
    problem = draw(30, seed=3, distribution=request.param)
    return problem, batched.solve(problem)


def test_every_solution_keeps_clear_at_every_step_and_costs_at_least_the_obstacle_free_cost(solved: tuple) -> None:
    problem, found = solved
    assert found.solved.all()
    assert problem.penetration(found.positions).max() <= 1e-7
    free = obstacle_free(problem)
    assert (found.cost >= problem.cost(free, problem.inputs(free)) - 1e-12).all()


def test_rolling_out_the_inputs_reproduces_the_positions(solved: tuple) -> None:
    problem, found = solved
    states = double_integrator(process_noise=0.0).simulate(problem.x_init, found.inputs)
    np.testing.assert_allclose(states[..., :2], found.positions, atol=1e-10)
    np.testing.assert_array_equal(found.inputs[:, -1], 0)


def free_gradient(problem: ObstacleProblem, i: int, p: np.ndarray) -> np.ndarray:
    """df/dq of environment i, (K, 2)."""
    none, found = np.zeros((len(p) - 2, 0)), np.empty((len(p) - 2, 2))
    one = kernels.One(problem.goal[i], problem.weight[i], np.zeros((0, 2)), np.zeros(0), problem.kappa)
    kernels.gradient(one, p, none, found)
    return found


def test_solutions_are_stationary_given_the_discs_that_they_touch(solved: tuple) -> None:
    """KKT: the gradient of the cost is a sum of pushes >= 0 along the normals of touched discs."""
    problem, found = solved
    gradient = np.array([free_gradient(problem, i, p) for i, p in enumerate(found.positions)])
    offset = found.positions[:, 2:, None] - problem.centre[:, None]
    touched = (problem.penetration(found.positions) > -1e-5) & (problem.radius[:, None] > 0)
    normal = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    push = np.where(touched, (gradient[:, :, None] * normal).sum(axis=-1), 0)
    assert push.min() > -1e-5
    residual = gradient - (push[..., None] * normal).sum(axis=2)
    assert np.abs(residual).max() < 1e-5


def test_without_obstacles_the_solution_is_the_closed_form() -> None:
    problem = draw(5, max_obstacles=0)
    np.testing.assert_array_equal(batched.solve(problem).positions, obstacle_free(problem))


def test_a_batch_gives_what_its_environments_give_alone() -> None:
    problem = draw(12, seed=5)
    together = batched.solve(problem)
    for i in range(3):
        alone = batched.solve(problem.take(np.array([i])))
        np.testing.assert_allclose(alone.positions[0], together.positions[i], atol=1e-6)


def test_a_disc_on_the_way_is_passed_on_the_cheaper_side() -> None:
    """A straight run along x with a disc a little above it: below is shorter, wherever the start lies."""
    weight, goal = np.zeros((1, 41)), np.zeros((1, 41, 2))
    weight[0, 40], goal[0, 40] = 1.0, [4.0, 0.0]
    x_init, centre = np.array([[0.0, 0, 1, 0]]), np.array([[[2.0, 0.1]]])
    problem = ObstacleProblem(x_init, goal, weight, centre, np.array([[0.6]]), 1e-3, 0.1)
    found = batched.solve(problem)
    assert found.positions[0, 20, 1] < 0
    mirrored = ObstacleProblem(x_init, goal, weight, centre * [1, -1], np.array([[0.6]]), 1e-3, 0.1)
    np.testing.assert_allclose(batched.solve(mirrored).cost, found.cost, rtol=1e-6)


def test_what_does_not_converge_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batched, "_ITERATIONS", 1)
    problem = draw(20, distribution="hard")
    found = batched.solve(problem)
    blocked = ~problem.feasible(obstacle_free(problem))
    assert blocked.any()
    np.testing.assert_array_equal(found.solved, ~blocked)


@pytest.mark.parametrize(
    "system",
    [
        double_integrator(axes=1),
        double_integrator(discretisation="zoh"),
        Linear(np.eye(4), np.zeros((4, 2))),
    ],
)
def test_other_systems_are_refused(system: Linear) -> None:
    with pytest.raises(ConfigError, match="planar double integrator by forward Euler"):
        time_step_of(system)


def test_the_time_step_is_read_from_the_system() -> None:
    assert time_step_of(double_integrator(time_step=0.25)) == pytest.approx(0.25)


def test_a_path_that_is_cheaper_by_rounding_alone_replaces_none() -> None:
    best = batched._Incumbents(np.zeros((3, 5, 2)), np.array([1.0, 2.0, np.inf]))
    rows, paths = np.array([2, 0, 1, 0]), np.arange(1.0, 5.0)[:, None, None] + np.zeros((4, 5, 2))
    cheaper = best.challenge(rows, paths, np.array([7.0, 1 - 1e-12, 1.5, 3.0]))
    assert cheaper.tolist() == [1, 2]
    np.testing.assert_array_equal(best.cost, [1.0, 1.5, 7.0])
    np.testing.assert_array_equal(best.positions[:, 0, 0], [0.0, 3.0, 1.0])

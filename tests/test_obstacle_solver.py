"""Laws of the batched obstacle solver: linear algebra, derivatives, and what every solution must satisfy."""

from __future__ import annotations

import numpy as np
import pytest

from dadiff.errors import ConfigError
from dadiff.experts.obstacles import batched
from dadiff.experts.obstacles.lagrangian import Lagrangian
from dadiff.experts.obstacles.pentadiagonal import factorise, squared_second_difference
from dadiff.experts.obstacles.problem import ObstacleProblem, time_step_of
from dadiff.experts.obstacles.quadratic import Quadratic, batch_last, obstacle_free
from dadiff.systems import LinearSystem, double_integrator
from dadiff.tasks.obstacles import Obstacles


def draw(count: int, seed: int = 0, **settings: object) -> ObstacleProblem:
    """Problems of drawn environments."""
    task = Obstacles(**settings)  # type: ignore[arg-type]
    environments, _ = task.distribution_for(0.1).sample(count, np.random.default_rng(seed))
    return task.problem(environments, 0.1)


def dense(diagonal: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The block pentadiagonal matrix of one system, (2K, 2K)."""
    K = len(diagonal)
    M = np.zeros((K, 2, K, 2))
    for k in range(K):
        M[k, :, k] = diagonal[k]
        for below, entry in ((1, first), (2, second)):
            if k >= below:
                M[k, :, k - below] = M[k - below, :, k] = entry[k] * np.eye(2)
    return M.reshape(2 * K, 2 * K)


@pytest.mark.parametrize("K", [1, 2, 3, 12])
def test_block_factor_solves_as_dense_numpy(K: int) -> None:
    rng = np.random.default_rng(K)
    root = rng.normal(size=(K, 2, 2, 5))
    diagonal = np.einsum("kijn,kljn->kiln", root, root) + 9 * np.eye(2)[:, :, None]
    first, second = rng.normal(size=(2, K))
    right = rng.normal(size=(K, 2, 5))
    factor = factorise(diagonal, first, second)
    found = factor.solve(right)
    for n in range(5):
        M = dense(diagonal[..., n], first, second)
        np.testing.assert_allclose(M @ found[..., n].ravel(), right[..., n].ravel(), atol=1e-12)
        assert factor.definite[n] == (np.linalg.eigvalsh(M)[0] > 0)


def test_block_factor_tells_which_systems_are_not_definite() -> None:
    diagonal = np.eye(2)[None, :, :, None] * np.array([3.0, 3.0, -1.0]) * np.ones((6, 1, 1, 1))
    diagonal[4, 1, 1, 1] = -0.5
    factor = factorise(diagonal, np.full(6, 0.5), np.full(6, 0.2))
    np.testing.assert_array_equal(factor.definite, [True, False, False])


def test_squared_second_difference_is_that_of_the_dense_matrix() -> None:
    band = squared_second_difference(5)
    np.testing.assert_array_equal(band.diagonal, [6, 6, 6, 5, 1])
    np.testing.assert_array_equal(band.first, [0, -4, -4, -4, -2])
    np.testing.assert_array_equal(band.second, [0, 0, 1, 1, 1])


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


@pytest.fixture
def lagrangian() -> tuple[Lagrangian, np.ndarray]:
    problem = draw(3, horizon=12, waypoint_times=[5, 10])
    L = Lagrangian.of(problem, 2.0)
    rng = np.random.default_rng(1)
    L = Lagrangian(L.f, L.centre, L.radius, rng.uniform(0, 0.5, size=L.multiplier.shape), L.penalty)
    path = np.moveaxis(obstacle_free(problem), 0, -1)
    return L, path + 0.1 * rng.normal(size=path.shape)


def test_gradient_agrees_with_finite_differences(lagrangian: tuple[Lagrangian, np.ndarray]) -> None:
    L, p = lagrangian
    g, offset = L.constraint(p)
    gradient = L.gradient(p, L.force(g), offset)
    numeric, h = np.empty_like(gradient), 1e-6
    for k in range(len(gradient)):
        for axis in range(2):
            ahead, behind = p.copy(), p.copy()
            ahead[k + 2, axis] += h
            behind[k + 2, axis] -= h
            numeric[k, axis] = (L.value(ahead) - L.value(behind)) / (2 * h)
    np.testing.assert_allclose(gradient, numeric, atol=1e-6)


def test_newton_hessian_agrees_with_finite_differences(lagrangian: tuple[Lagrangian, np.ndarray]) -> None:
    L, p = lagrangian
    g, offset = L.constraint(p)
    blocks, concave = L.blocks(L.force(g), offset)
    blocks[:, [0, 1], [0, 1]] -= concave[:, None]
    f, h = L.f, 1e-6
    for n in range(p.shape[-1]):
        H = dense(blocks[..., n], 2 * f.kappa * f.band.first, 2 * f.kappa * f.band.second)
        one, q = L.take(np.array([n])), p[..., [n]]
        for k in range(len(g)):
            ahead, behind = q.copy(), q.copy()
            ahead[k + 2, 0] += h
            behind[k + 2, 0] -= h
            column = (_gradient(one, ahead) - _gradient(one, behind)) / (2 * h)
            np.testing.assert_allclose(H[:, 2 * k], column.ravel(), atol=1e-5)


def _gradient(L: Lagrangian, p: np.ndarray) -> np.ndarray:
    g, offset = L.constraint(p)
    return L.gradient(p, L.force(g), offset)


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


def test_solutions_are_stationary_given_the_discs_that_they_touch(solved: tuple) -> None:
    """KKT: the gradient of the cost is a sum of pushes >= 0 along the normals of touched discs."""
    problem, found = solved
    gradient = np.moveaxis(Quadratic.of(problem).gradient(batch_last(found.positions)), -1, 0)
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
        LinearSystem(np.eye(4), np.zeros((4, 2))),
    ],
)
def test_other_systems_are_refused(system: LinearSystem) -> None:
    with pytest.raises(ConfigError, match="planar double integrator by forward Euler"):
        time_step_of(system)


def test_the_time_step_is_read_from_the_system() -> None:
    assert time_step_of(double_integrator(time_step=0.25)) == pytest.approx(0.25)

"""The three experts agree: `batched` is held against the other two, which share nothing with it but the starts."""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dadiff.errors import MissingExtraError
from dadiff.experts.obstacles import batched, ipopt, successive
from dadiff.experts.obstacles.problem import ObstacleProblem, Status
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.experts.obstacles.starts import best_of_starts, many_starts, other_side, subsets
from dadiff.tasks.obstacles import Obstacles


def draw(count: int, seed: int, **settings: object) -> ObstacleProblem:
    task = Obstacles(**settings)  # type: ignore[arg-type]
    environments, _ = task.distribution_for(0.1).sample(count, np.random.default_rng(seed))
    return task.problem(environments, 0.1)


def off_centre_disc() -> ObstacleProblem:
    """A disc beside a straight run: one local optimum is much cheaper, and every start leads to it."""
    weight, goal = np.zeros((1, 31)), np.zeros((1, 31, 2))
    weight[0, [15, 30]] = 1.0
    goal[0, 15], goal[0, 30] = [1.5, -0.05], [3.0, 0.0]
    x_init = np.array([[0.0, 0, 1, 0]])
    return ObstacleProblem(x_init, goal, weight, np.array([[[1.5, 0.4]]]), np.array([[0.55]]), 1e-3, 0.1)


def test_all_three_agree_where_there_is_one_local_optimum() -> None:
    problem = off_centre_disc()
    assert not problem.feasible(obstacle_free(problem))[0]
    found = [expert.solve(problem) for expert in (batched, successive, ipopt)]
    for other in found[1:]:
        assert other.solved.all()
        np.testing.assert_allclose(other.cost, found[0].cost, rtol=1e-4)
        np.testing.assert_allclose(other.positions, found[0].positions, atol=2e-3)


def test_starts_pass_a_disc_on_both_sides() -> None:
    starts = many_starts(off_centre_disc())
    np.testing.assert_allclose(starts[:, 1], starts[:1, 1].repeat(len(starts), axis=0))
    assert {True, False} <= set((starts[:, 15, 1] > 0.4).tolist())


@pytest.mark.parametrize("discs", [0, 1, 2])
def test_where_no_disc_may_be_flipped_there_is_no_choice_of_sides(discs: int) -> None:
    problem = off_centre_disc()
    some = replace(problem, centre=problem.centre.repeat(discs, axis=1), radius=problem.radius.repeat(discs, axis=1))
    path, met = obstacle_free(problem), np.ones((1, discs), dtype=bool)
    for at_most, largest in ((0, None), (2, 0)):
        rows, masks = subsets(some, path, met, at_most, largest=largest)
        assert (rows.shape, masks.shape) == ((0,), (0, discs))
    rows, masks = subsets(some, path, met, 2)
    assert (rows.shape, masks.shape) == ((2**discs - 1,), (2**discs - 1, discs))
    assert len({tuple(mask) for mask in masks}) == 2**discs - 1
    assert [mask.sum() for mask in subsets(some, path, met, 2, largest=1)[1]] == [1] * discs


def test_the_trust_region_shrinks_where_nothing_is_gained_until_it_is_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The programs are played: better paths twice, then none; where one fails there is no path."""
    problem, regions = off_centre_disc(), []
    start = obstacle_free(problem)[0]
    free = replace(problem, radius=0 * problem.radius)
    played = [start + 0.2, start + 0.1, start] + 40 * [start + 0.3]

    def play(self: object, one: ObstacleProblem, reference: np.ndarray, region: float) -> np.ndarray:
        regions.append((region, float(np.abs(reference - start).max())))
        return played[len(regions) - 1]

    monkeypatch.setattr(successive._Program, "_convexified", play)
    program = successive._Program(None, None, defaultdict(SimpleNamespace))
    np.testing.assert_array_equal(program.solve_from(free, start + 0.4), start)
    sizes, away = zip(*regions, strict=True)
    np.testing.assert_allclose(away[:5], [0.4, 0.2, 0.1, 0, 0], atol=1e-12)
    assert sizes[:4] == (1.0,) * 4
    assert sizes[4:] == tuple(0.5**k for k in range(1, len(sizes) - 3))
    assert sizes[-1] >= 1e-4 > sizes[-1] / 2
    monkeypatch.setattr(successive._Program, "_convexified", lambda *_: None)
    assert program.solve_from(free, start) is None


def test_the_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'dadiff\[ipopt\]'"):
        ipopt.solve(off_centre_disc())


def test_an_environment_that_no_start_solves_is_said() -> None:
    problem = off_centre_disc()
    failing = best_of_starts(problem, lambda one, start: None, progress=False)
    np.testing.assert_array_equal(failing.status, [Status.NOT_CONVERGED])
    through = best_of_starts(problem, lambda one, start: obstacle_free(one)[0], progress=False)
    assert not through.solved.any()


@pytest.mark.slow
def test_batched_is_never_worse_than_successive_convexification_from_several_starts() -> None:
    problem = draw(50, seed=11)
    found, reference = batched.solve(problem), successive.solve(problem)
    assert found.solved.all()
    assert reference.solved.all()
    assert (found.cost <= 1.01 * reference.cost).all()


@pytest.mark.slow
@pytest.mark.parametrize(("distribution", "share"), [("default", 0.99), ("hard", 0.95)])
def test_batched_is_nearly_always_as_good_as_ipopt_from_several_starts(distribution: str, share: float) -> None:
    problem = draw(60, seed=12, distribution=distribution)
    found, reference = batched.solve(problem), ipopt.solve(problem)
    assert found.solved.all()
    assert (found.cost <= 1.01 * reference.cost).mean() >= share


def test_without_a_disc_to_pass_the_start_is_the_obstacle_free_optimum() -> None:
    problem = off_centre_disc()
    heavy, none = replace(problem, weight=3 * problem.weight), np.zeros((1, 1), dtype=bool)
    np.testing.assert_allclose(other_side(heavy, obstacle_free(heavy), none, none), obstacle_free(heavy))


@pytest.mark.parametrize("weight", [0.0, 1.0], ids=["between waypoints", "at a waypoint"])
def test_discs_are_passed_by_a_waypoint_beyond_the_rim_on_the_side_that_is_asked_for(weight: float) -> None:
    """Where the path is nearest to each centre: as far out as it is if it may stay, mirrored just beyond if not."""
    problem = off_centre_disc()
    problem = replace(
        problem, centre=np.array([[[1.5, 0.4], [2.2, -0.9]]]), radius=np.array([[0.55, 0.3]]), weight=problem.weight
    )
    problem.weight[0, 15] = weight
    path, flip = obstacle_free(problem), np.array([[True, False]])
    found = other_side(problem, path, ~flip, flip)
    weights, goals = problem.weight[0].copy(), problem.goal[0].copy()
    for centre, radius, flipped in zip(problem.centre[0], problem.radius[0], flip[0], strict=True):
        away = np.linalg.norm(path[0, 2:] - centre, axis=-1)
        t = 2 + away.argmin()
        out = (path[0, t] - centre) / away.min()
        there = centre - 1.05 * radius * out if flipped else centre + max(1.05 * radius, away.min()) * out
        goals[t] = (weights[t] * goals[t] + 10 * there) / (weights[t] + 10)
        weights[t] += 10
    expected = obstacle_free(replace(problem, weight=weights[None], goal=goals[None]))
    np.testing.assert_allclose(found, expected, atol=1e-9)

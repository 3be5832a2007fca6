"""Where to start from: which discs a path meets, and paths that pass some of them on the other side.

An optimum passes each disc on one of two sides, and which pair of sides is cheapest is a question of combinations.
A start is the obstacle-free optimum with one more waypoint at each disc met, on the side asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dadiff.experts.obstacles.problem import ObstacleProblem, Solutions, Status, solutions
from dadiff.experts.obstacles.quadratic import obstacle_free

_PULL = 10.0  # weight of the extra waypoint; the task's own waypoints weigh about 1
_NEARBY, _AT_MOST = 1.0, 3  # metres from a disc, and discs, that `many_starts` tries both sides of
_BEYOND = 1.05  # where it lies, in radii from the centre


def encounters(problem: ObstacleProblem, positions: np.ndarray, reach: float) -> np.ndarray:
    """Which discs the path comes to within `reach` metres of, or enters, (N, O)."""
    depth = problem.penetration(positions).max(axis=1)
    return (depth >= -reach) & (problem.radius > 0)


def tightest(met: np.ndarray, depth: np.ndarray, at_most: int) -> list[np.ndarray]:
    """Of the discs met (N, O) the `at_most` deepest, one array (N,) of indices a rank, -1 where there is none."""
    order = np.argsort(np.where(met, -depth, np.inf), axis=1)
    rows = np.arange(len(met))
    return [np.where(met[rows, order[:, k]], order[:, k], -1) for k in range(min(at_most, met.shape[1]))]


def subsets(
    problem: ObstacleProblem, positions: np.ndarray, met: np.ndarray, at_most: int, *, largest: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Every non-empty set of at most `largest` of the `at_most` tightest encounters of each path.

    Returns:
        The environment (J,), and the discs of the set as a mask (J, O).
    """
    ranked = tightest(met, problem.penetration(positions).max(axis=1), at_most)
    rows, masks = [], []
    for code in range(1, 2 ** len(ranked)):
        chosen = [disc for k, disc in enumerate(ranked) if code >> k & 1]
        if largest is not None and len(chosen) > largest:
            continue
        row = np.flatnonzero(np.all([disc >= 0 for disc in chosen], axis=0))
        mask = np.zeros((len(row), met.shape[1]), dtype=bool)
        for disc in chosen:
            mask[np.arange(len(row)), disc[row]] = True
        rows.append(row)
        masks.append(mask)
    if not rows:
        return np.zeros(0, dtype=int), np.zeros((0, met.shape[1]), dtype=bool)
    return np.concatenate(rows), np.concatenate(masks)


def other_side(problem: ObstacleProblem, positions: np.ndarray, keep: np.ndarray, flip: np.ndarray) -> np.ndarray:
    """Paths (N, T+1, 2) which pass the discs `keep` (N, O) as before and the discs `flip` (N, O) on the other side.

    The extra waypoint is due when the given path is closest to the disc, at t*: at p(t*) moved out of the disc, or
    at its mirror image beyond the centre.
    """
    nearest = 2 + problem.penetration(positions).argmax(axis=1)  # t*, (N, O)
    rows = np.arange(problem.count)
    weight, goal = problem.weight.copy(), problem.weight[..., None] * problem.goal
    for j in range(keep.shape[1]):
        t, pull = nearest[:, j], _PULL * (keep | flip)[:, j]
        offset = positions[rows, t] - problem.centre[:, j]
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        outside = np.maximum(_BEYOND * problem.radius[:, j, None], np.where(flip[:, j, None], 0.0, distance))
        side = np.where(flip[:, j], -1.0, 1.0)[:, None] * offset / np.maximum(distance, 1e-12)
        goal[rows, t] += pull[:, None] * (problem.centre[:, j] + outside * side)
        weight[rows, t] += pull
    goal /= np.where(weight > 0, weight, 1.0)[..., None]
    return obstacle_free(replace(problem, weight=weight, goal=goal))


def many_starts(problem: ObstacleProblem) -> np.ndarray:
    """Starts for one environment (N = 1) and a solver that takes one at a time, (J, T+1, 2).

    The obstacle-free optimum, straight lines from goal to goal, and each choice of sides for the discs near either.
    """
    bases = [obstacle_free(problem), straight_lines(problem)]
    starts = list(bases)
    for base in bases:
        met = encounters(problem, base, _NEARBY)
        rows, flip = subsets(problem, base, met, _AT_MOST)
        starts.append(other_side(problem.take(rows), base[rows], met[rows] & ~flip, flip))
    return np.concatenate(starts)


def straight_lines(problem: ObstacleProblem) -> np.ndarray:
    """From p(1) to goal after goal at constant speed, (1, T+1, 2), for one environment."""
    positions = np.zeros((1, problem.horizon + 1, 2))
    positions[:, :2] = problem.start
    due = 2 + np.flatnonzero(problem.weight[0, 2:])
    corners = np.concatenate([problem.start[:, 1], problem.goal[0, due]])
    t = np.arange(2, problem.horizon + 1)
    positions[0, 2:] = np.stack([np.interp(t, [1, *due], corners[:, axis]) for axis in range(2)], axis=1)
    return positions


def best_of_starts(
    problem: ObstacleProblem, solve_from: Callable[[ObstacleProblem, np.ndarray], np.ndarray | None], progress: bool
) -> Solutions:
    """The cheapest feasible path over `many_starts` of each environment.

    Args:
        solve_from: positions (T+1, 2) of one environment (N = 1) from one start, None where that failed.
    """
    from tqdm import tqdm

    best = obstacle_free(problem)
    status = np.full(problem.count, Status.NOT_CONVERGED)
    for i in tqdm(range(problem.count), desc="solving environments", unit="env", disable=not progress):
        one = problem.take(np.array([i]))
        found = [p for start in many_starts(one) if (p := solve_from(one, start)) is not None]
        feasible = [p for p in found if one.feasible(p[None])[0]]
        if feasible:
            best[i] = min(feasible, key=lambda p: float(one.cost(p[None], one.inputs(p[None]))[0]))
            status[i] = Status.SOLVED
    return solutions(problem, best, status)

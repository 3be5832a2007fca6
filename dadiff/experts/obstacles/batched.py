"""The batched expert: thousands of environments at once, by augmented-Lagrangian Newton from several starts.

One local solve is the method of multipliers (Nocedal & Wright, Algorithm 17.4): Newton with Armijo backtracking on the
augmented Lagrangian; where its decrement is small the multipliers move on, and the penalty grows where the violation
fell too little. `kernels` holds it, compiled, on one thread: workers run side by side.

Which side of each disc to pass is settled by trying: from the first optimum every set of the discs it touches is
flipped to the other side, then single discs at the incumbent, until none gets cheaper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dadiff.experts.obstacles.problem import TOLERANCE, ObstacleProblem, Solutions, Status, solutions
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.experts.obstacles.starts import encounters, other_side, subsets

_CHUNK = 500  # environments solved side by side: fewer waste calls, more leave the cache and hold the bar up
_ITERATIONS = 150
_AT_MOST, _ROUNDS = 4, 3  # encounters that are flipped in combination; rounds of single flips
_REACH = 1.0  # metres from a disc within which its other side is tried


def solve(problem: ObstacleProblem, *, progress: bool = False) -> Solutions:
    """The cheapest feasible path found for each environment.

    Args:
        progress: show a bar over environments.
    """
    from tqdm import tqdm

    positions = np.empty((problem.count, problem.horizon + 1, 2))
    status = np.empty(problem.count, dtype=int)
    with tqdm(total=problem.count, desc="solving environments", unit="env", disable=not progress) as bar:
        for first in range(0, problem.count, _CHUNK):
            rows = np.arange(first, min(first + _CHUNK, problem.count))
            positions[rows], status[rows] = _solve_chunk(problem.take(rows))
            bar.update(len(rows))
    return solutions(problem, positions, status)


@dataclass
class _Incumbents:
    """The best path of each environment so far: positions (N, T+1, 2), cost (N,), inf while there is none."""

    positions: np.ndarray
    cost: np.ndarray

    def challenge(self, rows: np.ndarray, positions: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """Let paths (J, ...) of environments `rows` (J,) compete; returns the environments that got cheaper."""
        order = np.lexsort((cost, rows))
        rows, best = np.unique(rows[order], return_index=True)
        winners = order[best]
        cheaper = cost[winners] < self.cost[rows] * (1 - 1e-9)
        rows, winners = rows[cheaper], winners[cheaper]
        self.positions[rows], self.cost[rows] = positions[winners], cost[winners]
        return rows


def _solve_chunk(problem: ObstacleProblem) -> tuple[np.ndarray, np.ndarray]:
    """Positions and status of environments few enough to be solved side by side."""
    free = obstacle_free(problem)
    best = _Incumbents(free.copy(), np.full(problem.count, np.inf))
    blocked = np.flatnonzero(~problem.feasible(free))
    if len(blocked):
        first, _ = _compete(problem, best, blocked, free[blocked])
        _flip_sides(problem, best, blocked, first)
    failed = ~np.isfinite(best.cost)
    failed[problem.feasible(free)] = False
    return best.positions, np.where(failed, Status.NOT_CONVERGED, Status.SOLVED)


def _compete(
    problem: ObstacleProblem, best: _Incumbents, rows: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve environments `rows` (J,) from `start` (J, T+1, 2); returns those paths and the rows that got cheaper."""
    jobs = problem.take(rows)
    positions, converged = minimise(jobs, start, best.cost[rows])
    cost = np.where(converged & jobs.feasible(positions), jobs.cost(positions, jobs.inputs(positions)), np.inf)
    return positions, best.challenge(rows, positions, cost)


def _flip_sides(problem: ObstacleProblem, best: _Incumbents, rows: np.ndarray, positions: np.ndarray) -> None:
    """Improve the incumbents of `rows` (J,), whose first optima are `positions` (J, T+1, 2), by passing elsewhere."""
    largest = None
    for _ in range(1 + _ROUNDS):
        here = problem.take(rows)
        met = encounters(here, positions, _REACH)
        job, flip = subsets(here, positions, met, _AT_MOST, largest=largest)
        if not len(job):
            return
        start = other_side(here.take(job), positions[job], met[job] & ~flip, flip)
        _, rows = _compete(problem, best, rows[job], start)
        positions, largest = best.positions[rows], 1


def minimise(
    problem: ObstacleProblem, start: np.ndarray, ceiling: np.ndarray | float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """One local optimum of each environment, from `start` (N, T+1, 2) on.

    The minimum of the augmented Lagrangian, with multipliers below their final values, lies below the cost of the
    local optimum that it leads to. Who is above the ceiling there, or will be by Newton's model, is given up.

    Args:
        ceiling: a cost above which the optimum is of no use, (N,).

    Returns:
        Positions (N, T+1, 2), and (N,) whether the method converged there.
    """
    from dadiff.experts.obstacles import kernels

    positions = start.copy()
    converged = kernels.minimise(
        positions, problem.goal, problem.weight, problem.centre, problem.radius, problem.kappa,
        np.broadcast_to(ceiling, problem.count).astype(float), _ITERATIONS, TOLERANCE / 10,
    )  # fmt: skip
    return positions, converged

"""Successive convexification in CVXPY: the expert to read first.

Around a reference path each disc is replaced by the half-plane n'(p(t) - o_j) >= r_j, n the direction from its centre
to the reference. The quadratic program that results is solved near the reference, in a trust region, with slack
that is paid for; its solution is the next reference, and the region shrinks where a step gained nothing.
Every number that changes is a parameter (disciplined parametrised programming), so the problem is compiled once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dadiff.experts.obstacles.problem import ObstacleProblem, Solutions
from dadiff.experts.obstacles.starts import best_of_starts

_SLACK_PRICE = 10.0  # per metre; above the multipliers of typical environments, so that slack ends at 0
_REGION, _SHRINK, _SMALLEST = 1.0, 0.5, 1e-4  # trust region in metres
_ITERATIONS = 40
_GAIN = 1e-7  # relative fall of the merit that counts as progress
_SOLVER = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}


def solve(problem: ObstacleProblem, *, progress: bool = False) -> Solutions:
    """The cheapest feasible path of each environment over several starts."""
    program = _Program.of(problem)
    return best_of_starts(problem, program.solve_from, progress)


@dataclass(frozen=True)
class _Program:
    """The quadratic program in positions p (T+1, 2), inputs u and slack, for one horizon and number of discs."""

    problem: Any
    positions: Any
    parameters: dict[str, Any]

    @classmethod
    def of(cls, problem: ObstacleProblem) -> _Program:
        """For problems of this horizon and number of discs."""
        import cvxpy as cp

        T, discs = problem.horizon, problem.radius.shape[1]
        p, v, u = cp.Variable((T + 1, 2)), cp.Variable((T + 1, 2)), cp.Variable((T, 2))
        root_weight, anchor = cp.Parameter((T + 1, 2), nonneg=True), cp.Parameter((T + 1, 2))
        x_init, reference, region = cp.Parameter(4), cp.Parameter((T + 1, 2)), cp.Parameter(nonneg=True)
        dt = problem.time_step
        constraints = [
            p[0] == x_init[:2],
            v[0] == x_init[2:],
            p[1:] == p[:-1] + dt * v[:-1],
            v[1:] == v[:-1] + dt * u,
            cp.abs(p[2:] - reference[2:]) <= region,
        ]
        cost = cp.sum_squares(cp.multiply(root_weight, p) - anchor) + problem.input_cost * cp.sum_squares(u)
        normals = [cp.Parameter((T - 1, 2)) for _ in range(discs)]
        offsets = [cp.Parameter(T - 1) for _ in range(discs)]
        for normal, offset in zip(normals, offsets, strict=True):
            slack = cp.Variable(T - 1, nonneg=True)
            constraints.append(cp.sum(cp.multiply(normal, p[2:]), axis=1) + slack >= offset)
            cost += _SLACK_PRICE * cp.sum(slack)
        named: dict[str, Any] = {"root_weight": root_weight, "anchor": anchor, "x_init": x_init, "reference": reference}
        named |= {"region": region, "normals": normals, "offsets": offsets}
        return cls(cp.Problem(cp.Minimize(cost), constraints), p, named)

    def solve_from(self, one: ObstacleProblem, start: np.ndarray) -> np.ndarray | None:
        """Positions (T+1, 2) of a local optimum of one environment (N = 1), or None."""
        root = np.sqrt(one.weight[0])[:, None]
        self.parameters["root_weight"].value = np.tile(root, (1, 2))
        self.parameters["anchor"].value = root * one.goal[0]
        self.parameters["x_init"].value = one.x_init[0]
        reference, region, merit = start, _REGION, _merit(one, start)
        for _ in range(_ITERATIONS):
            found = self._convexified(one, reference, region)
            if found is None:
                return None
            new = _merit(one, found)
            gained = new < merit - _GAIN * (1 + merit)
            if new <= merit:
                reference, merit = found, new
            if not gained:
                region *= _SHRINK
            if region < _SMALLEST:
                break
        return reference

    def _convexified(self, one: ObstacleProblem, reference: np.ndarray, region: float) -> np.ndarray | None:
        """The minimum with half-planes for discs around a reference path (T+1, 2)."""
        import cvxpy as cp

        self.parameters["reference"].value, self.parameters["region"].value = reference, region
        for j, (normal, offset) in enumerate(zip(self.parameters["normals"], self.parameters["offsets"], strict=True)):
            away = reference[2:] - one.centre[0, j]
            away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
            normal.value, offset.value = away, away @ one.centre[0, j] + one.radius[0, j]
        self.problem.solve(solver=cp.CLARABEL, **_SOLVER)
        return self.positions.value if self.problem.status in ("optimal", "optimal_inaccurate") else None


def _merit(one: ObstacleProblem, positions: np.ndarray) -> float:
    """Cost and the price of what lies inside discs."""
    path = positions[None]
    inside = np.maximum(one.penetration(path), 0).sum()
    return float(one.cost(path, one.inputs(path))[0] + _SLACK_PRICE * inside)

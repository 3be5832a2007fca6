"""Projections onto nonlinear dynamics, beside IPOPT on the same problems at equal cost, and the expert.

Plans of unseen quadrotors, T = 40: an optimum with noise on every entry, as the estimates of a reverse chain are.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.rows import Row
from dadiff.experts.ilqr import Metric, Tracking, solve
from dadiff.systems import PlanarQuadrotor, PlanarQuadrotors
from dadiff.tasks import Manoeuvre

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from oracles import ipopt

EQUAL = 1e-6
PLANS, SOLVED = 1000, 10


def seconds(function: Callable[[], object], repeats: int = 3) -> float:
    """Least processor seconds of some repeats."""
    used = []
    for _ in range(repeats):
        begin = time.process_time()
        function()
        used.append(time.process_time() - begin)
    return min(used)


def measure() -> list[Row]:
    """One sweep and all of them, a plan of a batch, by the metric; one plan alone; and one demonstration."""
    rng, task = np.random.default_rng(0), Manoeuvre(interpolation=PLANS, extrapolation=0)
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 1, rng)
    layout, optimum = robots.layout(task.horizon), cases.reference
    scale = optimum.std(axis=(0, 1)) + 0.1
    reference = optimum + 0.3 * scale * rng.standard_normal(optimum.shape)
    U = 0.3 * scale[:, None] * rng.standard_normal((layout.size, 20))
    plain, along = (
        Tracking(robots, Metric.diagonal(layout, scale**2, factor), reference, cases.x_init) for factor in (None, U)
    )
    alone = Tracking(robots.take([0]), plain.metric, reference[:1], cases.x_init[:1])
    cost, sweep = solve(plain).cost, of_a_sweep(plain)
    usual, best = (ipopt_milliseconds(robots, plain, cost, expand=expand) for expand in (False, True))
    lone = 1e3 * seconds(lambda: solve(alone, sweeps=1))
    named = "processor time, a plan"
    return [
        Row(f"one sweep onto quadrotors, {named}", sweep, "ms", "IPOPT as casadi calls it", usual),
        Row(f"one sweep onto quadrotors, {named}", sweep, "ms", "IPOPT, the graph written out", best),
        Row(f"all sweeps onto quadrotors, {named}", to_the_end(plain), "ms", "IPOPT, the graph written out", best),
        Row(f"one sweep onto quadrotors, 20 directions, {named}", of_a_sweep(along), "ms"),
        Row(f"one sweep onto quadrotors, {named}, alone", lone, "ms"),
        Row("one demonstration of a quadrotor, processor time", of_the_expert(), "ms"),
    ]


def of_a_sweep(problem: Tracking) -> float:
    """Milliseconds a plan, begun at plans that are feasible."""
    plans = solve(problem, sweeps=1).tau
    return 1e3 * seconds(lambda: solve(problem, plans, sweeps=1)) / PLANS


def to_the_end(problem: Tracking) -> float:
    """Milliseconds a plan."""
    return 1e3 * seconds(lambda: solve(problem), 1) / PLANS


def of_the_expert(each: int = 10) -> float:
    """Milliseconds a demonstration."""
    few = Manoeuvre(robots=PLANS // each)
    return 1e3 * seconds(lambda: few.demonstrations(PlanarQuadrotors(), each, np.random.default_rng(1)), 1) / PLANS


def ipopt_milliseconds(robots: PlanarQuadrotor, problem: Tracking, cost: np.ndarray, *, expand: bool) -> float:
    """The median of IPOPT on the first plans.

    Args:
        expand: whether casadi's graph is written out first; casadi does not, unless told.

    Raises:
        RuntimeError: if it finds another cost.
    """
    W, solved = np.diag(problem.metric.times(np.ones(problem.layout.size))), []
    for k in range(SOLVED):
        gains = {name: float(getattr(robots, name)[k]) for name in ("thrust_gain", "torque_gain", "drag")}
        robot, given = PlanarQuadrotor(**gains), (problem.reference[k, 0], problem.x_init[k, 0])
        solved.append(ipopt(robot, problem.layout, W, *given, expand=expand))
    costs, taken = np.array(solved).T
    if (apart := np.abs(cost[:SOLVED, 0] / costs - 1).max()) > EQUAL:
        raise RuntimeError(f"bench nonlinear: costs are {apart:.1e} apart; expected {EQUAL:g} at most")
    return float(1e3 * np.median(taken))

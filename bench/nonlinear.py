"""How fast plans are projected onto nonlinear dynamics, beside IPOPT on the same problems, and how fast the expert is.

    OMP_NUM_THREADS=1 python -m bench.nonlinear [plans] [oracle_plans]

On one thread, in processor time, since others may use the machine; the least of three. Plans of unseen quadrotors,
T = 40: an optimum with noise on every entry, as the estimates of a reverse chain are.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dadiff.experts.ilqr import Metric, Tracking, solve
from dadiff.systems import PlanarQuadrotor, PlanarQuadrotors
from dadiff.tasks import Manoeuvre

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from oracles import ipopt


def seconds(function: Callable[[], object], repeats: int = 3) -> float:
    """Least processor seconds of some repeats."""
    used = []
    for _ in range(repeats):
        begin = time.process_time()
        function()
        used.append(time.process_time() - begin)
    return min(used)


def main(count: int = 1000, oracle_count: int = 20) -> None:
    """Print the figures."""
    rng = np.random.default_rng(0)
    task = Manoeuvre(interpolation=count, extrapolation=0)
    robots = task.target(PlanarQuadrotors())
    cases = task.cases(robots, 1, rng)
    layout, optimum = robots.layout(task.horizon), cases.reference
    scale = optimum.std(axis=(0, 1)) + 0.1
    reference = optimum + 0.3 * scale * rng.standard_normal(optimum.shape)
    factor = 0.3 * scale[:, None] * rng.standard_normal((layout.size, 20))
    for name, U in (("diagonal", None), ("diagonal and 20 directions", factor)):
        problem = Tracking(robots, Metric.diagonal(layout, scale**2, U), reference, cases.x_init)
        plans = solve(problem, sweeps=1).tau
        each = seconds(lambda problem=problem, plans=plans: solve(problem, plans, sweeps=1)) / count
        print(f"one sweep, metric {name}: {1e3 * each:.3f} ms a plan in a batch of {count}")
        found = solve(problem)
        whole = seconds(lambda problem=problem: solve(problem), 1) / count
        share = found.converged.mean()
        print(f"  to the end: {found.sweeps.mean():.1f} sweeps, {1e3 * whole:.2f} ms; {share:.1%} converge")
        if U is None:
            compare(robots, problem, found.cost, oracle_count, each, whole)
    alone = task.target(PlanarQuadrotors()).take([0])
    problem = Tracking(alone, Metric.diagonal(layout, scale**2), reference[:1], cases.x_init[:1])
    print(f"one sweep of one plan alone: {1e3 * seconds(lambda: solve(problem, sweeps=1)):.1f} ms")
    family, each = PlanarQuadrotors(), 10
    few = Manoeuvre(robots=count // each)
    expert = seconds(lambda: few.demonstrations(family, each, np.random.default_rng(1)), 1) / count
    print(f"expert: {1e3 * expert:.2f} ms a demonstration, {1e4 * expert:.0f} s for 10,000")


def compare(
    robots: PlanarQuadrotor, problem: Tracking, cost: np.ndarray, count: int, each: float, whole: float
) -> None:
    """IPOPT on the first plans: with casadi's graph written out, and as casadi does it unless told otherwise.

    Args:
        each, whole: seconds of a sweep, and of as many as are needed, a plan.
    """
    metric, layout = problem.metric, problem.layout
    W = np.diag(metric.times(np.ones(layout.size)))
    for expand in (True, False):
        solved = []
        for k in range(count):
            gains = (float(value[k]) for value in (robots.thrust_gain, robots.torque_gain, robots.drag))
            robot = PlanarQuadrotor(**dict(zip(("thrust_gain", "torque_gain", "drag"), gains, strict=True)))
            solved.append(ipopt(robot, layout, W, problem.reference[k, 0], problem.x_init[k, 0], expand=expand))
        costs, taken = np.array(solved).T
        apart, slow = np.abs(cost[:count, 0] / costs - 1).max(), np.median(taken)
        how = "written out" if expand else "as it comes"
        print(f"  ipopt, {how}: median {1e3 * slow:.1f} ms, as long as {slow / each:.0f} sweeps a plan, or as")
        print(f"    {slow / whole:.1f} plans to the end; costs apart {apart:.1e}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))

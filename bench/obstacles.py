"""How fast the batched obstacle expert is, and how good: 10,000 default environments, and IPOPT on the first of them.

    OMP_NUM_THREADS=1 python bench/obstacles.py [environments] [oracle_environments] [repeats]

Everything is measured in one run on one thread. The figures to compare are the ratios, of processor time, as others may
use the machine; seconds depend on it. The time of a batch is the least of the repeats.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

from dadiff.experts.obstacles import batched, ipopt
from dadiff.experts.obstacles.problem import ObstacleProblem, Solutions
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.tasks.obstacles import Obstacles


def timed(
    solve: Callable[[ObstacleProblem], Solutions], problem: ObstacleProblem, repeats: int = 1
) -> tuple[Solutions, float, float]:
    """Solutions, and the least processor and wall-clock seconds of some repeats."""
    used, elapsed = [], []
    for _ in range(repeats):
        begin = time.process_time(), time.perf_counter()
        found = solve(problem)
        used.append(time.process_time() - begin[0])
        elapsed.append(time.perf_counter() - begin[1])
    return found, min(used), min(elapsed)


def main(count: int = 10_000, oracle_count: int = 50, repeats: int = 2) -> None:
    """Print the figures."""
    task = Obstacles()
    environments, _ = task.distribution_for(0.1).sample(count, np.random.default_rng(0))
    problem = task.problem(environments, 0.1)
    first = problem.take(np.arange(oracle_count))
    batched.solve(first)  # compiles, or loads machine code
    found, seconds, elapsed = timed(batched.solve, problem, repeats)
    _, alone_seconds, _ = timed(batched.solve, first, repeats)
    single = [timed(batched.solve, problem.take(np.array([i])), repeats)[1] for i in range(oracle_count)]
    oracle, oracle_seconds, _ = timed(ipopt.solve, first)
    each, oracle_each = seconds / count, oracle_seconds / oracle_count
    ratio = found.cost[:oracle_count] / oracle.cost
    best = np.minimum(found.cost[:oracle_count], oracle.cost)
    unsolved = int((~found.solved).sum())
    print(f"batched: {count} environments in {elapsed:.1f} s ({seconds:.1f} s of processor time), unsolved {unsolved}")
    print(f"  obstacle-free optimum in the way of a disc: {(~problem.feasible(obstacle_free(problem))).mean():.1%}")
    print(f"  one environment alone: median {1e3 * np.median(single):.1f} ms, slowest {1e3 * max(single):.1f} ms")
    print(f"ipopt: {oracle_each:.3f} s an environment over its starts, unsolved {int((~oracle.solved).sum())}")
    print(f"faster than ipopt, per environment, in the large batch: {oracle_each / each:.0f} times")
    print(f"faster than ipopt, the same {oracle_count} environments alone: {oracle_seconds / alone_seconds:.0f} times")
    print(
        f"cost ratio to ipopt's best: median {np.median(ratio):.6f}, worst {ratio.max():.4f}, least {ratio.min():.4f}"
    )
    print(f"within 1 % of the best of both: {(found.cost[:oracle_count] <= 1.01 * best).mean():.1%}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))

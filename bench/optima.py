"""The obstacle expert: ten thousand optima, against IPOPT from many starts. One thread; the peer solves fewer."""

from __future__ import annotations

import numpy as np

from bench.rows import Row, least, seconds
from dadiff.experts.obstacles import batched, ipopt
from dadiff.tasks.obstacles import Obstacles

COUNT, PEER_COUNT = 10_000, 10


def measure() -> list[Row]:
    """The rows; costs must agree, or a ratio of times means nothing."""
    task = Obstacles()
    environments, _ = task.distribution_for(0.1).sample(COUNT, np.random.default_rng(0))
    problem = task.problem(environments, 0.1)
    few, one = problem.take(np.arange(PEER_COUNT)), problem.take(np.arange(1))
    batched.solve(one)  # which compiles
    ours, (alone,) = seconds(lambda: batched.solve(problem)), least(lambda: batched.solve(one))
    found, oracle = batched.solve(few), []
    peer = seconds(lambda: oracle.append(ipopt.solve(few))) / PEER_COUNT
    excess = float(np.median(found.cost / oracle[0].cost) - 1)
    if abs(excess) > 1e-3:
        raise ArithmeticError(f"obstacle optima: costs differ from IPOPT's by {excess:.1e} in the median")
    return [
        Row("10,000 obstacle optima", ours, "s", "IPOPT from many starts", peer * COUNT),
        Row("one obstacle optimum", 1e3 * alone, "ms", "IPOPT from many starts", 1e3 * peer),
    ]

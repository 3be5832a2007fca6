"""One plan at a time, on one thread: processor time of the median plan, beside what computes the optimum itself.

The networks are untrained, which takes as long as trained ones. `few` are 5 calls, the plan as users get it: the
condition, the projection bound to its x(0), the chain with `conditional`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from bench.rows import Row
from dadiff.behaviours import Known
from dadiff.denoisers import MLP, EncoderDecoder
from dadiff.denoisers.encoded import EncodedDenoiser
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.samplers import DPMSolver
from dadiff.diffusion.schedule import cosine, paper_linear
from dadiff.experts.bounded import Costs, optimum_within
from dadiff.experts.lqr import follow
from dadiff.experts.obstacles import batched, ipopt
from dadiff.planning import Planner
from dadiff.randomness import torch_generator
from dadiff.systems import double_integrator
from dadiff.systems.system import Bounds
from dadiff.tasks import LQR
from dadiff.tasks.encodings import PathFrame
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory.coordinates import physical

CALLS, FEWER = 5, 3
DEMONSTRATIONS, PLANS = 200, 100
SYSTEM = double_integrator()


def median(*actions: Callable[[], object], repeats: int = PLANS) -> list[float]:
    """Milliseconds of the processor that each action takes in the median, in turn, after one that is not counted."""
    taken = np.empty((repeats + 1, len(actions)))
    for k in range(repeats + 1):
        for j, action in enumerate(actions):
            begun = time.process_time()
            action()
            taken[k, j] = 1e3 * (time.process_time() - begun)
    return np.median(taken[1:], axis=0).tolist()


def each(solve: Callable[[int], object], more: int = 10) -> float:
    """Milliseconds for each of k problems beyond the first, so that what is set up once is not counted."""
    one, many = median(lambda: solve(1), lambda: solve(1 + more), repeats=3)
    return (many - one) / more


def lqr_planner(recipe: Recipe) -> Planner:
    """Of the default task and robot."""
    task, layout, schedule = LQR(), SYSTEM.layout(LQR().horizon), paper_linear()
    shown = task.demonstrations(SYSTEM, DEMONSTRATIONS, np.random.default_rng(0))
    denoiser = recipe.build(layout, task.condition(SYSTEM), schedule, torch_generator(0, "bench"))
    where, known = physical(layout), Known("fixed").fit(layout, SYSTEM)
    estimate = Estimate.of_demonstrations(layout, where, shown.trajectories, shown.environment)
    return Planner(
        task, SYSTEM, schedule, DPMSolver(CALLS), denoiser, where, known, Conditional(), True, estimate=estimate
    )


def obstacle_planner() -> Planner:
    """As `task=obstacles` has it: a network that is told of obstacles as seen from the obstacle-free optimum."""
    task, schedule = Obstacles(), cosine()
    layout, encoder = SYSTEM.layout(task.horizon), PathFrame().encoder(task, SYSTEM)
    network = MLP().build(layout, encoder.layout, schedule, torch_generator(0, "bench"))
    denoiser = EncodedDenoiser(network, encoder, physical(layout), schedule)
    return Planner(task, SYSTEM, schedule, DPMSolver(CALLS), denoiser, physical(layout))


def steering() -> list[Row]:
    """Plans of the default task beside its optima: known gains, the Riccati recursion, a program within |u| <= 4."""
    small, paper, task = lqr_planner(MLP()), lqr_planner(EncoderDecoder()), LQR()
    E = task.sample_environments(SYSTEM, (1,), np.random.default_rng(0))
    ends, feedback = task.condition(SYSTEM).unpack(E), task.feedback(SYSTEM)
    cost, bounded = task.cost(SYSTEM), replace(SYSTEM, bounds=Bounds(-4.0, 4.0))
    weights = Costs(cost.Q, cost.R, cost.terminal)
    fewer = replace(small, sampler=DPMSolver(FEWER))
    with_gains, riccati, one, three, whole = median(
        lambda: follow(SYSTEM, feedback, ends["x_init"], ends["target"]),
        lambda: task.solve(SYSTEM, E),
        lambda: small.plan(E),
        lambda: fewer.plan(E),
        lambda: paper.plan(E),
    )
    clarabel = each(
        lambda k: optimum_within(bounded, weights, task.horizon, *(np.repeat(v, k, 0) for v in ends.values()))
    )
    plan, of_the_paper = "one plan, mlp, processor time", "one plan, paper's network, processor time"
    return [
        Row(f"{plan}, {CALLS} calls", one, "ms", "the optimum, gains known", with_gains),
        Row(f"{plan}, {CALLS} calls", one, "ms", "the optimum, Riccati recursion", riccati),
        Row(f"{plan}, {CALLS} calls", one, "ms", "the optimum within |u| <= 4, Clarabel", clarabel),
        Row(f"{plan}, {FEWER} calls", three, "ms", "the optimum, Riccati recursion", riccati),
        Row(f"{of_the_paper}, {CALLS} calls", whole, "ms", "the optimum, Riccati recursion", riccati),
    ]


def avoiding() -> list[Row]:
    """Plans among obstacles beside the local optima that experts find."""
    task, planner = Obstacles(), obstacle_planner()
    environments, _ = task.distribution_for(SYSTEM.time_step or 0.1).sample(1, np.random.default_rng(0))
    problem = task.problem(environments, SYSTEM.time_step or 0.1)
    E = task.cases(SYSTEM, 1, np.random.default_rng(0)).environment
    one, expert = median(lambda: planner.plan(E), lambda: batched.solve(problem), repeats=30)
    peer = each(lambda k: ipopt.solve(problem.take(np.zeros(k, dtype=int))))
    name = f"one plan among obstacles, mlp, processor time, {CALLS} calls"
    return [
        Row(name, one, "ms", "the expert of the demonstrations", expert),
        Row(name, one, "ms", "IPOPT from many starts", peer),
    ]


def measure() -> list[Row]:
    """The rows."""
    torch.set_num_threads(1)
    return [*steering(), *avoiding()]

"""Sampling: one plan's latency, a thousand plans, the paper's chain against a plain one, a fleet against one robot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from bench.learning import CONDITION, LAYOUT, SCHEDULE
from bench.peers import ConvolutionNetwork, ancestral_chain
from bench.rows import Row, least
from dadiff.behaviours import Known, Pin, Projection
from dadiff.denoisers import MLP, EncoderDecoder
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.chain import sample
from dadiff.diffusion.enforcement import Normalised
from dadiff.diffusion.samplers import DDPM, DPMSolver, Sampler
from dadiff.randomness import torch_generator
from dadiff.systems import DampedIntegrators, double_integrator

PEER_STEPS = 20


def drawing(recipe: Recipe, sampler: Sampler, shape: tuple[int, ...], projection: Projection) -> Callable[[], object]:
    """A draw of plans by an untrained network, which takes as long as a trained one."""
    denoiser = recipe.build(LAYOUT, CONDITION, SCHEDULE, torch_generator(0, "bench"))
    environment = torch.zeros(*shape[:-1], CONDITION.size, dtype=torch.float64)
    noise = torch_generator(0, "noise")
    return lambda: sample(sampler, SCHEDULE, denoiser, environment, shape, noise, projection, Normalised())


def fixed(robots: int, plans: int) -> tuple[tuple[int, ...], Projection]:
    """The shape of plans shared by robots, and the projection onto their dynamics with x(0) held."""
    rng = np.random.default_rng(0)
    system = DampedIntegrators().inside(robots, rng)
    x_init = rng.uniform(-1, 1, (robots, plans // robots, system.state_dim))
    bound = Known("fixed").fit(LAYOUT, system).bind(pins=[Pin.initial_state(LAYOUT, x_init)], device="cpu")
    return (robots, plans // robots, LAYOUT.size), bound


def latency() -> list[Row]:
    """One plan, and a thousand."""
    free = Known().fit(LAYOUT, double_integrator()).bind(device="cpu")
    few, many = (drawing(MLP(), DPMSolver(calls), (1, LAYOUT.size), free) for calls in (3, 10))
    whole = drawing(MLP(), DDPM(), (1, LAYOUT.size), free)
    thousand = drawing(MLP(), DPMSolver(10), (1000, LAYOUT.size), free)
    thousand_whole = drawing(MLP(), DDPM(), (1000, LAYOUT.size), free)
    a, b, c = least(few, many, whole)
    d, e = least(thousand, thousand_whole, repeats=1)
    return [
        Row("one plan, mlp, dpm_solver, 3 calls", 1e3 * a, "ms", "ddpm, 175 calls", 1e3 * c),
        Row("one plan, mlp, dpm_solver, 10 calls", 1e3 * b, "ms", "ddpm, 175 calls", 1e3 * c),
        Row("1,000 plans, mlp, dpm_solver, 10 calls", d, "s", "ddpm, 175 calls", e),
    ]


def chains(plans: int = 64) -> list[Row]:
    """The paper's chain with the paper's network: ours against a call at every step; the peer's time is scaled up."""
    projection = Known().fit(LAYOUT, double_integrator()).bind(device="cpu")
    P = projection(torch.eye(LAYOUT.size, dtype=torch.float64)).float()
    network, environment = ConvolutionNetwork(LAYOUT, CONDITION.size), torch.zeros(plans, CONDITION.size)
    ours = drawing(EncoderDecoder(), DDPM(), (plans, LAYOUT.size), projection)
    a, b = least(ours, lambda: ancestral_chain(network, SCHEDULE, P, environment, PEER_STEPS), repeats=1)
    peer = b * SCHEDULE.num_steps / PEER_STEPS
    return [Row(f"{plans} plans, paper's network and chain", a, "s", "a plain chain with 1,000 calls", peer)]


def fleets(plans: int = 2000) -> list[Row]:
    """As many plans for twenty robots as for one."""
    one, many = (drawing(MLP(), DPMSolver(10), *fixed(robots, plans)) for robots in (1, 20))
    a, b = least(one, many)
    return [Row(f"{plans} plans of 20 robots, x(0) held", b, "s", "one robot", a)]


def measure() -> list[Row]:
    """The rows."""
    return [*latency(), *chains(), *fleets()]

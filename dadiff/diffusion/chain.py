"""The reverse chain: from noise tau_L to a plan tau_0 (Algorithms 1 and 2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from tqdm import tqdm

from dadiff.diffusion.enforcement import Enforcement, Project
from dadiff.diffusion.samplers import Sampler
from dadiff.diffusion.schedule import Schedule

Tensor = torch.Tensor
Denoise = Callable[[Tensor, int, Tensor], Tensor]
Stage = Literal["predict", "project", "end"]
Observe = Callable[[int, Stage, Tensor], None]


@dataclass(frozen=True)
class Samples:
    """What a run of the chain gives.

    Args:
        tau: plans (*robots, ..., d) in the sampler's coordinates.
        network_calls: how often the denoiser was called.
        diverged_at: the step at which a value left the bound or float range, 0 for the end; or None.
    """

    tau: Tensor
    network_calls: int
    diverged_at: int | None = None


@torch.inference_mode()
def sample(
    sampler: Sampler,
    schedule: Schedule,
    denoise: Denoise,
    environment: Tensor,
    shape: tuple[int, ...],
    generator: torch.Generator,
    project: Project | None = None,
    enforcement: Enforcement | None = None,
    observe: Observe | None = None,
    divergence_bound: float = 1e6,
    progress: bool = False,
) -> Samples:
    """Algorithm 1 (and 2): predict, then project, from i = L to 1.

    Args:
        denoise: (tau_i, i, E) -> tau0_hat, of the shape of tau_i.
        environment: E (..., c), aligned with the plans; its device is where the chain runs.
        shape: (*robots, ..., d) of the plans.
        generator: of all noise; on the CPU, so that the same seed gives the same noise on every device.
        project, enforcement: P and where it acts; None for vanilla diffusion.
        observe: is shown the sample after each prediction, after each projection, and after the end's.
        divergence_bound: the chain stops once max |tau| exceeds it.
        progress: show a progress bar.

    Returns:
        float64 plans; the chain as it stood if it diverged.
    """

    def noise() -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(environment.device)

    tau, calls = noise(), 0
    for step in tqdm(
        sampler.steps(schedule), desc="sampling", unit="step", disable=None if progress else True, leave=False
    ):
        mean = step.sample * tau
        if step.call:
            tau0_hat, calls = denoise(tau, step.i, environment), calls + 1
            if project and enforcement:
                tau0_hat = enforcement.clean(tau0_hat, project, schedule, step.j)
            mean = mean + step.clean * tau0_hat
        tau = mean + step.noise * noise() if step.noise else mean
        if observe:
            observe(step.j, "predict", tau)
        if project and enforcement:
            tau = enforcement.sample(tau, project, schedule, step.j)
        if observe:
            observe(step.j, "project", tau)
        if not tau.abs().max() <= divergence_bound:
            return Samples(tau, calls, diverged_at=step.i)
    if project and enforcement:
        tau = enforcement.end(tau, project)
        if observe:
            observe(0, "end", tau)
    return Samples(tau, calls, diverged_at=None if tau.abs().max() <= divergence_bound else 0)

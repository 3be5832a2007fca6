"""The reverse chain: from noise tau_L to a plan tau_0 (Algorithms 1 and 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tqdm import tqdm

from dadiff.diffusion.context import Context, Counted, Denoise, Project, unprojected
from dadiff.diffusion.enforcement import Enforcement, Never
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.samplers import Sampler, Step
from dadiff.diffusion.schedule import Schedule
from dadiff.diffusion.silence import begin

Tensor = torch.Tensor
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


@dataclass(frozen=True)
class Start:
    """A guess of the plans, such as the last ones moved on; the chain begins where it is noised to a given signal.

    Args:
        tau: the guess, of the plans' shape, in the sampler's coordinates.
        signal: alpha_bar of the first step that is taken, at least.
    """

    tau: Tensor
    signal: float = 0.5

    def noised(self, steps: list[Step], schedule: Schedule, noise: Callable[[], Tensor]) -> tuple[Tensor, list[Step]]:
        """tau_i = sqrt(alpha_bar_i) tau + sqrt(1 - alpha_bar_i) eps, and the steps from i on; at least the last one."""
        left = [step for step in steps if schedule.alpha_bar[step.i] >= self.signal] or steps[-1:]
        alpha_bar = float(schedule.alpha_bar[left[0].i])
        return alpha_bar**0.5 * self.tau + (1 - alpha_bar) ** 0.5 * noise(), left


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
    estimate: Estimate | None = None,
    start: Start | None = None,
) -> Samples:
    """Algorithm 1 (and 2, which differ in P): predict, then project, from i = L to 1.

    Args:
        denoise: (tau_i, i, E) -> tau0_hat, of the shape of tau_i.
        environment: E (..., c), aligned with the plans; its device is where the chain runs.
        shape: (*robots, ..., d) of the plans.
        generator: of all noise; on the CPU, so that the same seed gives the same noise on every device.
        project, enforcement: P and where it acts; None for vanilla diffusion.
        observe: is shown the sample after each prediction, after each projection, and after the end's; of leading
            steps without a call that were drawn as one, what they end with.
        divergence_bound: the chain stops once max |tau| exceeds it.
        progress: show a progress bar.
        estimate: how uncertain the clean estimate is, for enforcements that weigh by it.
        start: what to begin from instead of noise.

    Returns:
        float64 plans; the chain as it stood if it diverged.
    """

    def noise() -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).to(environment.device)

    by = enforcement if enforcement and project else Never()
    ask, memory = Counted(denoise), dict[str, Any]()
    planned = [by.weights(step, schedule) for step in sampler.steps(schedule)]
    steps: Sequence[Step]
    if start:
        tau, steps = start.noised(planned, schedule, noise)
    else:  # line 1: tau_L ~ N(0, I)
        tau, steps = begin(planned, schedule, noise, project or unprojected, by)
    if observe and steps[0].i < schedule.num_steps:
        observe(steps[0].i, "project", tau)
    tau0_hat = start.tau if start else torch.zeros_like(tau)
    shown = tqdm(steps, desc="sampling", unit="step", disable=None, leave=False) if progress else steps
    for step in shown:  # line 2: for i = L, ..., 1
        at = Context(step, schedule, tau, environment, project or unprojected, ask, noise, estimate, memory)
        predicted, tau0_hat = predict(at, by, tau0_hat)
        if observe:
            observe(step.j, "predict", predicted)
        tau = by.sample(predicted, at)  # line 5: project
        if observe:
            observe(step.j, "project", tau)
        if not tau.abs().max() <= divergence_bound:
            return Samples(tau, ask.calls, diverged_at=step.i)
    tau = by.end(tau, at)  # line 6: tau_0
    if observe:
        observe(0, "end", tau)
    return Samples(tau, ask.calls, diverged_at=None if tau.abs().max() <= divergence_bound else 0)


def predict(at: Context, by: Enforcement, before: Tensor) -> tuple[Tensor, Tensor]:
    """Lines 3 and 4 of Algorithm 1 at one step: tau_j before it is projected, and the clean estimate that it rests on.

    Args:
        before: the clean estimate of the step before, which multistep samplers use and steps without a call pass on.
    """
    step, mean, tau0_hat = at.step, at.step.sample * at.tau, before
    if step.call:  # line 3: the clean estimate from tau_i, i and E, and the mean that follows from it
        tau0_hat = by.clean(at.denoise(at.tau, step.i, at.environment), at)
        mean = mean + step.clean * tau0_hat + step.previous * before
    return mean + step.noise * at.noise() if step.noise else mean, tau0_hat  # line 4: predict

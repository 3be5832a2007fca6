"""Samplers: with which weights a reverse step combines the clean estimate, the sample and fresh noise.

`dadiff.diffusion.chain` runs them all in one loop. Written with the clean estimate, the reverse mean is finite
everywhere, also where alpha_bar_L = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import prod, sqrt
from typing import Literal, Protocol

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError


@dataclass(frozen=True)
class Step:
    """tau_j = clean * tau0_hat + sample * tau_i + noise * eps, from step i down to step j < i.

    Args:
        call: False where the clean estimate's weight is negligible and the network is not called.
    """

    i: int
    j: int
    clean: float
    sample: float
    noise: float
    call: bool = True


class Sampler(Protocol):
    """The steps from L to 0."""

    def steps(self, schedule: Schedule) -> list[Step]: ...


@dataclass(frozen=True)
class DDPM:
    """Ancestral sampling, the paper's: tau_{i-1} = mu_q(tau_i, tau0_hat) + sigma_i eps.

        mu_q = sqrt(alpha_bar_{i-1}) beta_i / (1 - alpha_bar_i) tau0_hat
             + sqrt(alpha_i) (1 - alpha_bar_{i-1}) / (1 - alpha_bar_i) tau_i

    Args:
        last_step_noise: as in Algorithm 1, which adds sqrt(beta_1) eps to the final plan too.
        variance: sigma_i^2 is beta_i (the paper's) or the posterior's beta_i (1 - alpha_bar_{i-1}) / (1 - alpha_bar_i).
        skip_below: bound on the total weight of the clean estimates that are not computed: the sample at the first
            call differs by at most skip_below * max |tau0_hat|_2, projected or not. 0 leaves out calls of no weight.
    """

    last_step_noise: bool = True
    variance: Literal["beta", "posterior"] = "beta"
    skip_below: float = 3e-4

    def __post_init__(self) -> None:
        if not 0 <= self.skip_below < 1:
            raise ConfigError(f"sampler: skip_below is {self.skip_below}; it is a weight in [0, 1)")

    def steps(self, schedule: Schedule) -> list[Step]:
        """L steps, one for each i = L..1."""
        steps = [self._step(schedule, i) for i in range(schedule.num_steps, 0, -1)]
        return _skip(steps, self.skip_below)

    def _step(self, schedule: Schedule, i: int) -> Step:
        beta, alpha, alpha_bar, previous = (
            schedule.beta[i],
            schedule.alpha[i],
            schedule.alpha_bar[i],
            schedule.alpha_bar[i - 1],
        )
        clean = sqrt(previous) * beta / (1 - alpha_bar)
        sample = sqrt(alpha) * (1 - previous) / (1 - alpha_bar)
        variance = beta if self.variance == "beta" else beta * (1 - previous) / (1 - alpha_bar)
        noise = sqrt(variance) if i > 1 or self.last_step_noise else 0.0
        return Step(i, i - 1, clean, sample, noise)


@dataclass(frozen=True)
class DDIM:
    """Song, Meng & Ermon (2021): from step i to any j < i, deterministic for eta = 0.

    sigma^2 = eta^2 (1 - alpha_bar_j) / (1 - alpha_bar_i) (1 - alpha_bar_i / alpha_bar_j)

    Args:
        num_steps: how many of the L steps are visited, evenly spaced.
        eta: 0 is deterministic; 1 with all steps is `DDPM` with the posterior's variance.
    """

    num_steps: int = 50
    eta: float = 0.0

    def __post_init__(self) -> None:
        if self.num_steps < 1 or not 0 <= self.eta <= 1:
            raise ConfigError(f"sampler: num_steps is {self.num_steps} and eta {self.eta}; need >= 1 and in [0, 1]")

    def steps(self, schedule: Schedule) -> list[Step]:
        """min(num_steps, L) steps."""
        L = schedule.num_steps
        count = min(self.num_steps, L)
        visited = [round(L * k / count) for k in range(count, -1, -1)]
        return [self._step(schedule, i, j) for i, j in pairwise(visited)]

    def _step(self, schedule: Schedule, i: int, j: int) -> Step:
        alpha_bar, next_bar = schedule.alpha_bar[i], schedule.alpha_bar[j]
        between = prod(schedule.alpha[j + 1 : i + 1])  # alpha_bar_i / alpha_bar_j, where both may underflow
        variance = self.eta**2 * (1 - next_bar) / (1 - alpha_bar) * (1 - between)
        sample = sqrt(max(1 - next_bar - variance, 0)) / sqrt(1 - alpha_bar)
        return Step(i, j, sqrt(next_bar) - sample * sqrt(alpha_bar), sample, sqrt(variance))


def _skip(steps: list[Step], bound: float) -> list[Step]:
    """Mark the leading steps whose clean estimates enter the sample with a total weight of at most `bound`.

    After steps 1..k that weight is W_k = sample_k W_{k-1} + clean_k. It ends at 1, above any bound: the last step's
    mean is the clean estimate.
    """
    weight = 0.0
    for k, step in enumerate(steps):
        weight = step.sample * weight + step.clean
        if weight > bound:
            return [replace(skipped, call=False) for skipped in steps[:k]] + steps[k:]
    return steps


def skipped_weight(steps: list[Step]) -> float:
    """The weight W of skipped clean estimates: the sample at the first call is off by at most W max |tau0_hat|."""
    weight = 0.0
    for step in steps:
        if step.call:
            return weight
        weight = step.sample * weight + step.clean
    return weight

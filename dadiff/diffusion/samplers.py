"""Samplers: with which weights a reverse step combines clean estimates, the sample and fresh noise.

`dadiff.diffusion.chain` runs them all in one loop. Written with the clean estimate, the reverse mean is finite
everywhere, also where alpha_bar_L = 0. DDPM visits every step; DDIM and DPMSolver visit few, and where these lie
(`visited`) decides more than how many there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isinf, prod, sqrt
from typing import Literal, Protocol

import numpy as np

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError

Spacing = Literal["uniform", "log_snr"]

LEAST_SIGNAL = 1e-3  # alpha_bar below which tau_i says next to nothing of tau_0, beyond its mean


@dataclass(frozen=True)
class Step:
    """tau_j = clean * tau0_hat + previous * tau0_hat' + sample * tau_i + noise * eps, from step i down to step j < i.

    Args:
        previous: weight of the clean estimate tau0_hat' of the step before; 0 for a method of one step.
        call: False where the clean estimate's weight is negligible and the network is not called.
    """

    i: int
    j: int
    clean: float
    sample: float
    noise: float
    previous: float = 0.0
    call: bool = True


class Sampler(Protocol):
    """The steps from L to 0."""

    def steps(self, schedule: Schedule) -> list[Step]: ...


@dataclass(frozen=True)
class Listed:
    """Steps that another sampler has worked out, for chains that are run again and again."""

    listed: list[Step]

    def steps(self, schedule: Schedule) -> list[Step]:
        """As they are."""
        return self.listed


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
            The steps without a call are linear and Gaussian, and are drawn as one (`dadiff.diffusion.silence`).
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
        num_steps: how many of the L steps are visited, each with one call.
        eta: 0 is deterministic; 1 with all steps is `DDPM` with the posterior's variance.
        spacing: where they lie, see `visited`.
    """

    num_steps: int = 50
    eta: float = 0.0
    spacing: Spacing = "uniform"

    def __post_init__(self) -> None:
        _check_few(self.num_steps, self.eta)

    def steps(self, schedule: Schedule) -> list[Step]:
        """At most num_steps steps."""
        chosen = visited(schedule, self.num_steps, self.spacing)
        return [_first_order(schedule, i, j, self.eta) for i, j in pairwise(chosen)]


@dataclass(frozen=True)
class DPMSolver:
    """DPM-Solver++(2M) of Lu et al. (2022): `DDIM` with the clean estimate extrapolated from its last two values.

    With lambda = log(alpha_bar / (1 - alpha_bar)) / 2, a step h = lambda_j - lambda_i after one of h':

        D = tau0_hat + h / (2 h') (tau0_hat - tau0_hat')

    takes the place of tau0_hat, which makes the error of second order in h. The first step and the last, which are
    infinitely long, remain of first order.

    Args:
        num_steps: how many of the L steps are visited, each with one call.
        eta: 0 is deterministic; 1 is SDE-DPM-Solver++.
        spacing: where they lie, see `visited`.
    """

    num_steps: int = 10
    eta: float = 0.0
    spacing: Spacing = "log_snr"

    def __post_init__(self) -> None:
        _check_few(self.num_steps, self.eta)

    def steps(self, schedule: Schedule) -> list[Step]:
        """At most num_steps steps."""
        chosen = visited(schedule, self.num_steps, self.spacing)
        steps = [_first_order(schedule, i, j, self.eta) for i, j in pairwise(chosen)]
        return steps[:1] + [_second_order(schedule, before, step) for before, step in pairwise(steps)]


def visited(schedule: Schedule, count: int, spacing: Spacing) -> list[int]:
    """The steps L = i_1 > i_2 > ... > 0 that a sampler with at most `count` calls visits.

    `uniform` spaces them evenly in i. `log_snr` goes from L, where the clean estimate is the mean, straight to the
    step where alpha_bar reaches `LEAST_SIGNAL`, and from there to step 1 evenly in log(alpha_bar / (1 - alpha_bar)).
    Neither visits a step twice, so that there may be fewer than `count`.
    """
    L = schedule.num_steps
    if spacing == "uniform":
        number = min(count, L)
        return [round(L * k / number) for k in range(number, -1, -1)]
    first = int(np.flatnonzero(schedule.alpha_bar[:L] >= LEAST_SIGNAL)[-1])
    if count == 1 or first == 0:
        return [L, 0]
    level = schedule.half_log_snr[1 : first + 1]
    number = min(count - 1, first)
    wanted = np.linspace(level[-1], level[0], number) if number > 1 else np.zeros(1)
    nearest = np.abs(level - wanted[:, None]).argmin(axis=1) + 1
    return [L, *_distinct(nearest.tolist(), first), 0]


def _distinct(falling: list[int], largest: int) -> list[int]:
    """Steps moved up to be distinct, within 1..largest."""
    apart = np.arange(len(falling))[::-1]
    raised = np.maximum.accumulate((np.array(falling) - apart)[::-1])[::-1] + apart
    return np.minimum(raised, largest - apart[::-1]).tolist()


def _check_few(num_steps: int, eta: float) -> None:
    if num_steps < 1 or not 0 <= eta <= 1:
        raise ConfigError(f"sampler: num_steps is {num_steps} and eta {eta}; need >= 1 and in [0, 1]")


def _first_order(schedule: Schedule, i: int, j: int, eta: float) -> Step:
    alpha_bar, next_bar = schedule.alpha_bar[i], schedule.alpha_bar[j]
    between = prod(schedule.alpha[j + 1 : i + 1])  # alpha_bar_i / alpha_bar_j, where both may underflow
    variance = eta**2 * (1 - next_bar) / (1 - alpha_bar) * (1 - between)
    sample = sqrt(max(1 - next_bar - variance, 0)) / sqrt(1 - alpha_bar)
    return Step(i, j, sqrt(next_bar) - sample * sqrt(alpha_bar), sample, sqrt(variance))


def _second_order(schedule: Schedule, before: Step, step: Step) -> Step:
    level = schedule.half_log_snr
    length, length_before = level[step.j] - level[step.i], level[before.j] - level[before.i]
    if isinf(length):
        return step
    share = 0.0 if length_before == inf else length / (2 * length_before)
    return replace(step, clean=step.clean * (1 + share), previous=-step.clean * share)


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

"""Noise schedules: beta_i, alpha_i = 1 - beta_i, alpha_bar_i = prod_{s<=i} alpha_s (Section II-A).

A schedule is an array with one entry per step i = 0..L, where beta_0 = 0 stands for clean data.
numpy only; the samplers turn the few numbers they need into Python floats.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dadiff.errors import ConfigError
from dadiff.memory import check_fits


@dataclass(frozen=True)
class Schedule:
    """The forward process q(tau_i | tau_{i-1}) = N(sqrt(1 - beta_i) tau_{i-1}, beta_i I).

    Args:
        beta: (L+1,) with beta[0] = 0.

    Raises:
        ConfigError: if a beta lies outside [0, 1] or beta[0] is not 0.
    """

    beta: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        beta = np.asarray(self.beta, dtype=np.float64)
        object.__setattr__(self, "beta", beta)
        if beta.ndim != 1 or len(beta) < 2 or beta[0] != 0:
            raise ConfigError(f"schedule: beta has shape {beta.shape}; expected (L+1,) with L >= 1 and beta[0] = 0")
        outside = np.flatnonzero(~((beta >= 0) & (beta <= 1)))
        if len(outside):
            i = int(outside[0])
            raise ConfigError(f"schedule: beta_{i} = {beta[i]:g} lies outside [0, 1]; lower the slope or num_steps")
        if 1 - beta[1] == 1:
            raise ConfigError("schedule: beta_1 = 0, so the first step adds no noise and cannot be undone; raise beta")

    @property
    def num_steps(self) -> int:
        """L."""
        return len(self.beta) - 1

    @cached_property
    def alpha(self) -> np.ndarray:
        """alpha_i = 1 - beta_i, (L+1,)."""
        return 1 - self.beta

    @cached_property
    def alpha_bar(self) -> np.ndarray:
        """alpha_bar_i = prod_{s=1}^i alpha_s, (L+1,), with alpha_bar_0 = 1."""
        return np.cumprod(self.alpha)

    @cached_property
    def half_log_snr(self) -> np.ndarray:
        """lambda_i = log(alpha_bar_i / (1 - alpha_bar_i)) / 2, (L+1,): +inf at i = 0, and -inf at L if beta_L = 1."""
        with np.errstate(divide="ignore"):
            log_alpha_bar = np.cumsum(np.log1p(-self.beta))
            return (log_alpha_bar - np.log(-np.expm1(log_alpha_bar))) / 2

    def conditions(self) -> dict[str, bool]:
        """Which of the paper's conditions (C1)-(C3) hold.

        C1: beta_0 = 0 and beta_L = 1.  C2: beta_i in [0, 1].  C3: beta_i <= beta_{i+1}.
        """
        return {
            "C1": bool(self.beta[0] == 0 and math.isclose(self.beta[-1], 1)),
            "C2": bool(((self.beta >= 0) & (self.beta <= 1)).all()),
            "C3": bool((np.diff(self.beta) >= 0).all()),
        }


def _steps(num_steps: int) -> np.ndarray:
    """i = 1..L."""
    if num_steps < 1:
        raise ConfigError(f"schedule: num_steps is {num_steps}; it must be at least 1")
    check_fits(6 * 8 * num_steps, f"schedule: num_steps={num_steps}")
    return np.arange(1, num_steps + 1)


def _schedule(beta: np.ndarray) -> Schedule:
    return Schedule(np.concatenate([[0.0], beta]))


def paper_linear(num_steps: int = 1000, slope: float = 0.001) -> Schedule:
    """beta_i = slope * i, the schedule of the paper's experiments (Section IV-A): L = 1000, slope 0.001."""
    beta = slope * _steps(num_steps)
    if math.isclose(beta[-1], 1):
        beta[-1] = 1.0  # 0.001 * 1000 is 1 up to rounding; (C1) means 1
    return _schedule(beta)


def ddpm_linear(num_steps: int = 1000, beta_first: float = 1e-4, beta_last: float = 0.02) -> Schedule:
    """beta_i linear from beta_first to beta_last (Ho, Jain & Abbeel 2020)."""
    return _schedule(np.linspace(beta_first, beta_last, len(_steps(num_steps))))


def cosine(num_steps: int = 1000, offset: float = 0.008, beta_max: float = 0.999) -> Schedule:
    """alpha_bar_i proportional to cos^2((i/L + s)/(1 + s) * pi/2), s = offset (Nichol & Dhariwal 2021)."""
    if offset < 0:
        raise ConfigError(f"schedule: offset is {offset}; it must not be negative")
    share = np.concatenate([[0], _steps(num_steps)]) / num_steps
    alpha_bar = np.cos((share + offset) / (1 + offset) * np.pi / 2) ** 2
    return _schedule(np.minimum(1 - alpha_bar[1:] / alpha_bar[:-1], beta_max))

"""Other people's ways to keep a diffusion within bounds, beside projecting onto dynamics and bounds together.

In each the clean estimate is corrected onto the dynamics alone, as `Conditional` does, so that they differ only in what
they do about bounds. Constraint tightening is a projector, `dadiff.behaviours.KnownTightened`; clipping is another.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.context import Context
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.trajectory.arrays import Array, like


@dataclass(frozen=True)
class QPFilter(Conditional):
    """Bounds once, at the end: the nearest plan that obeys dynamics and bounds, a quadratic program."""

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """Corrected onto the dynamics alone."""
        return super().clean(tau0_hat, without_limits(at))

    def end(self, tau: Array, at: Context) -> Array:
        """P(tau), within bounds."""
        return at.project(tau, None, tau)


@dataclass(frozen=True)
class Barrier(Conditional):
    """A barrier-function filter in the chain: SafeDiffuser (Xiao et al. 2023), and with a tube constricting barriers.

    For h = high - tau and tau - low, of entries that are bounded, the sample is moved as little as

        h_j(tau_j) >= (1 - rate) h_i(tau_i) w_j / w_i

    asks for: the discrete form of dh/di + alpha(h) >= 0. These constraints concern one entry each, so that the filter's
    quadratic program is a clipping. The tube widens bounds by tube sqrt(1 - alpha_bar), which vanishes at the end
    (Gadginmath, Allibhoy & Pasqualetti 2026); w is the distance between both, constant without a tube. A chain that
    begins within the tube ends within bounds.

    Args:
        rate: by which the distance to a bound may shrink in one step, in (0, 1].
        tube: in units of the sampler's coordinates.
    """

    rate: float = 0.5
    tube: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.rate <= 1 or not 0 <= self.tube < float("inf"):
            raise ConfigError(
                f"enforcement: rate is {self.rate}, tube {self.tube}; need 0 < rate <= 1 and 0 <= tube < inf"
            )

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """Corrected onto the dynamics alone."""
        return super().clean(tau0_hat, without_limits(at))

    def sample(self, tau: Array, at: Context) -> Array:
        """The filtered sample."""
        low, high = at.limiting().box
        before, after = (self.tube * sqrt(1 - float(at.schedule.alpha_bar[step])) for step in (at.step.i, at.j))
        share, width = np.full(len(low), 1 - self.rate), high - low
        both = np.isfinite(width)
        share[both] *= (width[both] + 2 * after) / (width[both] + 2 * before + (width[both] + before == 0))
        most = _limit(high, before, after, share, at.tau)
        least = -_limit(-low, before, after, share, -at.tau)
        return tau.clip(least, most)

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """It moves what lies in the set, too."""
        return None


def _limit(bound: np.ndarray, before: float, after: float, share: np.ndarray, tau: Array) -> Array:
    """bound + after - share (bound + before - tau) of plans tau (..., d); inf where there is no bound."""
    finite = np.isfinite(bound)
    there = like(np.where(finite, bound, 0.0), tau)
    return there + after - like(share, tau) * (there + before - tau) + like(np.where(finite, 0.0, np.inf), tau)


def without_limits(at: Context) -> Context:
    """The same step with the projection onto the dynamics alone."""
    return replace(at, project=at.limiting().unlimited)

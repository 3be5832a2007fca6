"""Where and how strongly a projection acts along the reverse chain.

Three places: the clean estimate tau0_hat, the sample tau_j that a step produces, and the end of the chain.
Each enforcement is one operator in one place; j is the step that the sample has reached, and beta_0 = 0, so at the
last step those that act on the sample project exactly. P may be affine (x(0) fixed, scaled coordinates),
which is why the operators are written with displacements P(tau) - tau.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import ClassVar, Literal, Protocol

from dadiff.diffusion.schedule import Schedule
from dadiff.trajectory.layout import Array

Project = Callable[[Array], Array]


class Enforcement(Protocol):
    """What the sampler asks. `affine` tells whether the operator is meaningful for affine sets."""

    affine: ClassVar[bool]

    def clean(self, tau0_hat: Array, P: Project, schedule: Schedule, j: int) -> Array: ...

    def sample(self, tau: Array, P: Project, schedule: Schedule, j: int) -> Array: ...

    def end(self, tau: Array, P: Project) -> Array: ...


@dataclass(frozen=True)
class Never:
    """Nothing is projected: vanilla diffusion, whatever the projector."""

    affine: ClassVar[bool] = True

    def clean(self, tau0_hat: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """tau0_hat."""
        return tau0_hat

    def sample(self, tau: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """tau."""
        return tau

    def end(self, tau: Array, P: Project) -> Array:
        """tau."""
        return tau


@dataclass(frozen=True)
class PostHoc(Never):
    """P once, after the last step: the baseline of every comparison."""

    def end(self, tau: Array, P: Project) -> Array:
        """P(tau)."""
        return P(tau)


@dataclass(frozen=True)
class Normalised(Never):
    """P + sqrt(beta_j) (I - P) on the sample: the paper's operator with gain 1 on im F. The default."""

    def sample(self, tau: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """P(tau) + sqrt(beta_j) (tau - P(tau))."""
        projected = P(tau)
        return projected + sqrt(schedule.beta[j]) * (tau - projected)


@dataclass(frozen=True)
class Convex(Never):
    """a P + (1 - a) I with a = alpha_bar_j, on the sample or on the clean estimate.

    Args:
        acts_on: where it acts.
    """

    acts_on: Literal["sample", "clean_estimate"] = "sample"

    def clean(self, tau0_hat: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """tau0_hat + a (P(tau0_hat) - tau0_hat), if it acts here."""
        return self._blend(tau0_hat, P, schedule.alpha_bar[j]) if self.acts_on == "clean_estimate" else tau0_hat

    def sample(self, tau: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """tau + a (P(tau) - tau), if it acts here."""
        return self._blend(tau, P, schedule.alpha_bar[j]) if self.acts_on == "sample" else tau

    @staticmethod
    def _blend(tau: Array, P: Project, a: float) -> Array:
        return tau + float(a) * (P(tau) - tau)


@dataclass(frozen=True)
class CleanEstimate(Never):
    """P on the clean estimate only. The sample lies in the set if the last step adds no noise."""

    def clean(self, tau0_hat: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """P(tau0_hat)."""
        return P(tau0_hat)


@dataclass(frozen=True)
class Literally(Never):
    """sqrt(1 - beta_j) P + sqrt(beta_j) I on the sample, as printed in Algorithms 1 and 2.

    Its gain on im F is sqrt(1 - beta_j) + sqrt(beta_j) >= 1 at every step, so the chain diverges.
    """

    affine: ClassVar[bool] = False

    def sample(self, tau: Array, P: Project, schedule: Schedule, j: int) -> Array:
        """sqrt(1 - beta_j) P(tau) + sqrt(beta_j) tau."""
        beta = schedule.beta[j]
        return sqrt(1 - beta) * P(tau) + sqrt(beta) * tau

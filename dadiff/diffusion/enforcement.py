"""Where and how strongly a projection acts along the reverse chain.

Three places: the clean estimate tau0_hat, the sample tau_j that a step produces, and the end of the chain.
Each enforcement is told by a `Context` where the chain stands. Those of the paper are one operator in one place; j is
the step that the sample has reached, and beta_0 = 0, so at the last step those that act on the sample project exactly.
P may be affine (x(0) pinned, scaled coordinates), which is why operators are written with displacements P(tau) - tau.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import ClassVar, Literal, Protocol

from dadiff.diffusion.context import Context
from dadiff.diffusion.samplers import Step
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.trajectory.layout import Array


class Enforcement(Protocol):
    """What the sampler asks.

    `affine` tells whether the operator is meaningful for affine sets, `weighs` whether it asks for the covariance of
    the clean estimate, `measures` whether for the one that is measured on demonstrations.
    """

    affine: ClassVar[bool]
    weighs: ClassVar[bool]

    @property
    def measures(self) -> bool: ...

    def weights(self, step: Step, schedule: Schedule) -> Step: ...

    def clean(self, tau0_hat: Array, at: Context) -> Array: ...

    def sample(self, tau: Array, at: Context) -> Array: ...

    def end(self, tau: Array, at: Context) -> Array: ...

    def keeps(self, schedule: Schedule, j: int) -> float | None: ...


@dataclass(frozen=True)
class Never:
    """Nothing is projected: vanilla diffusion, whatever the projector."""

    affine: ClassVar[bool] = True
    weighs: ClassVar[bool] = False

    @property
    def measures(self) -> bool:
        """No."""
        return False

    def weights(self, step: Step, schedule: Schedule) -> Step:
        """The step with the sampler's weights."""
        return step

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """tau0_hat."""
        return tau0_hat

    def sample(self, tau: Array, at: Context) -> Array:
        """tau."""
        return tau

    def end(self, tau: Array, at: Context) -> Array:
        """tau."""
        return tau

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """k where `sample` is P(tau) + k (tau - P(tau)): 1 where it does nothing, None where it is something else."""
        return 1.0


@dataclass(frozen=True)
class PostHoc(Never):
    """P once, after the last step: the baseline of every comparison."""

    def end(self, tau: Array, at: Context) -> Array:
        """P(tau)."""
        return at.project(tau)


@dataclass(frozen=True)
class Repeated(Never):
    """P after the last step, again and again from what it gave: for sets that one projection only comes nearer to.

    Args:
        times: how often.
    """

    times: int = 10

    def __post_init__(self) -> None:
        if self.times < 1:
            raise ConfigError(f"enforcement: times is {self.times}; project at least once")

    def end(self, tau: Array, at: Context) -> Array:
        """P(tau), begun at the last P(tau)."""
        projected = at.project(tau)
        for _ in range(self.times - 1):
            projected = at.project(tau, None, projected)
        return projected


@dataclass(frozen=True)
class Normalised(Never):
    """P + sqrt(beta_j) (I - P) on the sample: the paper's operator with gain 1 on im F."""

    def sample(self, tau: Array, at: Context) -> Array:
        """P(tau) + sqrt(beta_j) (tau - P(tau))."""
        projected = at.project(tau)
        return projected + sqrt(at.beta) * (tau - projected)

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """sqrt(beta_j)."""
        return sqrt(schedule.beta[j])


@dataclass(frozen=True)
class Convex(Never):
    """a P + (1 - a) I with a = alpha_bar_j, on the sample or on the clean estimate.

    Args:
        acts_on: where it acts.
    """

    acts_on: Literal["sample", "clean_estimate"] = "sample"

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """tau0_hat + a (P(tau0_hat) - tau0_hat), if it acts here."""
        return self._blend(tau0_hat, at) if self.acts_on == "clean_estimate" else tau0_hat

    def sample(self, tau: Array, at: Context) -> Array:
        """tau + a (P(tau) - tau), if it acts here."""
        return self._blend(tau, at) if self.acts_on == "sample" else tau

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """1 - a where it acts on the sample."""
        return 1 - float(schedule.alpha_bar[j]) if self.acts_on == "sample" else 1.0

    @staticmethod
    def _blend(tau: Array, at: Context) -> Array:
        return tau + at.alpha_bar * (at.project(tau) - tau)


@dataclass(frozen=True)
class CleanEstimate(Never):
    """P on the clean estimate only, the null-space step of DDNM (Wang, Yu & Zhang 2023).

    The sample lies in the set if the last step adds no noise.
    """

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """P(tau0_hat)."""
        return at.onto(tau0_hat)


@dataclass(frozen=True)
class Literally(Never):
    """sqrt(1 - beta_j) P + sqrt(beta_j) I on the sample, as printed in Algorithms 1 and 2.

    Its gain on im F is sqrt(1 - beta_j) + sqrt(beta_j) >= 1 at every step, so the chain diverges.
    """

    affine: ClassVar[bool] = False

    def sample(self, tau: Array, at: Context) -> Array:
        """sqrt(1 - beta_j) P(tau) + sqrt(beta_j) tau."""
        return sqrt(1 - at.beta) * at.project(tau) + sqrt(at.beta) * tau

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """It grows what lies in im F, too."""
        return None

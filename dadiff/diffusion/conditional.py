"""The conditional projection: the clean estimate is corrected as Bayes' rule has it.

Dynamics are a linear inverse problem, G tau = g + r with r ~ N(0, R), and a dynamics-aware planner draws from
p(tau | E, G tau = g). With tau_0 | tau_i ~ N(tau0_hat, C_i), Kalman's update

    tau0_hat - C_i G' (G C_i G' + R)^-1 (G tau0_hat - g)

is the clean estimate of that conditional law: exactly, if the prior is Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod, sqrt
from typing import ClassVar, Literal

from dadiff.diffusion.context import Context
from dadiff.diffusion.enforcement import Never
from dadiff.diffusion.samplers import Step
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.trajectory.arrays import Array, like
from dadiff.trajectory.covariance import Covariance

ALL_UP_TO = 600
LEADING = 64

Metric = Literal["estimate", "measured", "diagonal", "standardised", "physical"]


@dataclass(frozen=True)
class Conditional(Never):
    """P on the clean estimate, in the metric of the covariance that the denoiser leaves open.

    Args:
        metric: C is the `estimate`'s covariance C_i + floor Sigma, with both as `measured` on demonstrations
            (`dadiff.diffusion.measured`), its `diagonal`, or says nothing of the task: equal variances of
            `standardised` channels, or of `physical` units.
        floor, shrinkage: see `dadiff.diffusion.estimate.Estimate`.
        directions: of C that are kept beside a diagonal; 0 keeps all, None does so up to d = ALL_UP_TO, and beyond it
            LEADING, with which long horizons are projected onto in O(T).
        spread: draw tau_0 from N(tau0_hat, C), project the draw (Matheron's rule), and bridge from tau_i to it. The
            plans are then draws of the conditional law whatever the number of steps, exactly for a Gaussian prior
            without floor and shrinkage; the sampler only places the steps. Else the corrected estimate is what the
            sampler goes on with.
    """

    weighs: ClassVar[bool] = True

    metric: Metric = "estimate"
    floor: float = 0.01
    shrinkage: float = 0.5
    directions: int | None = None
    spread: bool = False

    def __post_init__(self) -> None:
        if not self.floor >= 0 or not 0 <= self.shrinkage <= 1 or (self.directions or 0) < 0:
            raise ConfigError(
                f"enforcement: floor is {self.floor}, shrinkage {self.shrinkage}, directions {self.directions}; need "
                "at least 0, in [0, 1] and at least 0"
            )

    @property
    def measures(self) -> bool:
        """With metric=measured."""
        return self.metric == "measured"

    def weights(self, step: Step, schedule: Schedule) -> Step:
        """With `spread`, those of the bridge; else the sampler's."""
        return bridge(step, schedule) if self.spread and step.call else step

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """The corrected estimate, or a draw about it."""
        C = self.covariance(at)
        if not self.spread:
            return at.onto(tau0_hat, C)
        drawn = tau0_hat + like(C, tau0_hat).colour(at.noise(), at.noise())
        return at.onto(drawn, C, at.noise())

    def covariance(self, at: Context) -> Covariance:
        """C at step i."""
        estimate, alpha_bar = at.known_estimate(), float(at.schedule.alpha_bar[at.step.i])
        if self.metric == "estimate":
            return estimate.at(alpha_bar, self.floor, self.shrinkage, self.kept(estimate.size))
        if self.measures:
            return estimate.at_step(at.step.i, self.floor, self.shrinkage, self.kept(estimate.size))
        if self.metric == "diagonal":
            return estimate.diagonal(alpha_bar, self.floor)
        return estimate.standardised if self.metric == "standardised" else estimate.physical

    def kept(self, size: int) -> int:
        """How many directions of C are kept of trajectories of size d; 0 for all."""
        if self.directions is not None:
            return self.directions
        return 0 if size <= ALL_UP_TO else LEADING


def bridge(step: Step, schedule: Schedule) -> Step:
    """q(tau_j | tau_i, tau_0), the forward process between two of its points, as weights of a step.

    With a = alpha_bar_i / alpha_bar_j: mean (sqrt(alpha_bar_j) (1 - a) tau_0 + sqrt(a) (1 - alpha_bar_j) tau_i)
    / (1 - alpha_bar_i), variance (1 - a) (1 - alpha_bar_j) / (1 - alpha_bar_i).
    """
    noise, left = 1 - schedule.alpha_bar[step.i], 1 - schedule.alpha_bar[step.j]
    a = prod(schedule.alpha[step.j + 1 : step.i + 1])
    return Step(
        step.i,
        step.j,
        clean=sqrt(schedule.alpha_bar[step.j]) * (1 - a) / noise,
        sample=sqrt(a) * left / noise,
        noise=sqrt((1 - a) * left / noise),
    )

"""Other people's ways to enforce constraints on a diffusion, on the same footing: equal noise, equal calls.

P is the projection onto the set, J = d tau0_hat / d tau_i. Where a method is written for measurements G tau = g, the
residual is that of the set, tau0_hat - P(tau0_hat), which does not depend on how the rows of G are scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import ClassVar

from dadiff.diffusion.context import Context
from dadiff.diffusion.enforcement import Never
from dadiff.diffusion.samplers import Step
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.covariance import Covariance

TINY = 1e-12


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"enforcement: {name} is {value}; it must lie in [{low:g}, {high:g}]")


@dataclass(frozen=True)
class ProjectedSamples(Never):
    """P on the sample, at every step where enough signal is left.

    Diffuser's conditioning where only x(0) is held (Janner et al. 2022), projected diffusion models (Christopher, Baek
    & Fioretto 2024), and, in the later steps only, diffusion predictive control with constraints (Römer et al. 2024).

    Args:
        signal: alpha_bar_j from which on it acts; 0 for all steps.
    """

    signal: float = 0.0

    def __post_init__(self) -> None:
        _check("signal", self.signal, 0, 1)

    def sample(self, tau: Array, at: Context) -> Array:
        """P(tau), where it acts."""
        return at.project(tau) if at.alpha_bar >= self.signal else tau

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """Nothing of the displacement where it acts."""
        return 0.0 if float(schedule.alpha_bar[j]) >= self.signal else 1.0


@dataclass(frozen=True)
class Selected(ProjectedSamples):
    """As `ProjectedSamples`, and of all plans for one E the one is taken that was moved least.

    The selection of diffusion predictive control with constraints (Römer et al. 2024): least sum over steps of
    |P(tau_j) - tau_j|. Every plan for that E becomes the selected one.
    """

    signal: float = 0.5

    def sample(self, tau: Array, at: Context) -> Array:
        """P(tau), where it acts; what it moved is kept."""
        projected = super().sample(tau, at)
        at.memory["moved"] = at.memory.get("moved", 0.0) + ((projected - tau) ** 2).sum(-1) ** 0.5
        return projected

    def end(self, tau: Array, at: Context) -> Array:
        """The selected plans: those for one E follow one another.

        Raises:
            ConfigError: outside of a chain, where nothing was moved yet: what is selected depends on all plans.
        """
        if "moved" not in at.memory:
            raise ConfigError(
                "enforcement=dpcc_selected: what it selects depends on all plans, so that one has no law; "
                "evaluation=exact judges enforcement=dpcc, which selects none"
            )
        moved, chosen = at.memory["moved"], 0 * tau
        for first, last in _alike(at.environment):
            least = moved[..., first:last].argmin(-1)[..., None, None]
            best = (tau[..., first:last, :] * (_places(tau[..., first:last, :]) == least)).sum(-2)
            chosen[..., first:last, :] = best[..., None, :]
        return chosen


def _alike(environment: Array) -> list[tuple[int, int]]:
    """Where plans for one E begin and end, of E (*robots, plans, c) in which they follow one another."""
    plans = environment.shape[-2]
    rows = environment.reshape(-1, plans, environment.shape[-1])
    begins = [0, *(k for k in range(1, plans) if bool((rows[:, k] != rows[:, k - 1]).any()))]
    return list(pairwise([*begins, plans]))


def _places(plans: Array) -> Array:
    """0, 1, ... for each of plans (..., count, d), as (count, 1)."""
    return (0 * plans[..., :1] + 1).cumsum(-2) - 1


@dataclass(frozen=True)
class Tracked(Never):
    """The vanilla plan is tracked: min sum_t q |x(t) - x_hat(t)|^2 + r |u(t) - u_hat(t)|^2 within the set, at the end.

    What a tracking controller with a model makes of a plan; with `projector.bounds=enforced` a quadratic programme.

    Args:
        state_weight, input_weight: q and r, in physical units.
    """

    weighs: ClassVar[bool] = True

    state_weight: float = 1.0
    input_weight: float = 0.01

    def __post_init__(self) -> None:
        _check("state_weight", self.state_weight, TINY, float("inf"))
        _check("input_weight", self.input_weight, TINY, float("inf"))

    def end(self, tau: Array, at: Context) -> Array:
        """P(tau) in the metric of the weights' inverses."""
        return at.project(tau, at.known_estimate().weighted(self.state_weight, self.input_weight))


@dataclass(frozen=True)
class Replacement(Never):
    """What the set fixes of the sample is replaced by its forward process (Song et al. 2021; Lugmayr et al. 2022).

    With P(z) = Pi z + o: Pi tau_j + sqrt(alpha_bar_j) o + sqrt(1 - alpha_bar_j) (I - Pi) eps.
    """

    def sample(self, tau: Array, at: Context) -> Array:
        """The mixture."""
        return replaced(tau, at)

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """It adds noise of its own."""
        return None


def replaced(tau: Array, at: Context) -> Array:
    """See `Replacement`."""
    eps = at.noise()
    origin, kept, noise = at.project(0 * tau), at.project(tau), at.project(eps)
    across = eps - (noise - origin)
    return kept - origin + sqrt(at.alpha_bar) * origin + sqrt(1 - at.alpha_bar) * across


@dataclass(frozen=True)
class RolloutBlend(Never):
    """tau0_hat + alpha_bar_i (P(tau0_hat) - tau0_hat): what the paper's public code does, with P the roll-out."""

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """The blend, by the signal of the step that it comes from."""
        return tau0_hat + float(at.schedule.alpha_bar[at.step.i]) * (at.project(tau0_hat) - tau0_hat)


@dataclass(frozen=True)
class LateEstimate(Never):
    """P on the clean estimate once enough signal is there: the curriculum of DDAT (Bouvier et al. 2025).

    Args:
        signal: alpha_bar_i from which on it acts.
    """

    signal: float = 0.5

    def __post_init__(self) -> None:
        _check("signal", self.signal, 0, 1)

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """P(tau0_hat), where it acts."""
        return at.project(tau0_hat) if at.schedule.alpha_bar[at.step.i] >= self.signal else tau0_hat


@dataclass(frozen=True)
class DiRecT(Never):
    """The step is taken with tau0_hat itself, then moved by what P changes of it (Giaretta, Li & Azizan 2026).

    tau_j + sqrt(alpha_bar_j) (P(tau0_hat) - tau0_hat): the constraint holds for the final plan only.
    """

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """tau0_hat; what P changes of it is kept for the sample."""
        at.memory["correction"] = at.project(tau0_hat) - tau0_hat
        return tau0_hat

    def sample(self, tau: Array, at: Context) -> Array:
        """The moved sample."""
        return tau + sqrt(at.alpha_bar) * at.memory["correction"] if at.step.call else tau


@dataclass(frozen=True)
class PiGDM(Never):
    """Pseudo-inverse guidance (Song et al. 2023): tau_j + sqrt(alpha_bar_i) J' (P(tau0_hat) - tau0_hat)."""

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """tau0_hat; the guidance is kept for the sample."""
        pulled = at.pull_back(at.project(tau0_hat) - tau0_hat)
        at.memory["guidance"] = sqrt(at.schedule.alpha_bar[at.step.i]) * pulled
        return tau0_hat

    def sample(self, tau: Array, at: Context) -> Array:
        """The guided sample."""
        return tau + at.memory["guidance"] if at.step.call else tau


@dataclass(frozen=True)
class DPS(Never):
    """Diffusion posterior sampling (Chung et al. 2023): a gradient step on |tau0_hat - P(tau0_hat)|.

    Args:
        weight: of the gradient of the distance, whose size is about 1.
    """

    weight: float = 1.0

    def __post_init__(self) -> None:
        _check("weight", self.weight, 0, float("inf"))

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """tau0_hat; the gradient is kept for the sample."""
        off = tau0_hat - at.project(tau0_hat)
        size = (off**2).sum(-1)[..., None] ** 0.5
        at.memory["gradient"] = at.pull_back(off / (size + (size == 0)))
        return tau0_hat

    def sample(self, tau: Array, at: Context) -> Array:
        """tau_j - weight J' off / |off|."""
        return tau - self.weight * at.memory["gradient"] if at.step.call else tau


@dataclass(frozen=True)
class MCG(DPS):
    """Manifold-constrained gradient (Chung et al. 2022): the gradient step, then what the set fixes is replaced."""

    def sample(self, tau: Array, at: Context) -> Array:
        """See `Replacement`."""
        return replaced(super().sample(tau, at), at)

    def keeps(self, schedule: Schedule, j: int) -> float | None:
        """It adds noise of its own."""
        return None


@dataclass(frozen=True)
class PPR(Never):
    """Predict, project, renoise (Rochman-Sharabi & Louppe 2026): at each level several times, then to the next one.

    Args:
        sweeps: at each level, with one call each.
    """

    sweeps: int = 3

    def __post_init__(self) -> None:
        _check("sweeps", self.sweeps, 1, float("inf"))

    def weights(self, step: Step, schedule: Schedule) -> Step:
        """The forward process from the projected estimate: nothing of tau_i is kept."""
        a = float(schedule.alpha_bar[step.j])
        return Step(step.i, step.j, clean=sqrt(a), sample=0.0, noise=sqrt(1 - a)) if step.call else step

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """The projected estimate after all sweeps."""
        a, clean = float(at.schedule.alpha_bar[at.step.i]), at.project(tau0_hat)
        for _ in range(self.sweeps - 1):
            renoised = sqrt(a) * clean + sqrt(1 - a) * at.noise()
            clean = at.project(at.denoise(renoised, at.step.i, at.environment))
        return clean


@dataclass(frozen=True)
class TMPD(Never):
    """Tweedie moment projected diffusion (Boys et al. 2023): P in the metric (1 - alpha_bar_i) / sqrt(alpha_bar_i) J.

    It is the covariance that the denoiser itself implies, plan by plan: the Jacobian takes d passes backwards a step.
    """

    def clean(self, tau0_hat: Array, at: Context) -> Array:
        """The corrected estimate; the estimate itself where no signal is left and J is 0."""
        a = float(at.schedule.alpha_bar[at.step.i])
        if a < LEAST_SIGNAL:
            return at.project(tau0_hat)
        J = at.jacobian().cpu().numpy()
        return at.project(tau0_hat, Covariance.dense((1 - a) / sqrt(a) * (J + J.swapaxes(-1, -2)) / 2))


LEAST_SIGNAL = 1e-6
"""alpha_bar below which a Jacobian divided by its root is rounding."""

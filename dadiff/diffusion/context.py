"""What an enforcement is told at a step of the chain, and what it may ask for."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.samplers import Step
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import NotApplicableError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.covariance import Covariance

AT_ONCE = 8192  # cotangents of plans that a Jacobian is pulled back with at once

Denoise = Callable[[Array, int, Array], Array]


class Project(Protocol):
    """The projection onto a set; see `dadiff.behaviours.Projection`."""

    def __call__(
        self,
        tau: Array,
        metric: Covariance | None = None,
        start: Array | None = None,
        noise: Array | None = None,
    ) -> Array:
        """The admissible trajectory that is nearest to tau, in the metric of a covariance."""
        ...


@runtime_checkable
class Limiting(Project, Protocol):
    """A projection onto dynamics within limits; see `dadiff.behaviours.Limited`."""

    @property
    def unlimited(self) -> Project:
        """The projection onto the dynamics alone."""
        ...

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) of plans, each (d,), in the sampler's coordinates."""
        ...


@runtime_checkable
class Differentiable(Protocol):
    """A denoiser that can be differentiated."""

    def estimate(self, tau: Array, i: int, environment: Array) -> Array:
        """tau0_hat, recorded by autograd."""
        ...


class Counted:
    """A denoiser that counts how often it is asked."""

    def __init__(self, denoise: Denoise) -> None:
        self.denoise, self.calls = denoise, 0

    def __call__(self, tau: Array, i: int, environment: Array) -> Array:
        """tau0_hat."""
        self.calls += 1
        return self.denoise(tau, i, environment)

    def estimate(self, tau: Array, i: int, environment: Array) -> Array:
        """tau0_hat, recorded by autograd.

        Raises:
            NotApplicableError: if the denoiser cannot be differentiated.
        """
        if not isinstance(self.denoise, Differentiable):
            raise NotApplicableError("enforcement: it needs the denoiser's gradient, and this denoiser has none")
        self.calls += 1
        return self.denoise.estimate(tau, i, environment)


def unprojected(
    tau: Array, metric: Covariance | None = None, start: Array | None = None, noise: Array | None = None
) -> Array:
    """tau: where there is nothing to project onto."""
    return tau


@dataclass(frozen=True)
class Context:
    """One step i -> j of a chain that is enforced.

    Args:
        step: from i to j, with its weights.
        schedule: beta, alpha, alpha_bar.
        tau: tau_i, from which the step starts.
        environment: E, aligned with tau.
        project: P.
        denoise: (tau, i, E) -> tau0_hat, to ask again; counted as a call.
        noise: draws unit noise of the shape of tau from the chain's generator.
        estimate: how uncertain the clean estimate is; None where nothing is known of it.
        memory: what an enforcement keeps from step to step; empty at the start of the chain.
    """

    step: Step
    schedule: Schedule
    tau: Array
    environment: Array
    project: Project
    denoise: Counted
    noise: Callable[[], Array]
    estimate: Estimate | None = None
    memory: MutableMapping[str, Any] = field(default_factory=dict)

    @property
    def j(self) -> int:
        """The step that the sample reaches."""
        return self.step.j

    @property
    def beta(self) -> float:
        """beta_j."""
        return float(self.schedule.beta[self.j])

    @property
    def alpha_bar(self) -> float:
        """alpha_bar_j."""
        return float(self.schedule.alpha_bar[self.j])

    def known_estimate(self) -> Estimate:
        """The estimate's law.

        Raises:
            NotApplicableError: if nothing is known of it.
        """
        if self.estimate is None:
            raise NotApplicableError(
                "enforcement: it weighs by the covariance of the clean estimate, and none is known; give the sampler "
                "an Estimate (dadiff.diffusion.estimate), or use another enforcement"
            )
        return self.estimate

    def limiting(self) -> Limiting:
        """P, which keeps to limits.

        Raises:
            NotApplicableError: if it keeps to none.
        """
        if not isinstance(self.project, Limiting):
            raise NotApplicableError(
                "enforcement: it is about bounds, and this projector keeps to none; use projector=known_bounded, and "
                "give the system bounds"
            )
        return self.project

    def onto(self, tau: Array, metric: Covariance | None = None, noise: Array | None = None) -> Array:
        """P of a clean estimate, begun at the last one, where P is iterated."""
        projected = self.project(tau, metric, self.memory.get("projected"), noise)
        self.memory["projected"] = projected
        return projected

    def pull_back(self, cotangent: Array) -> Array:
        """J' v with J = d tau0_hat / d tau_i and v of the shape of tau: one more call, and one pass backwards.

        Raises:
            NotApplicableError: if the denoiser cannot be differentiated.
        """
        import torch

        with torch.inference_mode(False), torch.enable_grad():
            tau = self.tau.clone().requires_grad_()
            tau0_hat = self.denoise.estimate(tau, self.step.i, self.environment.clone())
            return torch.autograd.grad(tau0_hat, tau, cotangent.clone())[0]

    def jacobian(self) -> Array:
        """J of shape (..., d, d), plan by plan; one more call, and passes backwards for d directions, many at once.

        Raises:
            NotApplicableError: if the denoiser cannot be differentiated.
        """
        import torch

        with torch.inference_mode(False), torch.enable_grad():
            tau = self.tau.clone().requires_grad_()
            tau0_hat = self.denoise.estimate(tau, self.step.i, self.environment.clone())
            directions = torch.eye(tau.shape[-1], dtype=tau.dtype, device=tau.device)
            rows = []
            for some in directions.split(max(1, AT_ONCE // tau[..., 0].numel())):
                v = some.reshape(len(some), *(1,) * (tau.ndim - 1), -1).expand(len(some), *tau.shape)
                rows += torch.autograd.grad(tau0_hat, tau, v, retain_graph=True, is_grads_batched=True)[0].unbind()
        return torch.stack(rows, dim=-2)

"""The silent start of a chain: leading steps without a call, which are linear and Gaussian, drawn as one.

Let P(z) = Pi z + o be what is projected with, an affine map with P(P(z)) = P(z), and let the enforcement keep the share
k of the displacement: z -> P(z) + k (z - P(z)). With tau = u + v + o, u = Pi tau and v = tau - P(tau), a silent step
tau -> s tau + n eps followed by that operator takes the two parts apart:

    u -> s u + n Pi eps                 v -> k (s v + n (I - Pi) eps - (1 - s) o)

So after all of them tau is Gaussian: the covariances of u and v and that between them, which is 0 unless Pi is oblique,
are one number each, and v has a mean along o. Two draws give exactly its law.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from math import sqrt

import torch

from dadiff.diffusion.context import Project, unprojected
from dadiff.diffusion.enforcement import Enforcement
from dadiff.diffusion.samplers import Step
from dadiff.diffusion.schedule import Schedule

ROUNDING = 1e-9  # relative; what P may miss of being affine and idempotent


@dataclass(frozen=True)
class Silence:
    """The law of tau after silent steps, from tau ~ N(0, I).

    Args:
        inside: variance of u, in units of Pi Pi'.
        across: covariance of u and v, in units of Pi (I - Pi)'.
        outside: variance of v, in units of (I - Pi) (I - Pi)'.
        shift: v's mean is (shift - 1) o.
    """

    inside: float = 1.0
    across: float = 1.0
    outside: float = 1.0
    shift: float = 0.0

    def after(self, step: Step, keeps: float) -> Silence:
        """One step later."""
        s, n = step.sample, step.noise
        return Silence(
            inside=s**2 * self.inside + n**2,
            across=keeps * (s**2 * self.across + n**2),
            outside=keeps**2 * (s**2 * self.outside + n**2),
            shift=1 + keeps * (s * (self.shift - 1) - (1 - s)),
        )

    def draw(self, eps: torch.Tensor, other: torch.Tensor, project: Project) -> torch.Tensor | None:
        """tau from two standard normal draws; None if P is no affine idempotent map."""
        near = sqrt(self.inside) * eps
        slope = self.across / self.inside
        far = slope * near + sqrt(max(self.outside - slope * self.across, 0.0)) * other
        offset, on_near, on_far = project(torch.zeros_like(eps)), project(near), project(far)
        if not _is_affine_and_idempotent(project, near, far, offset, on_near, on_far):
            return None
        return on_near + (far - on_far) + self.shift * offset


def begin(
    steps: Sequence[Step],
    schedule: Schedule,
    noise: Callable[[], torch.Tensor],
    project: Project,
    enforcement: Enforcement,
) -> tuple[torch.Tensor, Sequence[Step]]:
    """The sample at the first call, and the steps that are left; tau_L and all steps where they cannot be combined.

    They can where the enforcement keeps a stated share of the displacement and P is affine and idempotent, or where
    nothing is projected before the first call. The noise that is drawn does not depend on what is projected.
    """
    silent = list(takewhile(lambda step: not step.call, steps))
    eps = noise()
    if not silent:
        return eps, steps
    other, law = noise(), Silence()
    shares = [enforcement.keeps(schedule, step.j) for step in silent]
    for step, share in zip(silent, shares, strict=True):
        if share is None:
            return eps, steps
        law = law.after(step, share)
    tau = law.draw(eps, other, unprojected if set(shares) == {1.0} else project)
    return (eps, steps) if tau is None else (tau, steps[len(silent) :])


def _is_affine_and_idempotent(
    project: Project,
    a: torch.Tensor,
    b: torch.Tensor,
    offset: torch.Tensor,
    on_a: torch.Tensor,
    on_b: torch.Tensor,
) -> bool:
    """Whether P(P(a)) = P(a) and P(a + b) = P(a) + P(b) - P(0), asked where the chain would ask it."""
    scale = ROUNDING * float(torch.stack([x.abs().max() for x in (on_a, on_b, offset)]).max())
    idempotent = (project(on_a) - on_a).abs().max() <= scale
    additive = (project(a + b) - on_a - on_b + offset).abs().max() <= scale
    return bool(idempotent and additive)

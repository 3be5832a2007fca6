"""How wrong a network's clean estimate is, measured on the demonstrations that it was trained on.

C_i of `dadiff.diffusion.estimate` is what a right denoiser leaves open. A network's own errors e = tau_0 - tau0_hat
have another size and shape, and are seen wherever tau_0 is known: noise the demonstrations to step i and ask. What
process noise w did to a demonstration is no error of the plan, since plans are to obey G tau = g without noise. So what
w explains of e is taken off:

    C_i = Cov(e | w) = E[e e'] - E[e w'] E[w w']^-1 E[w e'].
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from dadiff.diffusion.context import Denoise
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.randomness import torch_generator
from dadiff.trajectory.covariance import Covariance

DEMONSTRATIONS = 2000
"""How many are asked about, or eight times d where that is more."""
STEPS = 16
"""How many steps of the chain are measured at most; the others take the nearest."""


@dataclass(frozen=True, eq=False)
class Measured(Estimate):
    """An estimate with measured errors; its Sigma is the error at the noisiest step.

    Args:
        errors: step i, as a string -> Cov(e | w) of shape (d, d), in the sampler's coordinates.
    """

    errors: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    def at_step(self, i: int, floor: float = 0.0, shrinkage: float = 0.0, directions: int = 0) -> Covariance:
        """C_i + floor Sigma, Sigma after shrinkage; see `Estimate.at`."""
        nearest = min(self.errors, key=lambda step: abs(int(step) - i))
        return self._kept((nearest, floor, shrinkage, directions), self._at_step)

    def _at_step(self, step: str, floor: float, shrinkage: float, directions: int) -> Covariance:
        C = Covariance.dense(self.errors[step] + floor * self.at(0.0, shrinkage=shrinkage).matrix)
        return C.leading(directions) if directions else C


def asked(count: int, d: int) -> slice:
    """Which of so many demonstrations of d numbers are asked about: evenly among them, so that all robots are.

    Raises:
        ConfigError: if they are fewer than 2 d.
    """
    if count < 2 * d:
        raise ConfigError(
            f"enforcement: metric=measured takes at least {2 * d} demonstrations of d = {d} numbers, and there are "
            f"{count}; use metric=estimate"
        )
    return slice(None, None, max(count // max(DEMONSTRATIONS, 8 * d), 1))


def measured(
    estimate: Estimate,
    denoise: Denoise,
    schedule: Schedule,
    visited: Iterable[int],
    tau: np.ndarray,
    environment: np.ndarray,
    noise: np.ndarray | None = None,
    device: str = "cpu",
) -> Measured:
    """The errors of a denoiser at the steps at which it is asked.

    Args:
        estimate: with the units that its Sigma is shrunk in.
        visited: steps i, the noisiest first.
        tau: demonstrations (N, d) in the sampler's coordinates.
        environment: their E, (N, c).
        noise: their process noise w, (N, q), where there is any.
    """
    steps = list(visited)
    w = np.zeros((len(tau), 0)) if noise is None else noise
    errors = {
        str(i): unexplained(tau - _estimate(denoise, schedule, i, tau, environment, device), w)
        for i in dict.fromkeys([*steps[:: -(-len(steps) // STEPS)], steps[-1]])
    }
    return Measured(errors[str(steps[0])], estimate.deviation, estimate.unit, estimate.layout, errors=errors)


def unexplained(e: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Cov(e | w) about 0 of rows e (N, d) and w (N, q): (d, d)."""
    left = e - w @ np.linalg.lstsq(w, e, rcond=None)[0]
    return left.T @ left / max(len(e) - w.shape[-1], 1)


def _estimate(
    denoise: Denoise, schedule: Schedule, i: int, tau: np.ndarray, environment: np.ndarray, device: str
) -> np.ndarray:
    """tau0_hat (N, d) of demonstrations after i steps of the forward process."""
    import torch

    a, generator = float(schedule.alpha_bar[i]), torch_generator(0, "measuring the estimate")
    eps = torch.randn(tau.shape, generator=generator, dtype=torch.float64)
    noised = a**0.5 * torch.as_tensor(tau) + (1 - a) ** 0.5 * eps
    with torch.inference_mode():
        tau0_hat = denoise(noised.to(device), i, torch.as_tensor(environment, device=device))
    return np.asarray(tau0_hat.cpu())

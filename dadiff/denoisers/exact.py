"""The exact denoiser of a Gaussian law: E[tau_0 | tau_i, E], without training.

It separates what projecting does from what a network gets wrong, and makes samplers and Theorem 1 testable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import torch
from torch import Tensor

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ShapeError
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.response import along, beside


class Law(Protocol):
    """tau | E ~ N(mean_map E + offset, noise_map noise_map').

    mean_map (*robots, d, c), offset (*robots, d), noise_map (*robots, d, k).
    """

    @property
    def mean_map(self) -> np.ndarray: ...

    @property
    def offset(self) -> np.ndarray: ...

    @property
    def noise_map(self) -> np.ndarray: ...

    def mean(self, ends: np.ndarray) -> np.ndarray: ...


class ExactDenoiser:
    """The posterior mean in scaled coordinates z = D^-1 (tau - mean).

    With mu = D^-1 (mean_map E + offset - mean), D^-1 noise_map noise_map' D^-1 = U diag(variance) U', a = alpha_bar_i,

        tau0_hat = mu + U diag( sqrt(a) variance / (a variance + 1 - a) ) U' (tau_i - sqrt(a) mu).

    Finite for every alpha_bar in [0, 1), 0 included; the covariance may be singular.

    Attributes:
        basis: U, (*robots, d, r).
        variance: (*robots, r); directions that are noise only by rounding have exactly 0.
    """

    def __init__(self, law: Law, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> None:
        self.made_from = ExactParts(law, coordinates, schedule)
        self.alpha_bar = schedule.alpha_bar
        scale = coordinates.scale[:, None]
        U, s, _ = np.linalg.svd(law.noise_map / scale, full_matrices=False)
        rounding = s.max(axis=-1, keepdims=True, initial=0) * max(law.noise_map.shape[-2:]) * np.finfo(float).eps
        self.variance = np.where(s > rounding, s, 0) ** 2
        self.basis = torch.tensor(U, device=device)
        self._mean_map = torch.tensor(law.mean_map / scale, device=device)
        self._offset = torch.tensor((coordinates.mean - law.offset) / coordinates.scale, device=device)

    def state_dict(self) -> dict[str, Tensor]:
        """Nothing: it has no weights."""
        return {}

    def mean(self, environment: Tensor) -> Tensor:
        """mu (*robots, ..., d), the scaled mean given E (*robots, ..., c)."""
        if environment.shape[-1] != self._mean_map.shape[-1]:
            raise ShapeError(
                f"denoiser: the environment has {environment.shape[-1]} entries; the law was made for "
                f"{self._mean_map.shape[-1]}"
            )
        mean = _along(self._mean_map, environment)
        return mean - _beside(self._offset, mean)

    @torch.inference_mode()
    def __call__(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """tau0_hat (*robots, ..., d) from tau of the same shape, i in 1..L and E (*robots, ..., c)."""
        return self.estimate(tau, i, environment)

    def estimate(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """The same, recorded by autograd."""
        mu, a = self.mean(environment), float(self.alpha_bar[i])
        deviation = _along(self.basis.mT, tau - a**0.5 * mu)
        return mu + _along(self.basis, _beside(self._gain(a), tau) * deviation)

    def _gain(self, a: float) -> Tensor:
        """sqrt(a) variance / (a variance + 1 - a), and 0 where variance is 0, (*robots, r)."""
        gain = np.sqrt(a) * self.variance / (a * self.variance + (1 - a))
        return torch.as_tensor(gain, device=self.basis.device)


@dataclass(frozen=True)
class ExactParts:
    """What an exact denoiser is made from."""

    law: Law
    coordinates: Coordinates
    schedule: Schedule

    @property
    def sizes(self) -> tuple[int, int]:
        """d, and entries of E."""
        return self.law.mean_map.shape[-2], self.law.mean_map.shape[-1]

    def build(self, device: str) -> ExactDenoiser:
        """The denoiser."""
        return ExactDenoiser(self.law, self.coordinates, self.schedule, device)


def _along(M: Tensor, vectors: Tensor) -> Tensor:
    """`trajectory.response.along`, which needs no more than numpy and torch have in common."""
    return cast(Tensor, along(cast(np.ndarray, M), cast(np.ndarray, vectors)))


def _beside(c: Tensor, vectors: Tensor) -> Tensor:
    """`trajectory.response.beside`, likewise."""
    return cast(Tensor, beside(cast(np.ndarray, c), cast(np.ndarray, vectors)))

"""The exact denoiser of a Gaussian law: E[tau_0 | tau_i, E], without training.

It separates what projecting does from what a network gets wrong, and makes samplers and Theorem 1 testable.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import torch
from torch import Tensor

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ShapeError
from dadiff.experts.lqr import ClosedLoopLaw
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.response import along, beside

KEPT = 64  # steps of a chain whose gains are held, the oldest given up first


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


class PosteriorMean(ABC):
    """E[tau_0 | tau_i, E] of a Gaussian law, in scaled coordinates z = D^-1 (tau - mean); see its two forms."""

    def __init__(self, law: Law, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> None:
        self.made_from = ExactParts(law, coordinates, schedule)
        self.alpha_bar = schedule.alpha_bar
        self._mean_map = torch.tensor(law.mean_map / coordinates.scale[:, None], device=device)
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
        mu = self.mean(environment)
        return mu + self.shrunk(tau - float(self.alpha_bar[i]) ** 0.5 * mu, i)

    @abstractmethod
    def shrunk(self, residual: Tensor, i: int) -> Tensor:
        """What of tau_i - sqrt(alpha_bar_i) mu (*robots, ..., d) is signal, as far as is to be expected."""


class ExactDenoiser(PosteriorMean):
    """The posterior mean by an eigendecomposition of the law.

    With mu = D^-1 (mean_map E + offset - mean), D^-1 noise_map noise_map' D^-1 = U diag(variance) U', a = alpha_bar_i,

        tau0_hat = mu + U diag( sqrt(a) variance / (a variance + 1 - a) ) U' (tau_i - sqrt(a) mu).

    Finite for every alpha_bar in [0, 1), 0 included; the covariance may be singular.

    Attributes:
        basis: U, (*robots, d, r).
        variance: (*robots, r); directions that are noise only by rounding have exactly 0.
    """

    def __init__(self, law: Law, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> None:
        super().__init__(law, coordinates, schedule, device)
        U, s, _ = np.linalg.svd(law.noise_map / coordinates.scale[:, None], full_matrices=False)
        rounding = s.max(axis=-1, keepdims=True, initial=0) * max(law.noise_map.shape[-2:]) * np.finfo(float).eps
        self.variance = np.where(s > rounding, s, 0) ** 2
        self.basis = torch.tensor(U, device=device)

    def shrunk(self, residual: Tensor, i: int) -> Tensor:
        """U diag(gain) U' of it."""
        deviation = _along(self.basis.mT, residual)
        return _along(self.basis, _beside(self._gain(float(self.alpha_bar[i])), residual) * deviation)

    def _gain(self, a: float) -> Tensor:
        """sqrt(a) variance / (a variance + 1 - a), and 0 where variance is 0, (*robots, r)."""
        gain = np.sqrt(a) * self.variance / (a * self.variance + (1 - a))
        return torch.as_tensor(gain, device=self.basis.device)


class Smoother(PosteriorMean):
    """The posterior mean of a closed loop's law in O(T) for each plan, where an eigendecomposition takes minutes.

    About its mean the law is x(t+1) = A_t x(t) + S w(t), x(0) = 0, u(t) = K_t x(t) with unit noise w. Given tau_i, with
    r = tau_i - sqrt(a) mu and the channels' scales D_x, D_u, its most likely trajectory minimises

        sum_t |w(t)|^2 + x(t)' M_t x(t) - 2 q(t)' x(t),    M_t = a / (1 - a) (D_x^-2 + K_t' D_u^-2 K_t),
                                                      q(t) = sqrt(a) / (1 - a) (D_x^-1 r_x(t) + K_t' D_u^-1 r_u(t)),

    a linear-quadratic problem. From P = M_T, p = q(T), going backwards,

        W_t = S (I + S P S)^-1 S,    C_t = (I - W_t P) A_t,    P <- M_t + A_t' P C_t,    p(t) = q(t) + C_t' p(t+1),

    and forwards x(t+1) = C_t x(t) + W_t p(t+1).
    """

    def __init__(self, law: ClosedLoopLaw, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> None:
        super().__init__(law, coordinates, schedule, device)
        self.layout = law.system.layout(law.feedback.horizon)
        x, u = self.layout.split(coordinates.scale)
        K = law.feedback.K / u[..., None]
        self._weight = K.swapaxes(-1, -2) @ K + np.eye(x.shape[-1]) / x[:-1, None] ** 2  # of x(0:T-1), and of x(T):
        self._last = np.eye(x.shape[-1]) / x[-1] ** 2
        self._closed, self._S = law.closed, np.diag(law.deviations)
        self._K, self._unit = torch.tensor(K, device=device), torch.tensor(1 / x, device=device)
        self._gains: dict[int, tuple[Tensor, Tensor]] = {}

    def shrunk(self, residual: Tensor, i: int) -> Tensor:
        """See the class."""
        a, lead = float(self.alpha_bar[i]), residual.shape[:-1]
        C, W = self._made(i)
        robots = C.shape[:-3]
        r_x, r_u = self.layout.split(residual.reshape(*robots, -1, residual.shape[-1]))
        T, p = r_u.shape[-2], [r_x[..., -1, :] * self._unit[-1]]
        for t in reversed(range(T)):
            q = r_x[..., t, :] * self._unit[t] + r_u[..., t, :] @ self._K[..., t, :, :]
            p.append(q + p[-1] @ C[..., t, :, :])
        x, factor = [0 * p[-1]], a**0.5 / (1 - a)
        for t in range(T):
            x.append(x[t] @ C[..., t, :, :].mT + factor * p[T - 1 - t] @ W[..., t, :, :])
        u = torch.stack([x[t] @ self._K[..., t, :, :].mT for t in range(T)], dim=-2)
        found = self.layout.flatten(torch.stack(x, dim=-2) * self._unit, u)
        return found.reshape(*lead, -1)

    def _made(self, i: int) -> tuple[Tensor, Tensor]:
        """C and W of step i, (*robots, T, n, n) each; kept for the steps that few-step samplers visit."""
        if i not in self._gains:
            if len(self._gains) == KEPT:
                del self._gains[next(iter(self._gains))]
            self._gains[i] = self._riccati(float(self.alpha_bar[i]))
        return self._gains[i]

    def _riccati(self, a: float) -> tuple[Tensor, Tensor]:
        A, S, g = self._closed, self._S, a / (1 - a)
        identity, C, W = np.eye(len(S)), np.empty_like(A), np.empty_like(A)
        P = g * self._last
        for t in reversed(range(A.shape[-3])):
            A_t = A[..., t, :, :]
            W[..., t, :, :] = S @ np.linalg.solve(identity + S @ P @ S, np.broadcast_to(S, A_t.shape))
            C[..., t, :, :] = (identity - W[..., t, :, :] @ P) @ A_t
            P = g * self._weight[..., t, :, :] + A_t.swapaxes(-1, -2) @ P @ C[..., t, :, :]
            P = (P + P.swapaxes(-1, -2)) / 2
        return torch.tensor(C, device=self._K.device), torch.tensor(W, device=self._K.device)


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

    def build(self, device: str) -> PosteriorMean:
        """The denoiser, in the form that suits its size."""
        if isinstance(self.law, ClosedLoopLaw) and self.law.is_long:
            return Smoother(self.law, self.coordinates, self.schedule, device)
        return ExactDenoiser(self.law, self.coordinates, self.schedule, device)


def _along(M: Tensor, vectors: Tensor) -> Tensor:
    """`trajectory.response.along`, which needs no more than numpy and torch have in common."""
    return cast(Tensor, along(cast(np.ndarray, M), cast(np.ndarray, vectors)))


def _beside(c: Tensor, vectors: Tensor) -> Tensor:
    """`trajectory.response.beside`, likewise."""
    return cast(Tensor, beside(cast(np.ndarray, c), cast(np.ndarray, vectors)))

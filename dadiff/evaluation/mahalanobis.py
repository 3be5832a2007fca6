"""The distance of Theorem 1: how far a sample is from the law of optimal trajectories.

The law's covariance is singular (x(0) is given, u(0) deterministic), so its inverse does not exist. The distance is
measured on its support with the pseudo-inverse, and the part off the support is kept beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.experts.lqr import ClosedLoopLaw, GaussianLaw
from dadiff.trajectory.subspace import rank_tolerance


@dataclass(frozen=True)
class MahalanobisDistance:
    """(tau - mu)' Sigma^+ (tau - mu), and |(I - U U')(tau - mu)|^2 with U a basis of Sigma's image.

    Args:
        mean: mu of each plan, (plans, d).
        support: U, (d, k).
        deviations: standard deviations along U, (k,).
    """

    mean: np.ndarray = field(repr=False)
    support: np.ndarray = field(repr=False)
    deviations: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, law: GaussianLaw, environment: np.ndarray) -> MahalanobisDistance:
        """The distance to the law given E (plans, c)."""
        U, s, _ = np.linalg.svd(law.noise_map, full_matrices=False)
        kept = s > rank_tolerance(s, law.noise_map.shape)
        return cls(law.mean(environment), U[:, kept], s[kept])

    def __call__(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(on the support, off the support) of tau (plans, d), each (plans,)."""
        deviation = tau - self.mean
        along = deviation @ self.support
        off = deviation - along @ self.support.T
        return np.square(along / self.deviations).sum(-1), np.square(off).sum(-1)


@dataclass(frozen=True)
class ClosedLoopDistance:
    """The same to the law of one closed loop with noise in every state, in O(T).

    About the mean its support is x(0) = 0, u(t) = K(t) x(t). The nearest point of it is x(t) = (I + K'K)^-1 (x + K'u),
    step by step, and its distance sum_t |w(t) / sigma|^2 of the w that leads along it.
    """

    law: ClosedLoopLaw
    mean: np.ndarray = field(repr=False)

    def __call__(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `MahalanobisDistance.__call__`."""
        K, closed = self.law.feedback.K, self.law.closed
        x, u = self.law.system.layout(self.law.feedback.horizon).split(tau - self.mean)
        nearest = x.copy()
        along = x[:, :-1] + np.einsum("tmn,ktm->ktn", K, u)
        nearest[:, :-1] = np.linalg.solve(np.eye(x.shape[-1]) + K.mT @ K, along[..., None])[..., 0]
        nearest[:, 0] = 0
        w = nearest[:, 1:] - np.einsum("tij,ktj->kti", closed, nearest[:, :-1])
        off = np.square(nearest - x).sum((-2, -1))
        off += np.square(np.einsum("tmn,ktn->ktm", K, nearest[:, :-1]) - u).sum((-2, -1))
        return np.square(w / self.law.deviations).sum((-2, -1)), off


def distance_to(law: GaussianLaw, environment: np.ndarray) -> MahalanobisDistance | ClosedLoopDistance:
    """The distance to the law given E (plans, c), in the form that suits its size."""
    if isinstance(law, ClosedLoopLaw) and law.is_long and (law.deviations > 0).all():
        return ClosedLoopDistance(law, law.mean(environment))
    return MahalanobisDistance.of(law, environment)

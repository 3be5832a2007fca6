"""The distance of Theorem 1: how far a sample is from the law of optimal trajectories.

The law's covariance is singular (x(0) is given, u(0) deterministic), so its inverse does not exist. The distance is
measured on its support with the pseudo-inverse, and the part off the support is kept beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.experts.lqr import GaussianLaw
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

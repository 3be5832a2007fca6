"""Covariances of trajectories: C = diag(D) + U U', which is dense where U has d columns.

A projection weighs its correction by one: what is known badly is moved most. Of nearly low rank, C costs O(dk), so
that dynamics are projected onto in O(T).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.response import along
from dadiff.trajectory.subspace import semidefinite_root

DIRECTIONS = 20
"""Directions of a covariance without a diagonal that are kept; the variances of the others go to its diagonal."""

LEAST = 1e-6
"""Of the mean variance: what an entry is given on the diagonal where a covariance takes it for certain."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """C = diag(D) + U U'. Two are the same only if they are one object: projections keep what they compute from it.

    Args:
        diagonal: D of shape (*batch, d), not negative.
        factor: U of shape (*batch, d, k); k = 0 for a diagonal C.

    Raises:
        ShapeError, ConfigError: if the shapes disagree or D has a negative entry.
    """

    diagonal: np.ndarray = field(repr=False)
    factor: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        if self.factor.ndim < 2 or self.factor.shape[:-1] != self.diagonal.shape:
            raise ShapeError(
                f"covariance: D has shape {self.diagonal.shape}, U {self.factor.shape}; expected (..., d), (..., d, k)"
            )
        if not (self.diagonal >= 0).all():
            raise ConfigError("covariance: a variance on the diagonal is negative or not finite")

    @classmethod
    def diagonal_of(cls, variances: np.ndarray) -> Covariance:
        """diag(D) from D (*batch, d)."""
        return cls(variances, np.zeros((*variances.shape, 0)))

    @classmethod
    def dense(cls, matrix: np.ndarray) -> Covariance:
        """A symmetric positive semidefinite matrix (*batch, d, d)."""
        return cls(np.zeros(matrix.shape[:-1]), semidefinite_root(matrix))

    @property
    def size(self) -> int:
        """d."""
        return self.diagonal.shape[-1]

    @property
    def matrix(self) -> np.ndarray:
        """C, (*batch, d, d)."""
        full = self.factor @ self.factor.swapaxes(-1, -2)
        np.einsum("...ii->...i", full)[...] += self.diagonal
        return full

    def times(self, v: np.ndarray) -> np.ndarray:
        """C v for vectors (*batch, ..., d)."""
        weights = self.diagonal.reshape(*self.diagonal.shape[:-1], *(1,) * (v.ndim - self.diagonal.ndim), self.size)
        return weights * v + along(self.factor, along(self.factor.swapaxes(-1, -2), v))

    def scaled(self, a: float) -> Covariance:
        """a C with a >= 0."""
        return Covariance(a * self.diagonal, np.sqrt(a) * self.factor)

    def rescaled(self, scale: np.ndarray) -> Covariance:
        """S C S with S = diag(scale): the covariance of S z from that of z."""
        return Covariance(scale**2 * self.diagonal, scale[:, None] * self.factor)

    def leading(self, count: int) -> Covariance:
        """The `count` leading directions of C, and of the others the variances alone; see `of_spectrum`."""
        return Covariance.of_spectrum(*np.linalg.eigh(self.matrix), count)

    @cached_property
    def invertible(self) -> Covariance:
        """C as D + U U' with a positive D: itself, or its DIRECTIONS leading ones; found once.

        Entries that it takes for certain are given LEAST of the mean variance.
        """
        spread = self if self.diagonal.all() else self.leading(DIRECTIONS)
        variances = spread.diagonal + np.square(spread.factor).sum(axis=-1)
        return Covariance(np.maximum(spread.diagonal, LEAST * variances.mean()), spread.factor)

    @classmethod
    def of_spectrum(cls, values: np.ndarray, vectors: np.ndarray, count: int) -> Covariance:
        """diag(D) + U U' with U of k = count columns, from rising eigenvalues (*batch, d) and eigenvectors.

        The variance of every entry is kept. As in probabilistic PCA, U takes of each direction what exceeds the mean
        of the others, so that equal variances beside that many directions are kept as they are.
        """
        first = values.shape[-1] - count
        others = values[..., :first].mean(axis=-1, keepdims=True) if first > 0 else 0.0
        factor = vectors[..., first:] * np.sqrt(np.maximum(values[..., first:] - others, 0))[..., None, :]
        variance = np.einsum("...ik,...k,...ik->...i", vectors, values, vectors, optimize=True)
        return cls(np.maximum(variance - np.square(factor).sum(axis=-1), 0), factor)

    def given(self, places: Sequence[int] | np.ndarray) -> tuple[Covariance, np.ndarray]:
        """What is left once entries E z (k,) are known, and the gain with which they move the others.

            gain = C E' (E C E')^+,    C - gain E C

        It has the same form, with D = 0 and U = 0 at the known entries. Those whose variance is rounding were known
        before, and move nothing.

        Returns:
            (C given E z, gain (*batch, d, k)).
        """
        D, U = self.diagonal, self.factor
        D_p, U_p = D[..., places], U[..., places, :]
        certain = D_p + np.square(U_p).sum(axis=-1) <= self._rounding
        D_p, U_p = np.where(certain, 0, D_p), np.where(certain[..., None], 0, U_p)
        inner = U_p @ U_p.swapaxes(-1, -2)
        np.einsum("...ii->...i", inner)[...] += D_p
        inverse = np.linalg.pinv(inner, hermitian=True)
        gain = U @ (U_p.swapaxes(-1, -2) @ inverse)
        gain[..., places, :] += D_p[..., :, None] * inverse
        left = np.eye(U.shape[-1]) - U_p.swapaxes(-1, -2) @ inverse @ U_p
        remaining, D = U @ semidefinite_root(left), D.copy()
        D[..., places], remaining[..., places, :] = 0, 0
        return Covariance(D, remaining), gain

    @property
    def _rounding(self) -> np.ndarray:
        """What a variance of 0 may become by rounding, (*batch, 1): in a factor that is the root of a covariance."""
        variance = self.diagonal + np.square(self.factor).sum(axis=-1)
        return self.size * np.finfo(np.float64).eps * variance.max(axis=-1, keepdims=True)

    def colour(self, eps: Array, more: Array) -> Array:
        """A draw of N(0, C) from two of unit noise (*batch, ..., d), numpy or torch; k entries of `more` count."""
        weights = self.diagonal**0.5
        weights = weights.reshape(*weights.shape[:-1], *(1,) * (eps.ndim - weights.ndim), self.size)
        return weights * eps + along(self.factor, more[..., : self.factor.shape[-1]])

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...] = ()) -> np.ndarray:
        """Samples of N(0, C), (*batch, *shape, d)."""
        drawn = (*self.diagonal.shape[:-1], *shape)
        eps, more = (rng.standard_normal((*drawn, size)) for size in (self.size, self.factor.shape[-1]))
        return self.colour(eps, more)

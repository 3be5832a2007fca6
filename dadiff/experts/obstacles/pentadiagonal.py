"""Block pentadiagonal systems with 2 x 2 blocks: M = L D L' over time, many systems side by side.

The matrix has symmetric blocks M[k,k] that differ between systems, and off the diagonal multiples of the identity
that all systems share: M[k,k-1] = first[k] I and M[k,k-2] = second[k] I. That is
the Hessian of a sum of squared second differences plus terms of one position each. The batch is the last axis,
so that every operation runs along contiguous memory; nothing loops over the batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Factor:
    """L and D^-1 of M = L D L'.

    Args:
        inverse: D[k]^-1, (K, 2, 2, N), symmetric.
        lower: L[k,k-1], (K, 2, 2, N); L[k,k-2] = second[k] D[k-2]^-1 need not be stored.
        second: (K,) with M[k,k-2] = second[k] I.
        definite: (N,), whether every pivot block, hence M, is positive definite.
    """

    inverse: np.ndarray
    lower: np.ndarray
    second: np.ndarray
    definite: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """M^-1 right, for right of shape (K, 2, N): forward, divide by the pivots, backward."""
        K = len(right)
        y, z = right.copy(), np.empty_like(right)
        for k in range(K):
            if k >= 1:
                y[k] -= _apply(self.lower[k], y[k - 1])
            if k >= 2:
                y[k] -= self.second[k] * z[k - 2]
            z[k] = _apply(self.inverse[k], y[k])
        x = z
        for k in range(K - 2, -1, -1):
            if k + 2 < K:
                x[k] -= self.second[k + 2] * _apply(self.inverse[k], x[k + 2])
            x[k] -= _apply_transposed(self.lower[k + 1], x[k + 1])
        return x


def factorise(diagonal: np.ndarray, first: np.ndarray, second: np.ndarray) -> Factor:
    """L D L' of the matrix with M[k,k] = diagonal[k], M[k,k-1] = first[k] I, M[k,k-2] = second[k] I.

    With C[k] = M[k,k-1] - second[k] L[k-1,k-2]', the recursion over k = 0..K-1 is

        L[k,k-1] = C[k] D[k-1]^-1,   D[k] = M[k,k] - L[k,k-1] C[k]' - second[k]^2 D[k-2]^-1

    Args:
        diagonal: (K, 2, 2, N), symmetric blocks.
        first, second: (K,), of which the first one and the first two entries are not read.
    """
    K = len(diagonal)
    inverse, lower = np.empty_like(diagonal), np.zeros_like(diagonal)
    definite = np.ones(diagonal.shape[-1], dtype=bool)
    identity = np.eye(2)[:, :, None]
    for k in range(K):
        pivot = diagonal[k]
        if k >= 1:
            C = first[k] * identity - second[k] * lower[k - 1].swapaxes(0, 1) if k >= 2 else first[k] * identity
            lower[k] = _multiply(C, inverse[k - 1])
            pivot = pivot - _multiply(lower[k], C.swapaxes(0, 1))
        if k >= 2:
            pivot -= second[k] ** 2 * inverse[k - 2]
        inverse[k], positive = _invert(pivot)
        definite &= positive
    return Factor(inverse, lower, second, definite)


def _invert(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of symmetric (2, 2, N), and (N,) whether it is positive definite."""
    a, b, d = block[0, 0], block[0, 1], block[1, 1]
    determinant = a * d - b * b
    inverse = np.empty_like(block)
    np.divide(d, determinant, out=inverse[0, 0])
    np.divide(a, determinant, out=inverse[1, 1])
    np.divide(-b, determinant, out=inverse[0, 1])
    inverse[1, 0] = inverse[0, 1]
    return inverse, (a > 0) & (determinant > 0)


def _multiply(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """X Y for (2, 2, N)."""
    return X[:, :1] * Y[:1] + X[:, 1:] * Y[1:]


def _apply(X: np.ndarray, v: np.ndarray) -> np.ndarray:
    """X v for (2, 2, N) and (2, N)."""
    return X[:, 0] * v[0] + X[:, 1] * v[1]


def _apply_transposed(X: np.ndarray, v: np.ndarray) -> np.ndarray:
    """X' v for (2, 2, N) and (2, N)."""
    return X[0] * v[0] + X[1] * v[1]


@dataclass(frozen=True)
class Band:
    """Entries of D'D for the second-difference matrix D (K, K), D q = q[k] - 2 q[k-1] + q[k-2] (q[-1] = q[-2] = 0).

    Args:
        diagonal, first, second: (K,), of [k,k], [k,k-1] and [k,k-2]; what would lie outside the matrix is 0.
    """

    diagonal: np.ndarray
    first: np.ndarray
    second: np.ndarray


def squared_second_difference(K: int) -> Band:
    """D'D: rows (1, -4, 6, -4, 1), shorter at the end, where no later difference reaches."""
    D = np.eye(K) - 2 * np.eye(K, k=-1) + np.eye(K, k=-2)
    G = D.T @ D

    def entries(below: int) -> np.ndarray:
        return np.concatenate([np.zeros(min(below, K)), np.diagonal(G, -below)])[:K]

    return Band(entries(0), entries(1), entries(2))

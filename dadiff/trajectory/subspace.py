"""Subspaces of trajectories: orthonormal bases, the one rule for ranks, and distances between images."""

from __future__ import annotations

import numpy as np


def rank_tolerance(singular_values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """max(rows, columns) * eps * s_max: below it a singular value counts as zero. The project's one rank rule."""
    return max(shape[-2:]) * np.finfo(np.float64).eps * singular_values[..., :1]


def numerical_rank(M: np.ndarray) -> int:
    """The rank of M (rows, columns); of a batch, the smallest."""
    s = np.linalg.svd(M, compute_uv=False)
    return int((s > rank_tolerance(s, M.shape)).sum(axis=-1).min())


def column_scaled(M: np.ndarray) -> np.ndarray:
    """M (..., rows, columns) with columns of length 1, so that its rank does not depend on units; zeros stay zero."""
    size = np.linalg.norm(M, axis=-2, keepdims=True)
    return M / np.where(size > 0, size, 1.0)


def column_basis(M: np.ndarray) -> np.ndarray:
    """Orthonormal basis (..., rows, columns) of the image of M, which has full column rank."""
    return np.linalg.qr(M)[0]


def null_space(M: np.ndarray) -> np.ndarray:
    """Orthonormal basis (..., columns, columns - rows) of the kernel of M, which has full row rank."""
    Q, _ = np.linalg.qr(M.swapaxes(-1, -2), mode="complete")
    return Q[..., M.shape[-2] :]


def largest_angle(U: np.ndarray, V: np.ndarray) -> np.ndarray:
    """The largest principal angle (radians) between the images of orthonormal bases (..., d, r) and (..., d, s).

    arcsin |P_U - P_V|_2: pi/2 as soon as the dimensions differ.
    """
    if U.shape[-1] != V.shape[-1]:
        return np.full(np.broadcast_shapes(U.shape[:-2], V.shape[:-2]), np.pi / 2)
    outside = V - U @ (U.swapaxes(-1, -2) @ V)
    return np.arcsin(np.clip(np.linalg.norm(outside, ord=2, axis=(-2, -1)), 0, 1))


def projector_distance(U: np.ndarray, V: np.ndarray) -> np.ndarray:
    """|P_U - P_V|_F / sqrt(2 s): 0 for equal images, 1 for orthogonal ones of equal dimension s.

    |P_U - P_V|^2 = |(I - P_V) U|^2 + |(I - P_U) V|^2, which does not cancel where the images are close.
    """
    overlap = U.swapaxes(-1, -2) @ V
    outside = [U - V @ overlap.swapaxes(-1, -2), V - U @ overlap]
    return np.sqrt(sum(np.square(part).sum(axis=(-2, -1)) for part in outside) / (2 * V.shape[-1]))


def semidefinite_root(M: np.ndarray) -> np.ndarray:
    """L with L L' = M (..., d, d), symmetric positive semidefinite; what rounding makes negative counts as 0."""
    values, vectors = np.linalg.eigh(M)
    return vectors * np.sqrt(np.maximum(values, 0))[..., None, :]


def semidefinite_inverse(M: np.ndarray, rounding: np.ndarray | float = 0.0) -> np.ndarray:
    """M^+ of a symmetric positive semidefinite M (..., d, d), after its rows are scaled to a diagonal of 1.

    Scaling makes the one rank rule independent of units.

    Args:
        rounding: (..., d), what an entry of the diagonal may be that is 0 but for rounding; such rows count as 0.
    """
    size = np.einsum("...ii->...i", M)
    some = size > rounding
    scale = np.sqrt(np.where(some, size, 1.0))
    across = scale[..., :, None] * scale[..., None, :]
    M = np.where(some[..., :, None] & some[..., None, :], M, 0.0)
    return np.linalg.pinv(M / across, rcond=M.shape[-1] * np.finfo(np.float64).eps, hermitian=True) / across


def regression(values: np.ndarray, regressors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares values = regressors coefficients + intercept + residual.

    Entries that the regressors determine up to rounding, such as x(0) by E, have a residual of exactly 0: a deviation
    that is rounding would be taken for one that can be learned from.

    Args:
        values: (N, d).
        regressors: (N, c).

    Returns:
        coefficients (c, d), intercept (d,), residual (N, d).
    """
    design = np.concatenate([regressors, np.ones((len(regressors), 1))], axis=-1)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    residual = values - design @ solution
    size = np.abs(values).max(axis=0, initial=0)
    residual[:, np.abs(residual).max(axis=0, initial=0) <= np.sqrt(np.finfo(np.float64).eps) * size] = 0
    return solution[:-1], solution[-1], residual

"""Responses of linear systems over a horizon, and the trajectory map F (eq. 4 of the paper).

    x(0:T) = 𝒜 x(0) + 𝒞_T u(0:T-1),    tau = F [x(0); u(0:T-1)],    F = [[𝒜, 𝒞_T], [0, I]]

Matrices are given for every step, A (..., T, n, n) and B (..., T, n, m), so that they may vary; leading dimensions are
robots. Where the dynamics have an offset c, tau = F [x(0); u] + the roll-out from rest without inputs.
"""

from __future__ import annotations

from math import prod

import numpy as np

from dadiff.trajectory.layout import TrajectoryLayout


def layout_of(A: np.ndarray, B: np.ndarray) -> TrajectoryLayout:
    """The layout of trajectories of (A (..., T, n, n), B (..., T, n, m))."""
    return TrajectoryLayout(A.shape[-1], B.shape[-1], A.shape[-3])


def free_response(A: np.ndarray) -> np.ndarray:
    """𝒜 = [I; A_0; A_1 A_0; ...] of shape (..., n(T+1), n)."""
    *lead, T, n, _ = A.shape
    blocks = np.empty((*lead, T + 1, n, n))
    blocks[..., 0, :, :] = np.eye(n)
    for t in range(T):
        blocks[..., t + 1, :, :] = A[..., t, :, :] @ blocks[..., t, :, :]
    return blocks.reshape(*lead, -1, n)


def forced_response(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """𝒞_T of shape (..., n(T+1), mT): block (t, s) is A_(t-1) ... A_(s+1) B_s for s < t, else 0."""
    *lead, T, n, m = B.shape
    blocks = np.zeros((*lead, T + 1, n, T * m))
    for t in range(T):
        now, following = blocks[..., t, :, : t * m], blocks[..., t + 1, :, :]
        following[..., : t * m] = A[..., t, :, :] @ now
        following[..., t * m : (t + 1) * m] = B[..., t, :, :]
    return blocks.reshape(*lead, -1, T * m)


def trajectory_map(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """F = [[𝒜, 𝒞_T], [0, I]] of shape (..., d, n + mT), eq. (4)."""
    layout = layout_of(A, B)
    F = np.zeros((*A.shape[:-3], layout.size, layout.rank))
    F[..., layout.all_states, layout.initial_state] = free_response(A)
    F[..., layout.all_states, layout.state_dim :] = forced_response(A, B)
    F[..., layout.all_inputs, layout.state_dim :] = np.eye(layout.rank - layout.state_dim)
    return F


def along(M: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """M v for every vector: M (*robots, a, b) and vectors (*robots, ..., b) give (*robots, ..., a).

    The batch dimensions of M are the *first* of the vectors; all others share the matrix, so that one matrix
    product serves them all.
    """
    lead = M.shape[:-2]
    flat = vectors.reshape(*vectors.shape[: len(lead)], prod(vectors.shape[len(lead) : -1]), vectors.shape[-1])
    result = flat @ M.swapaxes(-1, -2)
    return result.reshape(*result.shape[: len(lead)], *vectors.shape[len(lead) : -1], M.shape[-2])


def beside(c: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """c (*robots, n) with as many dimensions as the vectors (*robots, ..., n) that it is added to."""
    return c.reshape(*c.shape[:-1], *(1,) * (vectors.ndim - c.ndim), c.shape[-1])


def simulate(
    A: np.ndarray, B: np.ndarray, x_init: np.ndarray, inputs: np.ndarray, noise: np.ndarray | None = None
) -> np.ndarray:
    """Roll out x(t+1) = A x(t) + B u(t) + w(t), eq. (1), with A and B that do not vary.

    Args:
        A, B: (*robots, n, n) and (*robots, n, m).
        x_init: (*robots, ..., n); what stands between may broadcast against the inputs.
        inputs: (*robots, ..., T, m).
        noise: w, all that is added, (*robots, ..., T, n), or None for none.

    Returns:
        States x(0:T) of shape (*robots, ..., T+1, n). Values that leave float range stay inf or nan.
    """
    T = inputs.shape[-2]
    lead = np.broadcast_shapes(x_init.shape[:-1], inputs.shape[:-2])
    states = np.empty((*lead, T + 1, x_init.shape[-1]))
    states[..., 0, :] = x_init
    with np.errstate(over="ignore", invalid="ignore"):
        forced = along(B, inputs)
        if noise is not None:
            forced = forced + noise
        for t in range(T):
            states[..., t + 1, :] = along(A, states[..., t, :]) + forced[..., t, :]
    return states

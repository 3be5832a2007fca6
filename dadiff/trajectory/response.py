"""Responses of a linear system over a horizon, and the trajectory map F (eq. 4 of the paper).

    x(0:T) = 𝒜 x(0) + 𝒞_T u(0:T-1),    tau = F [x(0); u(0:T-1)],    F = [[𝒜, 𝒞_T], [0, I]]

Every function accepts leading batch dimensions on A and B: one matrix pair a robot. Robots come first.
"""

from __future__ import annotations

import numpy as np

from dadiff.trajectory.layout import TrajectoryLayout


def layout_of(A: np.ndarray, B: np.ndarray, horizon: int) -> TrajectoryLayout:
    """The layout of trajectories of (A (..., n, n), B (..., n, m)) over T inputs."""
    return TrajectoryLayout(A.shape[-1], B.shape[-1], horizon)


def powers(A: np.ndarray, horizon: int) -> np.ndarray:
    """I, A, ..., A^T of shape (..., T+1, n, n)."""
    n = A.shape[-1]
    result = np.empty((*A.shape[:-2], horizon + 1, n, n))
    result[..., 0, :, :] = np.eye(n)
    for t in range(horizon):
        result[..., t + 1, :, :] = A @ result[..., t, :, :]
    return result


def free_response(A: np.ndarray, horizon: int) -> np.ndarray:
    """𝒜 = [I; A; ...; A^T] of shape (..., n(T+1), n)."""
    P = powers(A, horizon)
    return P.reshape(*A.shape[:-2], -1, A.shape[-1])


def forced_response(A: np.ndarray, B: np.ndarray, horizon: int) -> np.ndarray:
    """𝒞_T of shape (..., n(T+1), mT): block (t, s) is A^(t-1-s) B for s < t, else 0."""
    n, m = B.shape[-2:]
    AB = powers(A, horizon - 1) @ B[..., None, :, :]  # A^k B for k = 0..T-1
    C = np.zeros((*A.shape[:-2], horizon + 1, n, horizon, m))
    for s in range(horizon):
        C[..., s + 1 :, :, s, :] = AB[..., : horizon - s, :, :]
    return C.reshape(*A.shape[:-2], n * (horizon + 1), horizon * m)


def trajectory_map(A: np.ndarray, B: np.ndarray, horizon: int) -> np.ndarray:
    """F = [[𝒜, 𝒞_T], [0, I]] of shape (..., d, n + mT), eq. (4)."""
    layout = layout_of(A, B, horizon)
    F = np.zeros((*A.shape[:-2], layout.size, layout.rank))
    F[..., layout.all_states, layout.initial_state] = free_response(A, horizon)
    F[..., layout.all_states, layout.state_dim :] = forced_response(A, B, horizon)
    F[..., layout.all_inputs, layout.state_dim :] = np.eye(layout.input_dim * horizon)
    return F


def dynamics_matrix(A: np.ndarray, B: np.ndarray, horizon: int) -> np.ndarray:
    """G of shape (..., nT, d) with G tau = [x(t+1) - A x(t) - B u(t)] for t = 0..T-1.

    im F is its kernel. G holds no powers of A, so that the kernel is found well however fast A^t grows.
    """
    layout = layout_of(A, B, horizon)
    unit = np.broadcast_to(np.eye(layout.size), (*A.shape[:-2], layout.size, layout.size))
    x, u = layout.split(unit)
    residual = x[..., 1:, :] - along(A, x[..., :-1, :]) - along(B, u)
    return residual.reshape(*A.shape[:-2], layout.size, -1).swapaxes(-1, -2)


def along(M: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """M v for every vector: M (*robots, a, b) and vectors (*robots, ..., b) give (*robots, ..., a).

    The batch dimensions of M are the *first* of the vectors; all others share the matrix, so that one matrix
    product serves them all.
    """
    lead = M.shape[:-2]
    flat = vectors.reshape(*vectors.shape[: len(lead)], -1, vectors.shape[-1])
    result = flat @ M.swapaxes(-1, -2)
    return result.reshape(*result.shape[: len(lead)], *vectors.shape[len(lead) : -1], M.shape[-2])


def simulate(
    A: np.ndarray, B: np.ndarray, x_init: np.ndarray, inputs: np.ndarray, noise: np.ndarray | None = None
) -> np.ndarray:
    """Roll out x(t+1) = A x(t) + B u(t) + w(t), eq. (1).

    Args:
        A, B: (*robots, n, n) and (*robots, n, m).
        x_init: (*robots, ..., n); what stands between may broadcast against the inputs.
        inputs: (*robots, ..., T, m).
        noise: (*robots, ..., T, n) or None for none.

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

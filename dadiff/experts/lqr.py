"""The LQR expert: finite-horizon affine feedback towards a target that need not be an equilibrium.

    min  sum_{t=0}^{T-1} |x(t) - x_target|_Q^2 + |u(t)|_R^2      s.t. x(t+1) = A x(t) + B u(t)

There is no cost on x(T), so u(T-1) = 0. The optimum is u(t) = K(t) x(t) + L(t) x_target (Section IV-A).
Under process noise the closed loop's trajectories are Gaussian given (x_init, x_target); their law is exact.
Systems may carry leading robot dimensions; everything is vectorised over them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import InfeasibleError
from dadiff.systems import LinearSystem


@dataclass(frozen=True)
class AffineFeedback:
    """u(t) = K(t) x(t) + L(t) x_target.

    Args:
        K: (*robots, T, m, n).
        L: (*robots, T, m, n).
    """

    K: np.ndarray = field(repr=False)
    L: np.ndarray = field(repr=False)

    @property
    def horizon(self) -> int:
        """T."""
        return self.K.shape[-3]


@dataclass(frozen=True)
class GaussianLaw:
    """tau | E ~ N(mean_map E, noise_map noise_map'), the closed loop's law (Theorem 1).

    The covariance is singular: x(0) is given and u(0) is deterministic.

    Args:
        mean_map: (*robots, d, 2n), acting on E = [x_init; x_target].
        noise_map: (*robots, d, nT), from unit noise to the trajectory.
    """

    mean_map: np.ndarray = field(repr=False)
    noise_map: np.ndarray = field(repr=False)

    @property
    def covariance(self) -> np.ndarray:
        """Sigma of shape (*robots, d, d)."""
        return self.noise_map @ self.noise_map.swapaxes(-1, -2)


def optimal_feedback(system: LinearSystem, Q: np.ndarray, R: np.ndarray, horizon: int) -> AffineFeedback:
    """The finite-horizon optimum by dynamic programming.

    With the value function x' P x - 2 x' S x_target + const and P(T) = S(T) = 0, going backwards,

        K = -(R + B'PB)^-1 B'PA,    L = (R + B'PB)^-1 B'S,    P <- Q + A'P(A + BK),    S <- Q + (A + BK)'S.

    Args:
        Q: (n, n), R: (m, m), positive semidefinite and positive definite.

    Raises:
        InfeasibleError: if the recursion leaves float range (an unstable system over a long horizon).
    """
    A, B, (n, m) = system.A, system.B, system.B.shape[-2:]
    At, Bt = A.swapaxes(-1, -2), B.swapaxes(-1, -2)
    K, L = np.empty((2, *system.robots, horizon, m, n))
    P = S = np.zeros_like(A)
    with np.errstate(over="ignore", invalid="ignore"):
        for t in reversed(range(horizon)):
            gain = np.linalg.solve(R + Bt @ P @ B, Bt)
            K[..., t, :, :], L[..., t, :, :] = -gain @ P @ A, gain @ S
            closed = A + B @ K[..., t, :, :]
            P, S = Q + At @ P @ closed, Q + closed.swapaxes(-1, -2) @ S
            P = (P + P.swapaxes(-1, -2)) / 2
    _check_finite(P, S, horizon)
    return AffineFeedback(K, L)


def _check_finite(P: np.ndarray, S: np.ndarray, horizon: int) -> None:
    finite = np.isfinite(P).all(axis=(-2, -1)) & np.isfinite(S).all(axis=(-2, -1))
    if not finite.all():
        which = f"robot {int(np.flatnonzero(~finite)[0])}" if finite.ndim else "the system"
        raise InfeasibleError(
            f"LQR: the Riccati recursion of {which} leaves float range over horizon T = {horizon}; "
            "shorten the horizon or choose a less unstable system"
        )


def stationary_feedback(system: LinearSystem, Q: np.ndarray, R: np.ndarray, horizon: int) -> AffineFeedback:
    """u(t) = K (x(t) - x_target) with the infinite-horizon gain of python-control's dlqr."""
    import control

    A, B = system.A.reshape(-1, *system.A.shape[-2:]), system.B.reshape(-1, *system.B.shape[-2:])
    K = -np.stack([control.dlqr(a, b, Q, R)[0] for a, b in zip(A, B, strict=True)])
    K = np.repeat(K.reshape(*system.robots, 1, *K.shape[-2:]), horizon, axis=-3)
    return AffineFeedback(K, -K)


def closed_loop_law(system: LinearSystem, feedback: AffineFeedback) -> GaussianLaw:
    """The law of trajectories under the feedback and process noise.

    Propagates the linear maps from [x_init; x_target; w(0:T-1)] to x(t) and u(t).
    """
    T, (n, m) = feedback.horizon, system.B.shape[-2:]
    num_sources = 2 * n + n * T
    states = np.zeros((*system.robots, T + 1, n, num_sources))
    inputs = np.zeros((*system.robots, T, m, num_sources))
    states[..., 0, :, :n] = np.eye(n)
    target = np.zeros((n, num_sources))
    target[:, n : 2 * n] = np.eye(n)
    for t in range(T):
        x = states[..., t, :, :]
        u = inputs[..., t, :, :] = feedback.K[..., t, :, :] @ x + feedback.L[..., t, :, :] @ target
        states[..., t + 1, :, :] = system.A @ x + system.B @ u
        noise = 2 * n + n * t
        states[..., t + 1, :, noise : noise + n] += np.diag(np.broadcast_to(system.process_noise, n))
    by_source = system.layout(T).flatten(np.moveaxis(states, -1, -3), np.moveaxis(inputs, -1, -3))
    maps = by_source.swapaxes(-1, -2)
    return GaussianLaw(maps[..., : 2 * n], maps[..., 2 * n :])

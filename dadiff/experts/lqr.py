"""The LQR expert: finite-horizon affine feedback towards a target that need not be an equilibrium.

    min  sum_{t=0}^{T-1} |x(t) - x_target|_Q^2 + |u(t)|_R^2  +  |x(T) - x_target|_{Q_T}^2
    s.t. x(t+1) = A_t x(t) + B_t u(t) + c_t

The paper has no cost on x(T) (Q_T = 0), so that u(T-1) = 0. The optimum is u(t) = K(t) x(t) + L(t) x_target + k(t)
(Section IV-A, where c = 0 and so k = 0).
Under process noise the closed loop's trajectories are Gaussian given (x_init, x_target); their law is exact.
Systems may have a robot dimension; everything is vectorised over it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dadiff.errors import ConfigError, InfeasibleError
from dadiff.systems import AffineSystem, Linear
from dadiff.trajectory.response import along, beside
from dadiff.trajectory.subspace import regression

DENSE_UP_TO = 2000
"""The size d of trajectories up to which dense maps are faster than recursions along time."""


@dataclass(frozen=True)
class AffineFeedback:
    """u(t) = K(t) x(t) + L(t) x_target + k(t).

    Args:
        K: (*robots, T, m, n).
        L: (*robots, T, m, n).
        k: (*robots, T, m).
    """

    K: np.ndarray = field(repr=False)
    L: np.ndarray = field(repr=False)
    k: np.ndarray = field(repr=False)

    @property
    def horizon(self) -> int:
        """T."""
        return self.K.shape[-3]

    def at(self, t: int, x: np.ndarray, target: np.ndarray) -> np.ndarray:
        """u(t) of shape (*robots, ..., m) from x (*robots, ..., n) and x_target of the same shape."""
        return along(self.K[..., t, :, :], x) + along(self.L[..., t, :, :], target) + beside(self.k[..., t, :], x)


@dataclass(frozen=True)
class GaussianLaw:
    """tau | E ~ N(mean_map E + offset, noise_map noise_map'), the closed loop's law (Theorem 1).

    The covariance is singular: x(0) is given and u(0) is deterministic.

    Args:
        mean_map: (*robots, d, 2n), acting on E = [x_init; x_target].
        offset: (*robots, d), 0 where the system has none.
        noise_map: (*robots, d, nT), from unit noise to the trajectory.
    """

    mean_map: np.ndarray = field(repr=False)
    offset: np.ndarray = field(repr=False)
    noise_map: np.ndarray = field(repr=False)

    @classmethod
    def of_demonstrations(cls, trajectories: np.ndarray, environment: np.ndarray) -> GaussianLaw:
        """The law with the first two moments of demonstrations given E: linear regression, and what it leaves.

        Args:
            trajectories: (N, d), physical units.
            environment: (N, c).
        """
        coefficients, intercept, residual = regression(trajectories, environment)
        _, s, Vt = np.linalg.svd(residual, full_matrices=False)
        freedom = max(len(residual) - environment.shape[-1] - 1, 1)
        return cls(coefficients.T, intercept, Vt.T * s / np.sqrt(freedom))

    def mean(self, ends: np.ndarray) -> np.ndarray:
        """The mean (*robots, ..., d) given [x_init; x_target] (*robots, ..., 2n)."""
        return along(self.mean_map, ends) + beside(self.offset, ends)

    def spread(self, unit: np.ndarray) -> np.ndarray:
        """What unit noise (*robots, ..., k) adds to the mean, (*robots, ..., d)."""
        return along(self.noise_map, unit)

    @property
    def covariance(self) -> np.ndarray:
        """Sigma of shape (*robots, d, d)."""
        return self.noise_map @ self.noise_map.swapaxes(-1, -2)


def optimal_feedback(
    system: AffineSystem, Q: np.ndarray, R: np.ndarray, horizon: int, terminal: np.ndarray | None = None
) -> AffineFeedback:
    """The finite-horizon optimum by dynamic programming.

    With the value function x' P x - 2 x' S x_target + 2 x' s + const and P(T) = S(T) = Q_T, s(T) = 0, going backwards,

        K = -(R + B'PB)^-1 B'PA,    L = (R + B'PB)^-1 B'S,    k = -(R + B'PB)^-1 B'(Pc + s),
        P <- Q + A'P(A + BK),       S <- Q + (A + BK)'S,      s <- (A + BK)'(Pc + s).

    Args:
        Q: (n, n), R: (m, m), positive semidefinite and positive definite.
        terminal: Q_T (n, n), None for 0.

    Raises:
        InfeasibleError: if the recursion leaves float range (an unstable system over a long horizon).
    """
    (A, B, c), n, m = system.matrices(horizon), system.state_dim, system.input_dim
    K, L = np.empty((2, *system.robots, horizon, m, n))
    k, s = np.empty((*system.robots, horizon, m)), np.zeros((*system.robots, n, 1))
    P = S = np.broadcast_to(np.zeros((n, n)) if terminal is None else terminal, (*system.robots, n, n))
    with np.errstate(over="ignore", invalid="ignore"):
        for t in reversed(range(horizon)):
            A_t, B_t, Bt = A[..., t, :, :], B[..., t, :, :], B[..., t, :, :].swapaxes(-1, -2)
            gain = np.linalg.solve(R + Bt @ P @ B_t, Bt)
            pull = P @ c[..., t, :, None] + s
            K[..., t, :, :], L[..., t, :, :], k[..., t, :] = -gain @ P @ A_t, gain @ S, -(gain @ pull)[..., 0]
            closed = A_t + B_t @ K[..., t, :, :]
            P, S = Q + A_t.swapaxes(-1, -2) @ P @ closed, Q + closed.swapaxes(-1, -2) @ S
            P, s = (P + P.swapaxes(-1, -2)) / 2, closed.swapaxes(-1, -2) @ pull
    _check_finite(P, S + s, horizon)
    return AffineFeedback(K, L, k)


def _check_finite(P: np.ndarray, S: np.ndarray, horizon: int) -> None:
    finite = np.isfinite(P).all(axis=(-2, -1)) & np.isfinite(S).all(axis=(-2, -1))
    if not finite.all():
        which = f"robot {int(np.flatnonzero(~finite)[0])}" if finite.ndim else "the system"
        raise InfeasibleError(
            f"LQR: the Riccati recursion of {which} leaves float range over horizon T = {horizon}; "
            "shorten the horizon or choose a less unstable system"
        )


def stationary_feedback(system: AffineSystem, Q: np.ndarray, R: np.ndarray, horizon: int) -> AffineFeedback:
    """u(t) = K (x(t) - x_target) with the infinite-horizon gain of python-control's dlqr.

    Raises:
        ConfigError: if the system varies in time or has an offset, of which such a gain knows nothing.
    """
    import control

    if not isinstance(system, Linear) or system.c.any():
        raise ConfigError(
            "task: expert=stationary is for systems that do not vary in time and have no offset c; use expert=optimal"
        )
    A, B = system.A.reshape(-1, *system.A.shape[-2:]), system.B.reshape(-1, *system.B.shape[-2:])
    K = -np.stack([control.dlqr(a, b, Q, R)[0] for a, b in zip(A, B, strict=True)])
    K = np.repeat(K.reshape(*system.robots, 1, *K.shape[-2:]), horizon, axis=-3)
    return AffineFeedback(K, -K, np.zeros(K.shape[:-1]))


@dataclass(frozen=True)
class ClosedLoopLaw(GaussianLaw):
    """The law of trajectories under a feedback and process noise, made from no more than the two."""

    system: AffineSystem
    feedback: AffineFeedback
    mean_map: np.ndarray = field(init=False, repr=False)
    offset: np.ndarray = field(init=False, repr=False)
    noise_map: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        ends, n = np.zeros((*self.system.robots, self.system.state_dim)), 2 * self.system.state_dim
        maps = _propagated(self.system, self.feedback)
        found = {"mean_map": maps[..., :n], "offset": follow(self.system, self.feedback, ends, ends)}
        for name, array in {**found, "noise_map": maps[..., n:]}.items():
            object.__setattr__(self, name, array)

    @property
    def is_long(self) -> bool:
        """Whether recursions along time serve better than the maps."""
        return self.mean_map.shape[-2] > DENSE_UP_TO

    @cached_property
    def closed(self) -> np.ndarray:
        """A_t + B_t K(t) of shape (*robots, T, n, n): about its mean the law is x(t+1) = closed x(t) + sigma w(t)."""
        A, B, _ = self.system.matrices(self.feedback.horizon)
        return A + B @ self.feedback.K

    @property
    def deviations(self) -> np.ndarray:
        """sigma, of every state's process noise, (n,)."""
        return np.broadcast_to(self.system.process_noise, self.system.state_dim)

    def spread(self, unit: np.ndarray) -> np.ndarray:
        """See `GaussianLaw.spread`; in O(T) where that is long."""
        if not self.is_long:
            return super().spread(unit)
        T, n = self.feedback.horizon, self.system.state_dim
        w = self.deviations * unit.reshape(*unit.shape[:-1], T, n)
        states, inputs = np.zeros((*unit.shape[:-1], T + 1, n)), np.empty((*unit.shape[:-1], T, self.system.input_dim))
        for t in range(T):
            inputs[..., t, :] = along(self.feedback.K[..., t, :, :], states[..., t, :])
            states[..., t + 1, :] = along(self.closed[..., t, :, :], states[..., t, :]) + w[..., t, :]
        return self.system.layout(T).flatten(states, inputs)


def _propagated(system: AffineSystem, feedback: AffineFeedback) -> np.ndarray:
    """The linear map from [x_init; x_target; w(0:T-1)] to tau, (*robots, d, 2n + nT)."""
    T, n, m = feedback.horizon, system.state_dim, system.input_dim
    A, B, _ = system.matrices(T)
    num_sources = 2 * n + n * T
    states = np.zeros((*system.robots, T + 1, n, num_sources))
    inputs = np.zeros((*system.robots, T, m, num_sources))
    states[..., 0, :, :n] = np.eye(n)
    target = np.zeros((n, num_sources))
    target[:, n : 2 * n] = np.eye(n)
    for t in range(T):
        x = states[..., t, :, :]
        u = inputs[..., t, :, :] = feedback.K[..., t, :, :] @ x + feedback.L[..., t, :, :] @ target
        states[..., t + 1, :, :] = A[..., t, :, :] @ x + B[..., t, :, :] @ u
        noise = 2 * n + n * t
        states[..., t + 1, :, noise : noise + n] += np.diag(np.broadcast_to(system.process_noise, n))
    by_source = system.layout(T).flatten(np.moveaxis(states, -1, -3), np.moveaxis(inputs, -1, -3))
    return by_source.swapaxes(-1, -2)


def follow(
    system: AffineSystem,
    feedback: AffineFeedback,
    x_init: np.ndarray,
    target: np.ndarray,
    noise: np.ndarray | None = None,
) -> np.ndarray:
    """The closed loop's trajectories (*robots, ..., d) from x_init and towards target, both (*robots, ..., n).

    Args:
        noise: w of shape (*robots, ..., T, n), or None for none.
    """
    x, states, inputs = x_init, [x_init], []
    for t in range(feedback.horizon):
        inputs.append(feedback.at(t, x, target))
        x = system.step(x, inputs[-1], t)
        x = x if noise is None else x + noise[..., t, :]
        states.append(x)
    return system.layout(feedback.horizon).flatten(np.stack(states, axis=-2), np.stack(inputs, axis=-2))

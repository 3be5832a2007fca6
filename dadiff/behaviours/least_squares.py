"""Dynamics from data by least squares: min sum_t |x(t+1) - A x(t) - B u(t) - c|^2.

With phi = [x; u; 1] the estimate's error has covariance (Phi' Phi)^-1 (x) sigma^2, so that one knows which directions
are known how well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dadiff.behaviours.stages import Stages, transposed
from dadiff.errors import ExcitationError
from dadiff.systems.features import Features, Regressed
from dadiff.trajectory.subspace import column_scaled, numerical_rank

ROUNDING = 1e-13

Offset = Literal["none", "estimated", "known"]


@dataclass(frozen=True)
class Transitions:
    """(x(t), u(t)) -> x(t+1), in no order.

    Args:
        x, following: (*robots, count, n).
        u: (*robots, count, m).
    """

    x: np.ndarray = field(repr=False)
    u: np.ndarray = field(repr=False)
    following: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, states: np.ndarray, inputs: np.ndarray) -> Transitions:
        """All transitions of experiments: states (*robots, count, S+1, n), inputs (*robots, count, S, m).

        Of a single system they may differ in length, nan standing after their end.
        """
        made = [_joined(states[..., :-1, :]), _joined(inputs), _joined(states[..., 1:, :])]
        if made[0].ndim == 2 and (ended := np.isnan(np.concatenate(made, axis=-1)).any(axis=-1)).any():
            made = [values[~ended] for values in made]
        return cls(*made)

    def less(self, c: np.ndarray) -> Transitions:
        """Those of the same dynamics without an offset c (*robots, n)."""
        return Transitions(self.x, self.u, self.following - c[..., None, :])

    def __add__(self, other: Transitions) -> Transitions:
        """Both together."""
        pairs = [(self.x, other.x), (self.u, other.u), (self.following, other.following)]
        return Transitions(*(np.concatenate(pair, axis=-2) for pair in pairs))


def _joined(array: np.ndarray) -> np.ndarray:
    return array.reshape(*array.shape[:-3], -1, array.shape[-1])


@dataclass(frozen=True)
class Estimate:
    """(A, B, c), and how sure one is of them.

    Args:
        A, B, c: (*robots, n, n), (*robots, n, m), (*robots, n).
        spread: (Phi' Phi)^-1 of shape (*robots, p, p), with p = n + m, and one more where c was estimated, too.
        noise: variance of the residual of each state, (*robots, n), with p degrees of freedom taken off.
    """

    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    c: np.ndarray = field(repr=False)
    spread: np.ndarray = field(repr=False)
    noise: np.ndarray = field(repr=False)

    def stages(self, horizon: int) -> Stages:
        """The same dynamics at every stage."""
        return Stages.constant(self.A, self.B, self.c, horizon)

    def residual_spread(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """V with V V' = R, the covariance of G tau - g that the estimate's error causes, averaged over trajectories.

            R_ts = trace((Phi' Phi)^-1 E[phi(s) phi(t)']) diag(noise),    phi = [x; u; 1]

        Args:
            states: (N, T+1, n).
            inputs: (N, T, m).

        Returns:
            (*robots, nT, q), stage by stage; what is below rounding is left out.
        """
        ones = np.ones((*inputs.shape[:-1], self.spread.shape[-1] - self.A.shape[-1] - inputs.shape[-1]))
        phi = np.concatenate([states[..., :-1, :], inputs, ones], axis=-1)
        weighed = phi.reshape(-1, phi.shape[-1]) @ np.linalg.cholesky(self.spread)
        weighed = weighed.reshape(*self.spread.shape[:-2], *phi.shape)
        kernel = np.einsum("...atp,...asp->...ts", weighed, weighed, optimize=True) / len(phi)
        values, vectors = np.linalg.eigh(kernel)
        kept = (values > ROUNDING * values[..., -1:]).reshape(-1, values.shape[-1]).any(axis=0)
        root = vectors[..., kept] * np.sqrt(np.maximum(values[..., kept], 0))[..., None, :]
        V = root[..., :, None, :, None] * _diagonal(np.sqrt(self.noise))[..., None, :, None, :]
        return V.reshape(*V.shape[:-4], V.shape[-4] * V.shape[-3], V.shape[-2] * V.shape[-1])

    @property
    def root(self) -> np.ndarray:
        """L of shape (*robots, p, n, p n), with L L' the covariance of [A B c]' = theta, row by row."""
        return root_of(np.linalg.cholesky(self.spread), self.noise)


def root_of(S: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """L (*robots, p, n, p n) with L L' = S S' (x) diag(noise), from (*robots, p, p) and (*robots, n)."""
    deviation = _diagonal(np.sqrt(noise))
    L = S[..., :, None, :, None] * deviation[..., None, :, None, :]
    return L.reshape(*L.shape[:-2], L.shape[-2] * L.shape[-1])


def _diagonal(values: np.ndarray) -> np.ndarray:
    return values[..., :, None] * np.eye(values.shape[-1])


def least_squares(data: Transitions, offset: Offset = "none", known: np.ndarray | None = None) -> Estimate:
    """The estimate from transitions.

    Args:
        offset: `none` for c = 0, `estimated`, or `known`.
        known: c of shape (*robots, n), where it is known.

    Raises:
        ExcitationError: if [x(t); u(t)], and 1 where c is estimated, do not span all their dimensions.
    """
    n, m = data.x.shape[-1], data.u.shape[-1]
    given = np.zeros((*data.x.shape[:-2], n)) if known is None else known
    ones = [np.ones((*data.x.shape[:-1], 1))] if offset == "estimated" else []
    Phi = np.concatenate([data.x, data.u, *ones], axis=-1)
    _check_rank(Phi, n + m)
    theta, root, noise = regression(Phi, data.following - given[..., None, :])
    c = theta[..., n + m] if ones else given
    return Estimate(theta[..., :n], theta[..., n : n + m], c, root @ transposed(root), noise)


def regression(Phi: np.ndarray, target: np.ndarray, ridge: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """min over theta of |target - Phi theta'|^2 + ridge |S theta'|^2, S the deviations of the columns of Phi.

    Args:
        Phi: (*robots, count, p).
        target: (*robots, count, n).

    Returns:
        theta (*robots, n, p), a root of (Phi' Phi + ridge S^2)^-1 of shape (*robots, p, p), and the residual's
        variance, p degrees of freedom taken off, (*robots, n).
    """
    scale = np.sqrt(ridge) * _diagonal(Phi.std(axis=-2))
    rows, right = Phi, target
    if ridge:
        rows = np.concatenate([Phi, scale], axis=-2)
        right = np.concatenate([target, np.zeros((*scale.shape[:-1], target.shape[-1]))], axis=-2)
    Q, R = np.linalg.qr(rows)
    theta = transposed(np.linalg.solve(R, transposed(Q) @ right))
    residual = target - Phi @ transposed(theta)
    freedom = max(Phi.shape[-2] - Phi.shape[-1], 1)
    return theta, np.linalg.inv(R), np.square(residual).sum(axis=-2) / freedom


@dataclass(frozen=True)
class Regression:
    """x(t+1) = x + Theta phi(x, u), and how sure one is of Theta.

    Args:
        system: with the estimated Theta.
        root: L of shape (*robots, p, n, k) with L L' the covariance of Theta', row by row.
    """

    system: Regressed
    root: np.ndarray = field(repr=False)


def regressed(data: Transitions, features: Features, ridge: float = 0.0) -> Regression:
    """Dynamics that are linear in features, from transitions.

    Raises:
        ExcitationError: if the features do not vary independently of one another, and nothing else decides (ridge = 0).
    """
    Phi = features(data.x, data.u)
    _check_features(Phi, ridge)
    theta, root, noise = regression(Phi, data.following - data.x, ridge)
    return Regression(Regressed(features, np.ascontiguousarray(theta)), root_of(root, noise))


def significant(data: Transitions, features: Features, threshold: float) -> Regression:
    """As `regressed`, but of the terms that matter, state by state; see `selected`.

    Dynamics have few terms; noise puts a little of every other into an estimate, and along a chain of integrators that
    little grows.
    """
    Phi, target = features(data.x, data.u), data.following - data.x
    _check_features(Phi, 0.0)
    lead, p, n = Phi.shape[:-2], Phi.shape[-1], target.shape[-1]
    rows, wanted = Phi.reshape(-1, *Phi.shape[-2:]), target.reshape(-1, *target.shape[-2:])
    theta, roots = np.zeros((len(rows), n, p)), np.zeros((len(rows), p, n, n, p))
    for robot, state in np.ndindex(len(rows), n):
        right = wanted[robot, :, state]
        kept = selected(rows[robot], right, threshold, features.degrees)
        if kept:
            estimate, root, noise = regression(rows[robot][:, kept], right[:, None])
            theta[robot, state, kept] = estimate[0]
            roots[robot, kept, state, state, : len(kept)] = root_of(root, noise)[:, 0]
    root = roots.reshape(*lead, p, n, n * p)
    moving = root.reshape(-1, n * p).any(axis=0)
    return Regression(Regressed(features, theta.reshape(*lead, n, p)), root[..., moving])


def selected(Phi: np.ndarray, target: np.ndarray, threshold: float, degree: np.ndarray) -> list[int]:
    """The columns of Phi (count, p) that a target (count,) is explained by: backward elimination.

    Of the columns whose estimates are fewer than `threshold` standard errors from 0, the least sure of the highest
    degree (p,) is left out and the rest estimated anew, until none is: products go before what they are products of.
    """
    kept = list(range(Phi.shape[-1]))
    while kept:
        estimate, root, (noise,) = regression(Phi[:, kept], target[:, None])
        error = np.sqrt(noise * np.square(root).sum(axis=-1)) + ROUNDING * np.abs(estimate).max()
        sureness, order = np.abs(estimate[0]) / np.maximum(error, np.finfo(float).tiny), degree[kept]
        unsure = sureness < threshold
        if not unsure.any():
            break
        of_highest = unsure & (order == order[unsure].max())
        del kept[int(np.where(of_highest, sureness, np.inf).argmin())]
    return kept


def lifted(data: Transitions, observables: Features, ridge: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """K (*robots, p, p) and B (*robots, p, m) of psi(x(t+1)) = K psi(x(t)) + B u(t), from transitions.

    Raises:
        ExcitationError: as `regressed`.
    """
    none = np.zeros((*data.x.shape[:-1], 0))
    now, following = observables(data.x, none), observables(data.following, none)
    Phi, p = np.concatenate([now, data.u], axis=-1), now.shape[-1]
    _check_features(Phi, ridge)
    theta, _, _ = regression(Phi, following - now, ridge)
    return np.eye(p) + theta[..., :p], theta[..., p:]


def _check_features(Phi: np.ndarray, ridge: float) -> None:
    if not ridge and (rank := numerical_rank(column_scaled(Phi))) < Phi.shape[-1]:
        raise ExcitationError(
            f"recording: its {Phi.shape[-2]} transitions span {rank} of the {Phi.shape[-1]} features; record longer, "
            "with inputs that vary more, choose fewer features or a ridge"
        )


def _check_rank(Phi: np.ndarray, needed: int) -> None:
    if (rank := numerical_rank(column_scaled(Phi))) < Phi.shape[-1]:
        what, count = ("n + m", needed) if Phi.shape[-1] == needed else ("n + m + 1", needed + 1)
        raise ExcitationError(
            f"recording: states and inputs span {rank} dimensions, {what} = {count} are needed to identify the "
            "dynamics; record with inputs that vary independently of the state"
        )

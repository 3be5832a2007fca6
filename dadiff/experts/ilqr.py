"""Tracking by iterated LQR: the trajectory of a (nonlinear) system that is nearest to a reference, for whole batches.

    min  1/2 |tau - tau_ref|^2_{C^-1}    s.t.  x(t+1) = f_t(x(t), u(t)),  x(0) = x_init,  tau[pins] = values

Gauss-Newton sweeps (Li & Todorov 2004; Tassa et al. 2012 without second derivatives of f): linearise along the plan,
Riccati backwards, roll the *nonlinear* system out under the gains. Every plan after the first sweep is feasible.
With weights instead of a covariance and a reference at rest this is the optimal controller of a quadratic cost; with
a plan that a network drew as the reference it is that plan's projection onto the dynamics.

C^-1 = W is block diagonal in time, or C = W^-1 + U U' with few directions U: then tau_ref + U z with |z|^2 paid for z
is tracked in W instead, and z is found in the same sweep (`dadiff.experts.riccati`), in O(T (n^3 + n^2 k + m k^2)).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import EllipsisType

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems import Robots, System
from dadiff.trajectory.layout import TrajectoryLayout

_BACKTRACKS = 8
_DAMPING = 1e-4  # of a plan that no step length improved, in units of its input weight; tenfold at each failure
_MOST_DAMPING = 1e8
_ROUNDING = 1e-9
_FLOOR = 1e-24  # costs below this share of |reference|^2 are rounding


Index = np.ndarray | EllipsisType


@dataclass(frozen=True)
class Metric:
    """|delta|^2 = min over z of (delta - U z)' W (delta - U z) + |z|^2, that is delta' (W^-1 + U U')^-1 delta.

    Args:
        Q: weights of the states, (T+1, n, n), positive semidefinite.
        R: weights of the inputs, (T, m, m), positive definite.
        U: directions, (d, k).
    """

    layout: TrajectoryLayout
    Q: np.ndarray = field(repr=False)
    R: np.ndarray = field(repr=False)
    U: np.ndarray = field(repr=False)

    @classmethod
    def diagonal(cls, layout: TrajectoryLayout, variances: np.ndarray, U: np.ndarray | None = None) -> Metric:
        """From C = diag(variances) + U U', (d,) and (d, k).

        Raises:
            ConfigError: if a variance is not positive.
        """
        if not (variances > 0).all():
            raise ConfigError(
                f"metric: the variances reach down to {variances.min():g}; a projection onto nonlinear dynamics needs "
                "positive ones, give the covariance a floor"
            )
        Q, R = (np.eye(w.shape[-1]) * w[..., None] for w in layout.split(1 / variances))
        return cls(layout, Q, R, np.zeros((layout.size, 0)) if U is None else U)

    def times(self, delta: np.ndarray) -> np.ndarray:
        """W delta, (..., d)."""
        x, u = self.layout.split(delta)
        return self.layout.flatten((self.Q @ x[..., None])[..., 0], (self.R @ u[..., None])[..., 0])

    @cached_property
    def WU(self) -> np.ndarray:
        """(d, k)."""
        return self.times(self.U.T).T

    @cached_property
    def M(self) -> np.ndarray:
        """I + U' W U, (k, k)."""
        return np.eye(self.U.shape[1]) + self.U.T @ self.WU

    def squared(self, delta: np.ndarray) -> np.ndarray:
        """|delta|^2 of (..., d), by Woodbury."""
        along = delta @ self.WU
        with np.errstate(over="ignore", invalid="ignore"):
            return (delta * self.times(delta)).sum(-1) - (
                along * np.linalg.solve(self.M, along[..., None])[..., 0]
            ).sum(-1)


@dataclass(frozen=True)
class Tracking:
    """One problem for each plan.

    Args:
        system: of `robots` robots.
        metric: the same for all plans.
        reference: tau_ref, (*robots, plans, d).
        x_init: (*robots, plans, n), or None where x(0) is chosen, too.
        pins: which other entries of tau are held, (p,), and at which values, (*robots, plans, p).
    """

    system: System
    metric: Metric
    reference: np.ndarray = field(repr=False)
    x_init: np.ndarray | None = field(default=None, repr=False)
    pins: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        robots, shape = self.system.robots, self.reference.shape
        if shape != (*robots, *shape[len(robots) : -1], self.layout.size) or len(shape) != len(robots) + 2:
            raise ShapeError(f"tracking: reference has shape {shape}; expected {(*robots, 'plans', self.layout.size)}")

    @property
    def layout(self) -> TrajectoryLayout:
        """Of the plans."""
        return self.metric.layout

    @cached_property
    def floor(self) -> np.ndarray:
        """Costs that are rounding, (*robots, plans)."""
        return _FLOOR * (1 + np.abs(self.metric.times(self.reference) * self.reference).sum(-1))

    def cost(self, tau: np.ndarray) -> np.ndarray:
        """|tau - tau_ref|^2, (*robots, plans); inf where tau left float range."""
        with np.errstate(over="ignore", invalid="ignore"):
            cost = self.metric.squared(tau - self.reference)
        return np.where(np.isfinite(cost), cost, np.inf)

    def violation(self, tau: np.ndarray) -> np.ndarray:
        """sum of |tau[pins] - values|, (*robots, plans)."""
        if self.pins is None:
            return np.zeros(tau.shape[:-1])
        where, values = self.pins
        return np.abs(tau[..., where] - values).sum(-1)

    def merit(self, tau: np.ndarray, penalty: np.ndarray) -> np.ndarray:
        """The cost of plans, and what they pay for missing their pins, (*robots, plans)."""
        return self.cost(tau) + penalty * self.violation(tau)

    def feasible(self, tau: np.ndarray) -> np.ndarray:
        """Which plans are trajectories of the system from x_init, up to rounding, (*robots, plans)."""
        x, u = self.layout.split(tau)
        following = self.system.step(x[..., :-1, :], u, np.arange(self.layout.horizon))
        off = np.abs(x[..., 1:, :] - following).max(axis=(-2, -1))
        if self.x_init is not None:
            off = np.maximum(off, np.abs(x[..., 0, :] - self.x_init).max(axis=-1))
        return off <= _ROUNDING * (1 + np.abs(tau).max(axis=-1))

    def take(self, index: Index) -> Tracking:
        """The problems of plans `index`, where there is one system; of robots `index`, where there are several."""
        if index is ...:
            return self
        pins = self.pins and (self.pins[0], self.pins[1][index])
        x_init = None if self.x_init is None else self.x_init[index]
        system = self.system.take(index) if isinstance(self.system, Robots) else self.system
        return replace(self, system=system, reference=self.reference[index], x_init=x_init, pins=pins)


@dataclass(frozen=True)
class Step:
    """A Gauss-Newton step about a plan: u = u_bar + K (x - x_bar) + a k, x(0) = x_bar(0) + a dx(0), 0 < a <= 1.

    Args:
        K: (*robots, plans, T, m, n), feedforward: (*robots, plans, T, m), start: (*robots, plans, n).
        multipliers: of the pins, (*robots, plans, p).
    """

    K: np.ndarray = field(repr=False)
    feedforward: np.ndarray = field(repr=False)
    start: np.ndarray = field(repr=False)
    multipliers: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Solution:
    """Plans after some sweeps.

    Args:
        tau: (*robots, plans, d), feasible.
        cost: |tau - tau_ref|^2, (*robots, plans).
        sweeps: until the last change, (*robots, plans).
        converged: (*robots, plans).
    """

    tau: np.ndarray = field(repr=False)
    cost: np.ndarray = field(repr=False)
    sweeps: np.ndarray = field(repr=False)
    converged: np.ndarray = field(repr=False)


@dataclass
class _Plans:
    """Plans on their way; every array is (*robots, plans, ...)."""

    tau: np.ndarray
    feasible: np.ndarray
    damping: np.ndarray
    penalty: np.ndarray
    count: np.ndarray
    converged: np.ndarray

    @classmethod
    def of(cls, problem: Tracking, start: np.ndarray | None) -> _Plans:
        tau = np.array(problem.reference if start is None else start)
        shape = tau.shape[:-1]
        feasible = np.zeros(shape, dtype=bool) if start is None else problem.feasible(tau)
        return cls(tau, feasible, np.zeros(shape), np.zeros(shape), np.zeros(shape, int), np.zeros(shape, dtype=bool))

    @property
    def ended(self) -> np.ndarray:
        """Which converged, or got stuck."""
        return self.converged | (self.damping > _MOST_DAMPING)

    def take(self, index: Index) -> _Plans:
        """Those at `index`."""
        return _Plans(*(values[index] for values in vars(self).values()))

    def put(self, index: Index, plans: _Plans) -> None:
        """The inverse of `take`."""
        for values, some in zip(vars(self).values(), vars(plans).values(), strict=True):
            values[index] = some


def solve(
    problem: Tracking, start: np.ndarray | None = None, *, sweeps: int = 100, tolerance: float = 1e-12
) -> Solution:
    """Gauss-Newton sweeps until the cost of each plan falls by less than a share, or their number is reached.

    Args:
        start: plans to start from, (*robots, plans, d); None stands for the reference. Where they are no trajectories
            of the system the first sweep makes them so, whatever that costs; after it no sweep makes a plan worse.
        sweeps: at most.
        tolerance: the share.
    """
    plans = _Plans.of(problem, start)
    for _ in range(sweeps):
        going = _going(problem.system, plans.ended)
        plans.put(going, _sweep(problem.take(going), plans.take(going), tolerance))
        if plans.ended.all():
            break
    return Solution(plans.tau, problem.cost(plans.tau), plans.count, plans.converged)


def _going(system: System, ended: np.ndarray) -> Index:
    """The plans that have not ended, or the robots with such plans; all where robots cannot be taken one by one."""
    if isinstance(system, Robots):
        return np.flatnonzero(~ended.all(axis=-1))
    return ... if system.robots else np.flatnonzero(~ended)


def _sweep(problem: Tracking, plans: _Plans, tolerance: float) -> _Plans:
    """One sweep of some plans."""
    tau, damping = plans.tau, plans.damping
    step = gauss_newton(problem, tau, damping, plans.feasible)
    penalty = np.maximum(plans.penalty, 4 * np.abs(step.multipliers).max(axis=-1, initial=0.0))
    before = np.where(plans.feasible, problem.merit(tau, penalty), np.inf)
    trial, merit = partial(follow, problem, tau, step), partial(problem.merit, penalty=penalty)
    tau, after, moved = backtrack(trial, merit, tau, before, problem.floor, _BACKTRACKS)
    converged = plans.converged | (moved & (before - after <= tolerance * after + problem.floor))
    damping = np.where(moved, damping / 10 * (damping > _DAMPING), np.maximum(10 * damping, _DAMPING))
    return _Plans(tau, plans.feasible | moved, damping, penalty, plans.count + ~plans.converged, converged)


def gauss_newton(problem: Tracking, tau: np.ndarray, damping: np.ndarray, feasible: np.ndarray) -> Step:
    """The step from plans tau (*robots, plans, d), of which not all need be feasible yet (*robots, plans)."""
    from dadiff.experts import riccati

    layout, metric = problem.layout, problem.metric
    x, u = layout.split(tau)
    A, B, c = problem.system.linearise(x[..., :-1, :], u, np.arange(layout.horizon))
    defect = c + _times(A, x[..., :-1, :]) + _times(B, u) - x[..., 1:, :]
    defect[feasible] = 0.0
    Lx, Lu = layout.split(metric.times(tau - problem.reference))
    columns, M, M0 = _parameters(problem, tau)
    shared_x, shared_u = (np.moveaxis(part, 0, -1) for part in layout.split(columns.T))
    initial = np.zeros_like(x[..., 0, :]) if problem.x_init is None else problem.x_init - x[..., 0, :]
    solved = riccati.solve_all(
        _flat(A, 3), _flat(B, 3), _flat(defect, 2), metric.Q, metric.R, _flat(Lx, 2), _flat(Lu, 2),
        np.ascontiguousarray(shared_x), np.ascontiguousarray(shared_u), M, _flat(M0, 1),
        _flat(initial, 1), problem.x_init is None, _flat(damping * np.trace(metric.R.mean(0)), 0),
    )  # fmt: skip
    K, feedforward, dx, z = (value.reshape(*tau.shape[:-1], *value.shape[1:]) for value in solved)
    return Step(K, feedforward, dx, z[..., metric.U.shape[1] :])


def _parameters(problem: Tracking, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear terms (d, k + p) of the k coefficients z and the p multipliers, and their quadratic terms M and M0."""
    metric = problem.metric
    columns, M, M0 = -metric.WU, metric.M, -(tau - problem.reference) @ metric.WU
    if problem.pins is None:
        return columns, M, M0
    where, values = problem.pins
    (d, k), p = metric.U.shape, len(where)
    joint = np.zeros((k + p, k + p))
    joint[:k, :k] = M
    return np.hstack([columns, np.eye(d)[:, where]]), joint, np.concatenate([M0, tau[..., where] - values], axis=-1)


def backtrack(
    trial: Callable[[np.ndarray], np.ndarray],
    merit: Callable[[np.ndarray], np.ndarray],
    tau: np.ndarray,
    before: np.ndarray,
    floor: np.ndarray,
    lengths: int,
    ended: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The longest of a = 1, 1/2, ... whose plan is no worse: plans, their merit, and which plans moved.

    Args:
        trial: the plans (*robots, plans, d) after steps of the lengths a (*robots, plans).
        merit: of plans, (*robots, plans).
        tau, before: the plans that steps are taken from, and their merit.
        floor: by what a merit may rise.
        lengths: how many are tried.
        ended: plans that stay.
    """
    best, least = tau, before
    ended = np.zeros(before.shape, dtype=bool) if ended is None else ended
    moved, a = np.zeros(before.shape, dtype=bool), np.ones(before.shape)
    slack = 1e-13 * np.where(np.isfinite(before), before, 0) + floor
    for _ in range(lengths):
        tried = trial(a)
        with np.errstate(over="ignore", invalid="ignore"):
            value = merit(tried)
        better = ~ended & ~moved & np.isfinite(value) & (value <= before + slack)
        best, least = np.where(better[..., None], tried, best), np.where(better, value, least)
        moved |= better
        if (moved | ended).all():
            break
        a = np.where(moved, a, a / 2)
    return best, least, moved


def follow(problem: Tracking, tau: np.ndarray, step: Step, a: np.ndarray) -> np.ndarray:
    """Roll the system out under the gains about tau (*robots, plans, d), with step lengths a (*robots, plans)."""
    layout, system = problem.layout, problem.system
    x_bar, u_bar = layout.split(tau)
    target = u_bar + a[..., None, None] * step.feedforward
    x, u = np.empty_like(x_bar), np.empty_like(u_bar)
    free = problem.x_init is None
    x[..., 0, :] = x_bar[..., 0, :] + a[..., None] * step.start if free else problem.x_init
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(layout.horizon):
            now = x[..., t, :]
            u[..., t, :] = target[..., t, :] + _times(step.K[..., t, :, :], now - x_bar[..., t, :])
            x[..., t + 1, :] = system.step(now, u[..., t, :], t)
    return layout.flatten(x, u)


def _times(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    return (M @ v[..., None])[..., 0]


def _flat(values: np.ndarray, keep: int) -> np.ndarray:
    """All plans along one dimension, followed by the last `keep`."""
    lead, rest = values.shape[: values.ndim - keep], values.shape[values.ndim - keep :]
    return np.ascontiguousarray(values).reshape(int(np.prod(lead)), *rest)

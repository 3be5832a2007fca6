"""Tracking within limits: iterated LQR whose sweeps solve the linearised problem within bounds and half-planes.

    min  1/2 |(tau - tau_ref) / scale|^2    s.t.  x(t+1) = f_t(x(t), u(t)),   low <= tau <= high,   half-planes

A sweep linearises along the plan, finds the nearest trajectory of the linearised system within limits, exactly
(`dadiff.experts.nearest`; control-limited DDP, Tassa, Mansard & Todorov 2014, clips stage by stage instead), and rolls
the nonlinear system out after it under the gains of those inputs that are free. Inputs are clipped as they are applied,
so their bounds hold after every sweep; bounds on states, half-planes and pins other than x(0) hold as sweeps converge.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.experts.ilqr import Metric, Solution, backtrack
from dadiff.experts.nearest import Limits, Nearest, nearest
from dadiff.systems import System
from dadiff.trajectory.layout import TrajectoryLayout

MISSED = 1e-9
"""What plans may exceed their limits by in sum and count as within, relative to 1 + their largest entry."""

_BACKTRACKS = 12
_FLOOR = 1e-24  # costs below this share of |reference|^2 are rounding


@dataclass(frozen=True)
class LimitedTracking:
    """One problem for each plan.

    Args:
        system: of `robots` robots.
        reference: tau_ref, (*robots, plans, d).
        scale: (d,), positive.
        limits: of all plans, one robot's after the other's; x(0) is pinned in them, or free.
    """

    system: System
    layout: TrajectoryLayout
    reference: np.ndarray = field(repr=False)
    scale: np.ndarray = field(repr=False)
    limits: Limits = field(repr=False)

    @classmethod
    def by_bounds(cls, system: System, metric: Metric, reference: np.ndarray, x_init: np.ndarray) -> LimitedTracking:
        """Within the system's bounds from x_init (*robots, plans, n), by costs that are a diagonal.

        Raises:
            ConfigError: if the metric is no positive diagonal.
        """
        layout = metric.layout
        weight = metric.times(np.ones(layout.size))
        Q, R = (np.einsum("tii->ti", W) for W in (metric.Q, metric.R))
        if not (weight > 0).all() or metric.U.size or not np.allclose(weight, layout.flatten(Q, R)):
            raise ConfigError(
                "tracking: within bounds every entry needs a positive weight of its own; give all states a positive "
                "task.state_cost"
            )
        places = np.arange(layout.size)[layout.initial_state]
        starts = x_init.reshape(-1, layout.state_dim)
        limits = Limits.of(layout, len(starts), system.bounds).pinned(places, starts)
        return cls(system, layout, reference, weight**-0.5, limits)

    def __post_init__(self) -> None:
        robots, shape = self.system.robots, self.reference.shape
        if shape != (*robots, *shape[len(robots) : -1], self.layout.size) or len(shape) != len(robots) + 2:
            raise ShapeError(f"tracking: reference has shape {shape}; expected {(*robots, 'plans', self.layout.size)}")

    @cached_property
    def floor(self) -> np.ndarray:
        """Costs that are rounding, (*robots, plans)."""
        return _FLOOR * (1 + np.square(self.reference / self.scale).sum(-1))

    def cost(self, tau: np.ndarray) -> np.ndarray:
        """|(tau - tau_ref) / scale|^2, (*robots, plans); inf where tau left float range."""
        with np.errstate(over="ignore", invalid="ignore"):
            cost = np.square((tau - self.reference) / self.scale).sum(-1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def exceeded(self, tau: np.ndarray) -> np.ndarray:
        """What plans lack to keep their limits, in sum, (*robots, plans)."""
        return self.limits.exceeded(self.layout, self.flat(tau)).reshape(tau.shape[:-1])

    def merit(self, tau: np.ndarray, penalty: np.ndarray) -> np.ndarray:
        """The cost of plans, and what they pay for exceeding limits, (*robots, plans)."""
        return self.cost(tau) + penalty * self.exceeded(tau)

    def within(self, tau: np.ndarray) -> np.ndarray:
        """Which plans keep their limits, (*robots, plans)."""
        with np.errstate(invalid="ignore"):
            return self.exceeded(tau) <= MISSED * (1 + np.abs(tau).max(axis=-1))

    def flat(self, tau: np.ndarray) -> np.ndarray:
        """(*robots, plans, ...) to (N, ...)."""
        lead = len(self.system.robots) + 1
        return np.ascontiguousarray(tau).reshape(-1, *tau.shape[lead:])


def solve(
    problem: LimitedTracking, start: np.ndarray | None = None, *, sweeps: int = 100, tolerance: float = 1e-12
) -> Solution:
    """Sweeps until the merit of each plan falls by less than a share, or their number is reached.

    Args:
        start: plans to linearise along first, (*robots, plans, d); None stands for the reference.
        sweeps: at most.
        tolerance: the share.

    Returns:
        Plans of the system; converged are those that keep their limits and cannot be improved.
    """
    tau = np.array(problem.reference if start is None else start)
    least, ended = np.full(tau.shape[:-1], np.inf), np.zeros(tau.shape[:-1], dtype=bool)
    count, multiplier = np.zeros(tau.shape[:-1], dtype=int), None
    penalty = np.zeros(tau.shape[:-1])
    for _ in range(sweeps):
        step = linearised(problem, tau, multiplier)
        multiplier, penalty = step.multiplier, np.maximum(penalty, step.penalty)
        before = np.where(np.isfinite(least), problem.merit(tau, penalty), np.inf)
        trial, merit = partial(follow, problem, tau, step), partial(problem.merit, penalty=penalty)
        tau, least, moved = backtrack(trial, merit, tau, before, problem.floor, _BACKTRACKS, ended)
        count += ~ended
        small = before - least <= tolerance * least + problem.floor
        ended |= ~moved | small
        if ended.all():
            break
    return Solution(tau, problem.cost(tau), count, ended & problem.within(tau))


@dataclass(frozen=True)
class LimitedStep:
    """Where a sweep leads: u = clip(u_bar + a (u* - u_bar) + K (x - x_bar - a (x* - x_bar))) with 0 < a <= 1.

    Args:
        aim: tau*, (*robots, plans, d), within limits where the linearised problem has a solution.
        K: (*robots, plans, T, m, n), 0 for inputs at a bound.
        multiplier: of the linearised dynamics, (N, T, n).
        penalty: what exceeding a limit costs in the merit, (*robots, plans).
    """

    aim: np.ndarray = field(repr=False)
    K: np.ndarray = field(repr=False)
    multiplier: np.ndarray = field(repr=False)
    penalty: np.ndarray = field(repr=False)


def linearised(problem: LimitedTracking, tau: np.ndarray, multiplier: np.ndarray | None) -> LimitedStep:
    """The step from plans tau (*robots, plans, d); where limits contradict each other, within those of inputs alone."""
    layout, limits, reference = problem.layout, problem.limits, problem.flat(problem.reference)
    x, u = layout.split(tau)
    A, B, c = (problem.flat(M) for M in problem.system.linearise(x[..., :-1, :], u, np.arange(layout.horizon)))
    found = nearest(layout, reference, A, B, c, limits, problem.scale, multiplier)
    if (lost := np.flatnonzero(~found.found)).size:
        found = _rescued(problem, found, lost, (A[lost], B[lost], c[lost]))
    free = (found.tau > limits.low) & (found.tau < limits.high)
    K = _gains(problem, A, B * layout.inputs(free)[..., None, :])
    force = (found.tau - reference) / problem.scale**2 + _pull(layout, A, B, found.multiplier)
    force[:, layout.initial_state] = 0.0
    lead = tau.shape[:-1]
    return LimitedStep(
        found.tau.reshape(tau.shape),
        K.reshape(*lead, *K.shape[1:]),
        found.multiplier,
        4 * np.abs(force).max(axis=-1).reshape(lead),
    )


def _rescued(
    problem: LimitedTracking, found: Nearest, lost: np.ndarray, stages: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Nearest:
    """With other plans for those that were lost: as near as bounds of inputs and x(0) allow."""
    layout, limits = problem.layout, problem.limits.take(lost)
    held = np.r_[np.arange(layout.size)[layout.initial_state], np.arange(layout.size)[layout.all_inputs]]
    free = Limits.nothing(layout, len(lost))
    low, high = free.low.copy(), free.high.copy()
    low[:, held], high[:, held] = limits.low[:, held], limits.high[:, held]
    other = nearest(
        layout, problem.flat(problem.reference)[lost], *stages, replace(free, low=low, high=high), problem.scale
    )
    tau, multiplier = found.tau.copy(), found.multiplier.copy()
    tau[lost], multiplier[lost] = other.tau, 0.0
    return replace(found, tau=tau, multiplier=multiplier)


def _gains(problem: LimitedTracking, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """K (N, T, m, n) of the LQR problem with A, B (N, T, ...)."""
    from dadiff.experts import riccati

    layout, (N, T, n, m) = problem.layout, B.shape
    metric = Metric.diagonal(layout, problem.scale**2)
    none = (np.zeros((T + 1, n, 0)), np.zeros((T, m, 0)), np.zeros((0, 0)), np.zeros((N, 0)))
    linear = np.zeros((N, T, n)), metric.Q, metric.R, np.zeros((N, T + 1, n)), np.zeros((N, T, m))
    return riccati.solve_all(A, B, *linear, *none, np.zeros((N, n)), False, np.zeros(N))[0]


def _pull(layout: TrajectoryLayout, A: np.ndarray, B: np.ndarray, multiplier: np.ndarray) -> np.ndarray:
    """The gradient of lambda' (A x + B u + c - x_next) in tau, (N, d)."""
    zero = np.zeros_like(multiplier[:, :1])
    along = np.einsum("ktij,kti->ktj", A, multiplier)
    states = np.concatenate([along, zero], axis=1) - np.concatenate([zero, multiplier], axis=1)
    return layout.flatten(states, np.einsum("ktij,kti->ktj", B, multiplier))


def follow(problem: LimitedTracking, tau: np.ndarray, step: LimitedStep, a: np.ndarray) -> np.ndarray:
    """Roll the system out after a step from tau (*robots, plans, d), with step lengths a (*robots, plans)."""
    layout, system = problem.layout, problem.system
    target_x, target_u = layout.split(tau + a[..., None] * (step.aim - tau))
    low, high = (layout.inputs(bound.reshape(tau.shape)) for bound in (problem.limits.low, problem.limits.high))
    x, u = np.empty_like(target_x), np.empty_like(target_u)
    x[..., 0, :] = target_x[..., 0, :]
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(layout.horizon):
            away = x[..., t, :] - target_x[..., t, :]
            applied = target_u[..., t, :] + (step.K[..., t, :, :] @ away[..., None])[..., 0]
            u[..., t, :] = np.clip(applied, low[..., t, :], high[..., t, :])
            x[..., t + 1, :] = system.step(x[..., t, :], u[..., t, :], t)
    return layout.flatten(x, u)

"""Errors of plans against the reference, along time: what every task shares.

All are squared Euclidean norms, as in the paper's figures. Plans have shape (*robots, cases, samples, d), references
(*robots, cases, d).
"""

from __future__ import annotations

import numpy as np

from dadiff.systems import System
from dadiff.tasks import Cases, Scores
from dadiff.trajectory.layout import TrajectoryLayout

TINY = float(np.finfo(np.float64).tiny)

VIOLATION = 1e-8
"""By how much a plan must exceed a bound to count as violating it: more than rounding in scaled coordinates."""


def _squared(difference: np.ndarray) -> np.ndarray:
    return np.square(difference).sum(axis=-1)


def _normalised(difference: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Root mean square (...) of differences (*robots, cases, samples, T+1, n), each state over its deviation.

    Args:
        reference: whose states deviate, (*robots, cases, T+1, n).
    """
    deviation = reference.std(axis=(-3, -2))[..., None, None, None, :]
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sqrt(_squared(difference / np.maximum(deviation, TINY)).mean(axis=-1) / difference.shape[-1])


def _to_horizon(values: np.ndarray) -> np.ndarray:
    """(..., T) to (..., T+1): nan at t = T, where there is no input."""
    return np.concatenate([values, np.full((*values.shape[:-1], 1), np.nan)], axis=-1)


def replay(system: System, layout: TrajectoryLayout, planned: np.ndarray, x_init: np.ndarray) -> np.ndarray:
    """The trajectories (*robots, cases, samples, d) that the planned inputs give from x_init, without noise."""
    inputs = layout.inputs(planned)
    return layout.flatten(system.replay(x_init[..., None, :], inputs), inputs)


def dynamics_residual(system: System, layout: TrajectoryLayout, tau: np.ndarray) -> np.ndarray:
    """|x(t+1) - f_t(x(t), u(t))|^2 for t = 0..T-1, (..., T)."""
    x, u = layout.split(tau)
    return _squared(x[..., 1:, :] - system.step(x[..., :-1, :], u, np.arange(layout.horizon)))


def spread(planned: np.ndarray, covariance_trace: float | None = None) -> Scores:
    """How widely the plans of a case scatter: without it an error is half the story, since the mean has the least.

    `spread` is the trace of the sample covariance of a case's plans, given plan by plan as S / (S - 1) times its
    squared distance from their mean; `spread_ratio` is it over that of the law of demonstrations. One plan a case has
    neither, and an unknown law or one without spread gives no ratio.
    """
    if (samples := planned.shape[-2]) < 2:
        return Scores()
    found = _squared(planned - planned.mean(axis=-2, keepdims=True)) * samples / (samples - 1)
    return Scores(
        per_plan={"spread": found, **({"spread_ratio": found / covariance_trace} if covariance_trace else {})}
    )


def violations(
    system: System, layout: TrajectoryLayout, planned: np.ndarray, rollout: np.ndarray | None = None
) -> Scores:
    """By how much plans exceed the system's bounds, where it has any.

    `violation` is a plan's largest, in the units of what is exceeded, `violating` whether it is more than VIOLATION;
    `rollout_violation` is that of the replay. `largest_violation` is that of all plans.
    """
    if not system.bounds.any:
        return Scores()
    violation = _beyond(system, layout, planned)
    per_plan = {"violation": violation, "violating": (violation > VIOLATION).astype(float)}
    if rollout is not None:
        per_plan["rollout_violation"] = _beyond(system, layout, rollout)
    return Scores(per_plan=per_plan, headline={"largest_violation": float(violation.max())})


def _beyond(system: System, layout: TrajectoryLayout, tau: np.ndarray) -> np.ndarray:
    """max(low - tau, tau - high, 0) over the entries of tau (..., d): (...)."""
    bounds = system.bounds.of_states(layout.state_dim), system.bounds.of_inputs(layout.input_dim)
    parts = zip(layout.split(tau), bounds, strict=True)
    exceeded = [np.maximum(low - part, part - high).max(axis=(-2, -1)) for part, (low, high) in parts]
    return np.maximum(np.maximum(*exceeded), 0.0)


def planned_errors(layout: TrajectoryLayout, cases: Cases, planned: np.ndarray) -> Scores:
    """State and input errors as planned: all that can be said where the system is unknown."""
    x, u = layout.split(planned)
    x_ref, u_ref = (part[..., None, :, :] for part in layout.split(cases.reference))
    return Scores(
        per_step={
            "planned_state_error": _squared(x - x_ref),
            "planned_input_error": _to_horizon(_squared(u - u_ref)),
        },
        per_plan={"initial_state_error": _squared(x[..., 0, :] - cases.x_init[..., None, :])},
    )


def tracking_errors(
    system: System, layout: TrajectoryLayout, cases: Cases, planned: np.ndarray, rollout: np.ndarray
) -> Scores:
    """State and input errors as planned and after replay, the gap between the two, and the dynamics' residual.

    `gap_nrmse` is the gap of a plan, each state over its deviation in the robot's references, as a root mean square.
    """
    x, x_replayed = layout.states(planned), layout.states(rollout)
    x_ref = layout.states(cases.reference)[..., None, :, :]
    singular, errors = system.singular(x_replayed), planned_errors(layout, cases, planned)
    return Scores(
        per_step={
            **errors.per_step,
            "rollout_state_error": _squared(x_replayed - x_ref),
            "gap": _squared(x - x_replayed),
            "dynamics_residual": _to_horizon(dynamics_residual(system, layout, planned)),
        },
        per_plan={
            **errors.per_plan,
            "gap_nrmse": _normalised(x - x_replayed, layout.states(cases.reference)),
            **({} if singular is None else {"singular_steps": singular.astype(float)}),
        },
    )

"""Projections within bounds: the nearest trajectory that keeps to them, checked against a conic solver."""

from __future__ import annotations

from dataclasses import replace

import cvxpy
import numpy as np
import pytest
import torch
from laws import SYSTEMS, Linear, exciting, fleet, random_system, trajectories, varying_system

from dadiff.behaviours import Bounded, Dynamics, Identified, IdentifiedSoft, Known, Pin, pins, prediction_error
from dadiff.behaviours.stages import stages_of
from dadiff.errors import NotApplicableError, ShapeError
from dadiff.systems.nonlinear import Nonlinear
from dadiff.systems.system import Bounds
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance

HORIZON, PLANS = 12, 6


def bounded(system, low: float = -0.7, high: float = 0.6, states: float = np.inf) -> Bounded:
    dynamics = Dynamics(system.layout(HORIZON), stages_of(system, HORIZON))
    return Bounded.by(dynamics, Bounds(low, high, -states, states))


def references(system) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories with larger inputs than allowed, disturbed, and their starts."""
    tau, x_init = trajectories(system, HORIZON, PLANS)
    return tau + 0.3 * np.random.default_rng(1).standard_normal(tau.shape), x_init


def nearest(target: Bounded, tau: np.ndarray, x_init: np.ndarray | None, weights: np.ndarray) -> np.ndarray:
    """By a conic solver."""
    G, g = target.dynamics.stages.matrix(target.layout)
    v, start = cvxpy.Variable(target.layout.size), target.layout.initial_state
    entries = range(0 if x_init is None else start.stop, target.layout.size)
    below, above = ([k for k in entries if np.isfinite(b[k])] for b in (target.low, target.high))
    held = [] if x_init is None else [v[start] == x_init]
    inside = [v[below] >= target.low[below], v[above] <= target.high[above]]
    distance = cvxpy.sum_squares(cvxpy.multiply(v - tau, 1 / np.sqrt(weights)))
    options = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-10)
    cvxpy.Problem(cvxpy.Minimize(distance), [G @ v == g, *held, *inside]).solve(solver="CLARABEL", **options)
    return v.value


@pytest.mark.parametrize("held", [True, False], ids=["x(0)", "free"])
@pytest.mark.parametrize("where", [physical, "scaled"], ids=["physical", "scaled"])
def test_it_is_the_nearest_trajectory_within_the_bounds(system, held, where):
    target, (tau, x_init), layout = bounded(system), references(system), system.layout(HORIZON)
    rng = np.random.default_rng(2)
    where = physical(layout) if where is physical else Coordinates(*rng.uniform(0.5, 2, (2, layout.size)))
    P = target.bind(where, [Pin.initial_state(layout, x_init)] if held else ())
    found = where.to_physical(P(where.to_scaled(tau)))
    assert P.info.unconverged == 0
    free = found[:, layout.state_dim :] if held else found
    low, high = (bound[-free.shape[-1] :] for bound in (target.low, target.high))
    assert (np.maximum(low - free, free - high) < 1e-12).all()
    assert ((free <= low + 1e-9) | (free >= high - 1e-9)).mean() > 0.05, "bounds matter here"
    assert np.abs(target.dynamics.stages.residual(layout, found)).max() < 1e-8
    for k in range(2):
        expected = nearest(target, tau[k], x_init[k] if held else None, where.scale**2)
        np.testing.assert_allclose(found[k], expected, atol=1e-5 * np.abs(expected).max())
    if held:
        np.testing.assert_allclose(layout.states(found)[:, 0], x_init, atol=1e-12)


def test_states_and_inputs_are_bounded_together():
    system = SYSTEMS["paper"]
    target, (tau, x_init) = bounded(system, -3, 3, states=2.5), references(system)
    found = target.bind(pins=[Pin.initial_state(system.layout(HORIZON), x_init)])(tau)
    for k in range(3):
        np.testing.assert_allclose(found[k], nearest(target, tau[k], x_init[k], np.ones(tau.shape[-1])), atol=1e-5)


def test_without_a_bound_in_reach_it_is_the_projection(system):
    target, (tau, x_init), layout = bounded(system, -1e3, 1e3), references(system), system.layout(HORIZON)
    held = [Pin.initial_state(layout, x_init)]
    np.testing.assert_allclose(target.bind(pins=held)(tau), target.dynamics.bind(pins=held)(tau), atol=1e-7)


def test_it_is_idempotent_a_batch_is_its_plans_and_tensors_agree(system):
    target, (tau, x_init), layout = bounded(system), references(system), system.layout(HORIZON)
    P = target.bind(pins=[Pin.initial_state(layout, x_init)])
    once = P(tau)
    np.testing.assert_allclose(P(once), once, atol=1e-8)
    np.testing.assert_array_equal(P(torch.from_numpy(tau)).numpy(), once)
    for k in range(PLANS):
        alone = target.bind(pins=[Pin.initial_state(layout, x_init[[k]])])(tau[[k]])
        np.testing.assert_allclose(alone[0], once[k], atol=1e-9)


def test_a_fleet_is_its_robots_one_by_one():
    robots = fleet()
    layout, (tau, x_init) = robots.layout(HORIZON), references(robots)
    together = bounded(robots).bind(pins=[Pin.initial_state(layout, x_init)])(tau)
    for k in range(3):
        one = Linear(robots.A[k], robots.B[k])
        alone = bounded(one).bind(pins=[Pin.initial_state(layout, x_init[k])])(tau[k])
        np.testing.assert_allclose(together[k], alone, atol=1e-8)


def test_in_the_metric_of_a_covariance_the_variances_say_what_gives_way(system):
    target, (tau, x_init), layout = bounded(system), references(system), system.layout(HORIZON)
    P = target.bind(pins=[Pin.initial_state(layout, x_init)])
    weights = np.random.default_rng(3).uniform(0.1, 2, layout.size)
    found = P(tau, Covariance.diagonal_of(weights))
    np.testing.assert_allclose(found[0], nearest(target, tau[0], x_init[0], weights), atol=1e-5)
    U = np.random.default_rng(4).standard_normal((layout.size, 2))
    within = P(tau, Covariance(weights, U))
    assert (within[:, layout.state_dim :] <= target.high[layout.state_dim :] + 1e-12).all()
    assert np.abs(target.dynamics.stages.residual(layout, within)).max() < 1e-7


def test_where_nothing_is_feasible_it_says_of_how_many_plans():
    system = SYSTEMS["paper"]
    layout, target = system.layout(HORIZON), bounded(system, -0.1, 0.1, states=1.0)
    x_init = np.zeros((2, 4))
    x_init[1, 0], x_init[1, 2] = 0.9, 1.0  # too fast to be stopped before the bound
    P = target.bind(pins=[Pin.initial_state(layout, x_init)])
    P(np.zeros((2, layout.size)))
    assert P.info.unconverged == 1
    assert P.info.residual > 1e-3


def random_case(seed: int):
    """Bounds that bind, estimates, starts and coordinates; from some starts nothing stays within."""
    rng = np.random.default_rng(seed)
    n, m, T = int(rng.integers(2, 5)), int(rng.integers(1, 3)), int(rng.integers(4, 13))
    system = varying_system(n, m, T, seed) if seed % 5 == 0 else random_system(n, m, 0.0, seed)
    low_x = np.where(rng.random(n) < 0.3, -np.inf, -rng.uniform(1.2, 2.5, n))
    bounds = Bounds(-rng.uniform(0.2, 1.5, m), rng.uniform(0.2, 1.5, m), low_x, rng.uniform(1.2, 2.5, n))
    target = Bounded.by(Dynamics(system.layout(T), stages_of(system, T)), bounds)
    d = target.layout.size
    where = Coordinates(rng.standard_normal(d), rng.uniform(0.5, 2, d))
    return target, rng.standard_normal((4, d)), 0.8 * rng.standard_normal((4, n)), where


def test_a_hundred_random_plans_agree_with_a_conic_solver_also_where_it_finds_none():
    infeasible = 0
    for seed in range(25):
        target, tau, x_init, where = random_case(seed)
        P = target.bind(where, [Pin.initial_state(target.layout, x_init)])
        projected = where.to_physical(P(where.to_scaled(tau)))
        solved = [nearest(target, aim, start, where.scale**2) for aim, start in zip(tau, x_init, strict=True)]
        there = np.array([one is not None for one in solved])
        assert P.info.unconverged == (~there).sum(), seed
        infeasible += P.info.unconverged
        expected = np.array([one for one in solved if one is not None]).reshape(-1, target.layout.size)
        found = projected[there]
        objective = [np.square((z - tau[there]) / where.scale).sum(axis=-1) for z in (found, expected)]
        np.testing.assert_allclose(*objective, atol=1e-6)
        assert np.abs(target.dynamics.stages.residual(target.layout, found)).max(initial=0.0) < 1e-8
        beyond = np.maximum(target.low - found, found - target.high)[:, target.layout.state_dim :]
        assert beyond.max(initial=0.0) < 1e-8
    assert 0 < infeasible < 50


def test_learned_dynamics_keep_to_the_systems_bounds(rng):
    system = replace(random_system(3, 1, 0.0, seed=1), bounds=Bounds(-0.6, 0.6, -1.5, 1.5))
    projector, layout = Identified(bounds="enforced"), system.layout(HORIZON)
    assert projector.needs == {"recording", "system"}
    learned = projector.fit(layout, system, exciting().record(system))
    known, z = Known(bounds="enforced").fit(layout, system), rng.standard_normal((5, layout.size))
    np.testing.assert_allclose(learned.bind()(z), known.bind()(z), atol=1e-6)
    assert prediction_error(learned, system, known.bind()(z))["prediction_error"] < 1e-8


def test_bounds_that_cannot_be_held_are_refused(rng):
    curved = Nonlinear(lambda x, u: x + u, 1, 1, bounds=Bounds(input_high=1.0))
    with pytest.raises(NotApplicableError, match="linear dynamics only"):
        Known(bounds="enforced").fit(curved.layout(3), curved)
    layout = SYSTEMS["paper"].layout(HORIZON)
    with pytest.raises(NotApplicableError, match="trusted in part"):
        IdentifiedSoft(bounds="enforced").fit(layout, demonstrations=rng.standard_normal((9, layout.size)))


def test_known_takes_the_systems_bounds_where_it_has_any():
    free, limited = Linear(np.eye(2), np.eye(2)), Linear(np.eye(2), np.eye(2), bounds=Bounds(-1.0, 2.0))
    known, layout = Known("fixed", bounds="enforced"), free.layout(3)
    assert isinstance(known.fit(layout, free), Dynamics)
    x_init = np.zeros((1, 2))
    plan = known.fit(layout, limited).bind(pins=pins(known, layout, x_init))(np.full((1, layout.size), 5.0))
    np.testing.assert_allclose(layout.inputs(plan), 2.0)
    with pytest.raises(ShapeError, match="bounds have shapes"):
        Bounded(known.fit(layout, free), np.zeros(3), np.ones(3))

"""Tracking: equal to the dense solution where the system is linear, to IPOPT where not, and optimal by costates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import ipopt

from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError, ShapeError
from dadiff.experts import ilqr
from dadiff.experts.ilqr import Metric, Tracking, backtrack, gauss_newton, solve
from dadiff.experts.limited_ilqr import LimitedTracking
from dadiff.experts.nearest import Limits
from dadiff.systems import Bounds, Linear
from dadiff.systems.nonlinear import Nonlinear
from dadiff.systems.quadrotors import PlanarQuadrotor

HORIZON = 12


def quadrotors(rng, robots=3):
    a, b, c = rng.uniform(0.5, 1.5, robots), rng.uniform(0.4, 2, robots), rng.uniform(0, 1, robots)
    return PlanarQuadrotor(thrust_gain=a, torque_gain=b, drag=c)


def starts(rng, *lead):
    return rng.uniform(-1, 1, (*lead, 6)) * [2, 2, 0.5, 1, 1, 1]


def metric(layout, rng, directions):
    return Metric.diagonal(layout, rng.uniform(0.2, 2, layout.size), rng.standard_normal((layout.size, directions)))


def times(M, v):
    return (M @ v[..., None])[..., 0]


def costates(problem: Tracking, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The optimality conditions of feasible plans, without pins: costates lambda(1:T) and the gradients in the inputs.

        lambda(T) = q(T),   lambda(t) = q(t) + A' lambda(t+1),   gradient(t) = r(t) + B' lambda(t+1) = 0

    with [q; r] = C^-1 (tau - tau_ref).

    Returns:
        (*robots, plans, T, n) and (*robots, plans, T, m).
    """
    layout, metric = problem.layout, problem.metric
    x, u = layout.split(tau)
    A, B, _ = problem.system.linearise(x[..., :-1, :], u, np.arange(layout.horizon))
    delta = tau - problem.reference
    z = np.linalg.solve(metric.M, (delta @ metric.WU)[..., None])[..., 0]
    q, r = layout.split(metric.times(delta) - z @ metric.WU.T)
    costate = np.empty_like(x[..., 1:, :])
    costate[..., -1, :] = q[..., -1, :]
    for t in range(layout.horizon - 1, 0, -1):
        costate[..., t - 1, :] = q[..., t, :] + times(A[..., t, :, :].swapaxes(-1, -2), costate[..., t, :])
    return costate, r + times(B.swapaxes(-1, -2), costate)


def references(layout, rng, *lead):
    """Rough, infeasible plans."""
    return 0.3 * rng.standard_normal((*lead, layout.size))


@pytest.mark.parametrize("directions", [0, 3])
@pytest.mark.parametrize("pins", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_on_linear_systems_one_sweep_is_the_projection(directions, pins, free, rng):
    """tau_ref - C G' (G C G')^-1 (G tau_ref - g), with x(0) and pins as rows of G."""
    n, m, T, plans = 4, 2, 7, 5
    A, B = np.eye(n) + 0.2 * rng.standard_normal((n, n)), rng.standard_normal((n, m))
    system = Nonlinear(
        lambda x, u: x @ A.T + u @ B.T, n, m, jacobian=lambda x, u: (A + 0 * x[..., None], B + 0 * x[..., None])
    )
    layout = system.layout(T)
    weights, reference = metric(layout, rng, directions), references(layout, rng, plans)
    where, x_init = np.r_[n * T : n * (T + 1)], rng.standard_normal((plans, n))
    values = rng.standard_normal((plans, n))
    problem = Tracking(system, weights, reference, None if free else x_init, (where, values) if pins else None)
    found = solve(problem, sweeps=1).tau
    rows, right = [stages_of(Linear(A, B), T).matrix(layout)[0]], [np.zeros((plans, n * T))]
    if not free:
        rows, right = [*rows, np.eye(layout.size)[layout.initial_state]], [*right, x_init]
    if pins:
        rows, right = [*rows, np.eye(layout.size)[where]], [*right, values]
    G, g = np.concatenate(rows), np.concatenate(right, axis=-1)
    W = np.diag(weights.times(np.ones(layout.size)))
    C = np.linalg.inv(W) + weights.U @ weights.U.T
    expected = reference - np.linalg.solve(G @ C @ G.T, (reference @ G.T - g).T).T @ G @ C
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("directions", [0, 3])
def test_plans_are_feasible_optimal_and_no_worse_than_before(directions, rng):
    system = quadrotors(rng)
    layout = system.layout(HORIZON)
    problem = Tracking(system, metric(layout, rng, directions), references(layout, rng, 3, 6), starts(rng, 3, 6))
    first = solve(problem, sweeps=1)
    found = solve(problem, first.tau)
    assert found.converged.all()
    assert (found.cost <= first.cost).all()
    states, inputs = layout.split(found.tau)
    np.testing.assert_array_equal(system.simulate(problem.x_init, inputs), states)
    costate, gradient = costates(problem, found.tau)
    assert np.abs(gradient).max() < 1e-4 * np.abs(costate).max()


def test_pinned_ends_are_met(rng):
    system = quadrotors(rng)
    layout = system.layout(30)
    where, values = np.arange(layout.size)[layout.all_states][-6:], np.zeros((3, 4, 6))
    reference = np.zeros((3, 4, layout.size))
    problem = Tracking(system, metric(layout, rng, 0), reference, starts(rng, 3, 4), (where, values))
    found = solve(problem, sweeps=200)
    assert found.converged.all()
    np.testing.assert_allclose(layout.states(found.tau)[..., -1, :], 0, atol=1e-6)


def test_a_batch_is_its_plans(rng):
    system = PlanarQuadrotor()
    layout = system.layout(HORIZON)
    problem = Tracking(system, metric(layout, rng, 2), references(layout, rng, 5), starts(rng, 5))
    together = solve(problem, sweeps=3).tau
    alone = [solve(problem.take(np.array([i])), sweeps=3).tau[0] for i in range(5)]
    np.testing.assert_allclose(together, alone, atol=1e-12)


def test_an_optimum_stays(rng):
    system = PlanarQuadrotor()
    layout = system.layout(HORIZON)
    feasible = layout.flatten(system.simulate(starts(rng, 5), inputs := rng.standard_normal((5, HORIZON, 2))), inputs)
    problem = Tracking(system, metric(layout, rng, 2), feasible, layout.states(feasible)[:, 0])
    np.testing.assert_allclose(solve(problem).tau, feasible, atol=1e-12)
    step = gauss_newton(problem, feasible, np.zeros(5), problem.feasible(feasible))
    np.testing.assert_allclose(step.feedforward, 0, atol=1e-12)


def test_variances_are_positive(rng):
    layout = PlanarQuadrotor().layout(2)
    with pytest.raises(ConfigError, match=r"variances reach down to 0; .* give the covariance a floor"):
        Metric.diagonal(layout, np.zeros(layout.size))


@pytest.mark.parametrize("directions", [0, 3])
def test_ipopt_finds_the_same_cost(directions, rng):
    pytest.importorskip("casadi")
    system = PlanarQuadrotor(thrust_gain=0.7, torque_gain=1.3, drag=0.4)
    layout = system.layout(HORIZON)
    weights = metric(layout, rng, directions)
    problem = Tracking(system, weights, references(layout, rng, 3), starts(rng, 3))
    found = solve(problem)
    C = np.diag(1 / weights.times(np.ones(layout.size))) + weights.U @ weights.U.T
    for reference, x_init, cost in zip(problem.reference, problem.x_init, found.cost, strict=True):
        assert cost == pytest.approx(ipopt(system, layout, np.linalg.inv(C), reference, x_init)[0], rel=1e-6)


def test_a_start_need_not_be_feasible(rng):
    """It is made so by the first sweep, and leads where others do."""
    system = PlanarQuadrotor()
    layout = system.layout(HORIZON)
    problem = Tracking(system, metric(layout, rng, 2), references(layout, rng, 5), starts(rng, 5))
    rough = references(layout, rng, 5)
    assert not problem.feasible(rough).any()
    found = solve(problem, rough)
    assert problem.feasible(found.tau).all()
    np.testing.assert_allclose(found.cost, solve(problem).cost, rtol=1e-8)


def test_steps_are_halved_plan_by_plan_until_none_is_worse():
    """Merits are played: one plan may move by 1, one by a quarter at most, one not at all, one has ended."""
    tried, tau, most = [], np.zeros((4, 1)), np.array([1.0, 0.3, 0.0, 1.0])

    def trial(a):
        tried.append(a.copy())
        return a[:, None]

    def merit(plans):
        return np.where(plans[:, 0] <= most, 1 - plans[:, 0], 2.0)

    ended = np.array([False, False, False, True])
    best, least, moved = backtrack(trial, merit, tau, np.ones(4), np.zeros(4), 5, ended)
    np.testing.assert_array_equal(best[:, 0], [1.0, 0.25, 0.0, 0.0])
    np.testing.assert_array_equal(least, [0.0, 0.75, 1.0, 1.0])
    assert moved.tolist() == [True, True, False, False]
    np.testing.assert_array_equal([a[2] for a in tried], [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16])


def test_damping_falls_tenfold_with_each_sweep_that_helps_and_ends_at_0(rng):
    robots = quadrotors(rng)
    layout = robots.layout(HORIZON)
    problem = Tracking(robots, metric(layout, rng, 0), rng.standard_normal((3, 2, layout.size)), starts(rng, 3, 2))
    plans = ilqr._Plans.of(problem, solve(problem).tau + 1e-3)
    for damping, expected in ((1.0, 0.1), (10 * ilqr._DAMPING, ilqr._DAMPING), (ilqr._DAMPING, 0.0), (0.0, 0.0)):
        after = ilqr._sweep(problem, replace(plans, damping=np.full_like(plans.damping, damping)), 1e-12)
        np.testing.assert_allclose(after.damping, np.full_like(plans.damping, expected), rtol=1e-12)


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("shape", [(3, 2, -1), (3, 0), (2, 2, 0), (3, 2, 2, 0)])
def test_references_are_given_robot_by_robot_plan_by_plan_and_whole(shape, bounded, rng):
    """The last number is added to d."""
    robots = replace(quadrotors(rng), bounds=Bounds(-1.0, 1.0))
    layout = robots.layout(HORIZON)
    reference = np.zeros((*shape[:-1], layout.size + shape[-1]))
    limited = (layout, reference, np.ones(layout.size), Limits.nothing(layout, 6))
    kind, given = (LimitedTracking, limited) if bounded else (Tracking, (metric(layout, rng, 0), reference))
    with pytest.raises(ShapeError, match=rf"expected \(3, 'plans', {layout.size}\)"):
        kind(robots, *given)

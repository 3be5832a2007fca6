"""Projections within limits: the nearest trajectory within bounds and clear of discs, checked against others."""

from __future__ import annotations

from dataclasses import replace

import cvxpy
import numpy as np
import pytest
import torch
from laws import SYSTEMS, Linear, composed, exciting, fleet, random_system, trajectories, varying_system

from dadiff.behaviours import (
    Dynamics,
    Identified,
    IdentifiedSoft,
    Known,
    KnownClear,
    Limited,
    Pin,
    pins,
    prediction_error,
)
from dadiff.behaviours.stages import stages_of
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.experts.nearest import Limits, within
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.systems import double_integrator
from dadiff.systems.system import Bounds
from dadiff.tasks import LQR
from dadiff.tasks.encodings import PathFrame
from dadiff.tasks.obstacle_scores import collision_scores
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance

HORIZON, PLANS = 12, 6
SYSTEM = double_integrator(process_noise=0.0)


def bounded(system, low: float = -0.7, high: float = 0.6, states: float = np.inf) -> Limited:
    dynamics = Dynamics(system.layout(HORIZON), stages_of(system, HORIZON))
    return Limited(dynamics, Bounds(low, high, -states, states))


def references(system) -> tuple[np.ndarray, np.ndarray]:
    """Trajectories with larger inputs than allowed, disturbed, and their starts."""
    tau, x_init = trajectories(system, HORIZON, PLANS)
    return tau + 0.3 * np.random.default_rng(1).standard_normal(tau.shape), x_init


def nearest(
    target: Limited, tau: np.ndarray, x_init: np.ndarray | None, weights: np.ndarray, planes: Limits | None = None
) -> np.ndarray:
    """By a conic solver; half-planes are those of one plan."""
    layout = target.layout
    (G, g), (low, high) = target.dynamics.stages.matrix(layout), within(layout, target.bounds)
    v, start = cvxpy.Variable(layout.size), layout.initial_state
    entries = range(0 if x_init is None else start.stop, layout.size)
    below, above = ([k for k in entries if np.isfinite(b[k])] for b in (low, high))
    held = [] if x_init is None else [v[start] == x_init]
    inside = [v[below] >= low[below], v[above] <= high[above]]
    for t, j in [] if planes is None else np.argwhere(np.isfinite(planes.offset[0])):
        p = v[layout.state_dim * t : layout.state_dim * t + 2]
        inside.append(planes.normal[0, t, j] @ p >= planes.offset[0, t, j])
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
    low, high = (bound[-free.shape[-1] :] for bound in within(layout, target.bounds))
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
    kept = P(tau, Covariance(weights, U))
    assert (kept[:, layout.state_dim :] <= within(layout, target.bounds)[1][layout.state_dim :] + 1e-12).all()
    assert np.abs(target.dynamics.stages.residual(layout, kept)).max() < 1e-7


def test_where_nothing_is_feasible_it_says_of_how_many_plans():
    system = SYSTEMS["paper"]
    layout, target = system.layout(HORIZON), bounded(system, -0.1, 0.1, states=1.0)
    x_init = np.zeros((2, 4))
    x_init[1, 0], x_init[1, 2] = 0.9, 1.0  # too fast to be stopped before the bound
    P = target.bind(pins=[Pin.initial_state(layout, x_init)])
    P(np.zeros((2, layout.size)))
    assert (P.info.unconverged, P.info.infeasible) == (1, 1)
    assert P.info.residual > 1e-3


def random_case(seed: int):
    """Bounds that bind, half-planes, estimates, starts and coordinates; from some starts nothing stays within."""
    rng = np.random.default_rng(seed)
    n, m, T = int(rng.integers(2, 5)), int(rng.integers(1, 3)), int(rng.integers(4, 13))
    system = varying_system(n, m, T, seed) if seed % 5 == 0 else random_system(n, m, 0.0, seed)
    low_x = np.where(rng.random(n) < 0.3, -np.inf, -rng.uniform(1.2, 2.5, n))
    bounds = Bounds(-rng.uniform(0.2, 1.5, m), rng.uniform(0.2, 1.5, m), low_x, rng.uniform(1.2, 2.5, n))
    discs = np.tile([0.7, 0.4, 0.3, seed % 2], (4, 1, 1))
    target = Limited(Dynamics(system.layout(T), stages_of(system, T)), bounds, margin=0.1, rounds=1, discs=discs)
    d = target.layout.size
    where = Coordinates(rng.standard_normal(d), rng.uniform(0.5, 2, d))
    return target, rng.standard_normal((4, d)), 0.8 * rng.standard_normal((4, n)), where


def agree_with_a_conic_solver(seeds: range) -> tuple[int, int]:
    """Objectives, limits and the counts of plans for which there is nothing; these counts, proven and in all."""
    infeasible = proven = 0
    for seed in seeds:
        target, tau, x_init, where = random_case(seed)
        layout, held = target.layout, [Pin.initial_state(target.layout, x_init)]
        P = target.bind(where, held)
        projected = where.to_physical(P(where.to_scaled(tau)))
        path = layout.states(where.to_physical(target.dynamics.bind(where, held)(where.to_scaled(tau))))[..., :2]
        planes = Limits.nothing(layout, 4).clear_of(path, target.discs[..., :2], 0.4 * target.discs[..., 3])
        solved = [
            nearest(target, tau[k], x_init[k], where.scale**2, planes.take(np.array([k]))) for k in range(len(tau))
        ]
        there = np.array([one is not None for one in solved])
        assert P.info.unconverged == (~there).sum(), seed
        infeasible, proven = infeasible + P.info.unconverged, proven + P.info.infeasible
        expected = np.array([one for one in solved if one is not None]).reshape(-1, layout.size)
        found = projected[there]
        objective = [np.square((z - tau[there]) / where.scale).sum(axis=-1) for z in (found, expected)]
        np.testing.assert_allclose(*objective, atol=1e-6)
        assert np.abs(target.dynamics.stages.residual(layout, found)).max(initial=0.0) < 1e-8
        (low, high), beyond = within(layout, target.bounds), planes.take(there).exceeded(layout, found)
        beyond = np.maximum(np.maximum(low - found, found - high)[:, layout.state_dim :].max(axis=-1), beyond)
        assert beyond.max(initial=0.0) < 1e-8
    return infeasible, proven


def test_a_hundred_random_plans_agree_with_a_conic_solver_also_where_it_finds_none():
    infeasible, proven = agree_with_a_conic_solver(range(25))
    assert 0 < infeasible < 60
    assert proven == infeasible


@pytest.mark.slow
def test_so_do_four_hundred_more():
    infeasible, proven = agree_with_a_conic_solver(range(100, 200))
    assert proven >= 0.9 * infeasible


def test_learned_dynamics_keep_to_the_systems_bounds(rng):
    system = replace(random_system(3, 1, 0.0, seed=1), bounds=Bounds(-0.6, 0.6, -1.5, 1.5))
    projector, layout = Identified(bounds="enforced"), system.layout(HORIZON)
    assert projector.needs == {"recording", "system"}
    learned = projector.fit(layout, system, exciting().record(system))
    known, z = Known(bounds="enforced").fit(layout, system), rng.standard_normal((5, layout.size))
    np.testing.assert_allclose(learned.bind()(z), known.bind()(z), atol=1e-6)
    assert prediction_error(learned, system, known.bind()(z))["prediction_error"] < 1e-8


def test_bounds_that_cannot_be_held_are_refused(rng):
    layout = SYSTEMS["paper"].layout(HORIZON)
    with pytest.raises(NotApplicableError, match="trusted in part"):
        IdentifiedSoft(bounds="enforced").fit(layout, demonstrations=rng.standard_normal((9, layout.size)))


def test_bounds_of_a_system_that_has_none_are_asked_for():
    free, limited = Linear(np.eye(2), np.eye(2)), Linear(np.eye(2), np.eye(2), bounds=Bounds(-1.0, 2.0))
    known, layout = Known("fixed", bounds="enforced"), free.layout(3)
    with pytest.raises(ConfigError, match="the system has none"):
        known.fit(layout, free)
    x_init = np.zeros((1, 2))
    plan = known.fit(layout, limited).bind(pins=pins(known, layout, x_init))(np.full((1, layout.size), 5.0))
    np.testing.assert_allclose(layout.inputs(plan), 2.0)


# --- among the discs of an environment ------------------------------------------------------------------------------


def test_plans_that_enter_discs_are_brought_out_of_them_and_others_stay() -> None:
    task = Obstacles()
    cases = task.cases(SYSTEM, 60, np.random.default_rng(0))
    layout = SYSTEM.layout(task.horizon)
    free = PathFrame().encoder(task, SYSTEM).encode(cases.environment)[1]  # the obstacle-free optima
    target = Limited(Dynamics(layout, stages_of(SYSTEM, task.horizon)), margin=0.03)
    start = Pin.initial_state(layout, cases.x_init)
    project = target.among(cases.condition, cases.environment).bind(pins=[start])
    environments = task.decode(cases.environment)

    def collisions(tau: np.ndarray) -> np.ndarray:
        return collision_scores(environments, layout.states(tau)[:, None, :, :2])[0]["collision"][:, 0]

    found = project(free)
    assert collisions(free).mean() > 0.4
    assert collisions(found).sum() == project.info.unconverged == 0
    np.testing.assert_allclose(layout.states(found)[:, 0], cases.x_init, atol=1e-12)
    np.testing.assert_allclose(project(cases.reference), cases.reference, atol=1e-9)  # clear already
    torch.testing.assert_close(project(torch.tensor(free)), torch.tensor(found))


def test_without_an_environment_it_is_the_projection_onto_the_dynamics(rng) -> None:
    dynamics = Dynamics(SYSTEM.layout(HORIZON), stages_of(SYSTEM, HORIZON))
    tau = rng.standard_normal((5, dynamics.layout.size))
    np.testing.assert_allclose(Limited(dynamics, margin=0.03).bind()(tau), dynamics.bind()(tau), atol=1e-8)


def test_a_condition_without_discs_is_refused() -> None:
    target = Limited(Dynamics(SYSTEM.layout(HORIZON), stages_of(SYSTEM, HORIZON)), margin=0.03)
    with pytest.raises(NotApplicableError, match="a condition with discs"):
        target.among(LQR().condition(SYSTEM), np.zeros((1, 8)))


def test_a_planner_keeps_clear_of_the_discs_of_what_it_is_asked(tmp_path) -> None:
    """A real run, hardly trained: without the projection its plans collide."""
    small = (
        "task=obstacles",
        "training.steps=20",
        "denoiser.width=32",
        "dataset.train_size=100",
        "dataset.test_size=10",
    )
    rest = ("evaluation.samples=2", "device=cpu", "progress=false", f"output_dir={tmp_path}", "enforcement=post_hoc")
    known, clear = (
        execute(Experiment.of(composed(*small, *rest, f"projector={name}"))) for name in ("known_fixed", "known_clear")
    )
    assert clear.metrics["collision_rollout"] < 0.7 * known.metrics["collision_rollout"]


@pytest.mark.parametrize(
    ("options", "kept"), [({"rounds": 1, "margin": 0.0}, True), ({"rounds": 0}, False), ({"margin": -1e-3}, False)]
)
def test_discs_need_a_round_and_a_margin_that_is_not_negative(options, kept) -> None:
    if kept:
        assert KnownClear(**options).rounds == 1
        return
    with pytest.raises(ConfigError, match="need >= 0 and >= 1"):
        KnownClear(**options)

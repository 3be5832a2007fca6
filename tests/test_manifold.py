"""Projection onto nonlinear dynamics: feasible after each sweep, the affine projection where dynamics are linear."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dadiff.behaviours import Dynamics, Known, Manifold, Pin, Stages
from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.nonlinear import Nonlinear
from dadiff.systems.quadrotors import PlanarQuadrotor
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.covariance import Covariance

HORIZON = 12
ROBOTS = PlanarQuadrotor(
    thrust_gain=np.array([0.5, 1.0, 1.5]), torque_gain=np.array([2.0, 1.0, 0.4]), drag=np.array([0.0, 0.5, 1.0])
)
LAYOUT = ROBOTS.layout(HORIZON)


def coordinates(layout, rng):
    return Coordinates(rng.standard_normal(layout.size), rng.uniform(0.5, 2, layout.size))


def covariance(layout, rng, directions=3):
    return Covariance(rng.uniform(0.2, 2, layout.size), rng.standard_normal((layout.size, directions)))


def bound(rng, sweeps=1, where=None, plans=4):
    x_init = 0.3 * rng.standard_normal((3, plans, 6))
    return Manifold(LAYOUT, ROBOTS, sweeps).bind(where, [Pin.initial_state(LAYOUT, x_init)]), x_init


def rough(rng, *lead):
    return 0.3 * rng.standard_normal((*lead, LAYOUT.size))


@pytest.mark.parametrize("weighted", [False, True])
def test_plans_are_feasible_after_one_sweep(weighted, rng):
    where = coordinates(LAYOUT, rng)
    project, x_init = bound(rng, where=where)
    tau = where.to_physical(project(where.to_scaled(rough(rng, 3, 4)), covariance(LAYOUT, rng) if weighted else None))
    states, inputs = LAYOUT.split(tau)
    np.testing.assert_allclose(states[..., 0, :], x_init, atol=1e-12)
    np.testing.assert_allclose(ROBOTS.simulate(x_init, inputs), states, atol=1e-12)
    assert (project.info.kind, project.info.iterations, project.info.unconverged) == ("manifold", 1, 0)
    assert project.info.rank == LAYOUT.rank - 6


def test_projecting_again_changes_nothing(rng):
    project, _ = bound(rng, sweeps=60)
    once = project(rough(rng, 3, 4))
    np.testing.assert_allclose(project(once), once, atol=1e-9)


def test_a_warm_start_leads_where_a_cold_one_does(rng):
    project, x_init = bound(rng, sweeps=60)
    tau = rough(rng, 3, 4)
    hover = LAYOUT.flatten(ROBOTS.simulate(x_init, np.zeros((3, 4, HORIZON, 2))), np.zeros((3, 4, HORIZON, 2)))
    np.testing.assert_allclose(project(tau, start=hover), project(tau), atol=1e-5)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("pinned", ["nothing", "x(0)", "both ends"])
def test_on_linear_systems_it_is_the_affine_projection(weighted, pinned, rng):
    n, m, T = 3, 2, 6
    A, B = np.eye(n) + 0.2 * rng.standard_normal((n, n)), rng.standard_normal((n, m))
    system = Nonlinear(
        lambda x, u: x @ A.T + u @ B.T, n, m, jacobian=lambda x, u: (A + 0 * x[..., None], B + 0 * x[..., None])
    )
    layout, where = system.layout(T), coordinates(system.layout(T), rng)
    ends = [Pin.initial_state(layout, rng.standard_normal((5, n))), Pin.terminal_state(layout, np.ones((1, n)))]
    pins = ends[: ["nothing", "x(0)", "both ends"].index(pinned)]
    metric = covariance(layout, rng) if weighted else None
    z = rng.standard_normal((5, layout.size))
    expected = Dynamics(layout, Stages.constant(A, B, None, T)).bind(where, pins)(z, metric)
    np.testing.assert_allclose(Manifold(layout, system).bind(where, pins)(z, metric), expected, atol=1e-9)


def test_tensors_give_tensors(rng):
    project, _ = bound(rng)
    tau = rough(rng, 3, 2, 2)
    found = project(torch.as_tensor(tau))
    assert isinstance(found, torch.Tensor)
    np.testing.assert_array_equal(found.numpy(), project(tau))


def test_a_dense_covariance_is_taken_by_its_leading_directions(rng):
    """What is of that rank, beside equal variances, is kept."""
    project, _ = bound(rng, sweeps=60)
    exact = Covariance(np.full(LAYOUT.size, 0.3), rng.standard_normal((LAYOUT.size, 5)))
    tau = rough(rng, 3, 4)
    np.testing.assert_allclose(project(tau, Covariance.dense(exact.matrix)), project(tau, exact), atol=1e-6)


def test_terminal_pins_that_one_sweep_misses_are_counted(rng):
    x_init, end = np.zeros((3, 4, 6)), np.zeros((3, 1, 6))
    x_init[..., 0], x_init[..., 2] = 2.0, 1.0
    layout = ROBOTS.layout(30)
    pins = [Pin.initial_state(layout, x_init), Pin.terminal_state(layout, end)]
    one, many = (Manifold(layout, ROBOTS, sweeps).bind(None, pins) for sweeps in (1, 100))
    tau = 0.1 * rng.standard_normal((3, 4, layout.size))
    one(tau), many(tau)
    assert one.info.unconverged == 12
    assert one.info.residual > 1e-3
    assert many.info.unconverged == 0
    assert many.info.residual < 1e-5


def test_known_dynamics_of_a_nonlinear_system_are_a_manifold():
    found = Known(sweeps=3).fit(LAYOUT, ROBOTS)
    assert isinstance(found, Manifold)
    assert found.sweeps == 3


def test_what_cannot_be_projected_is_refused(rng):
    project, x_init = bound(rng)
    with pytest.raises(ShapeError, match="robots first"):
        project(rough(rng, 4, 4))
    with pytest.raises(ConfigError, match="one metric for all"):
        project(rough(rng, 3, 4), Covariance.diagonal_of(np.ones((3, LAYOUT.size))))
    with pytest.raises(ConfigError, match=r"2 of the 6 entries of x\(0\) are pinned"):
        Manifold(LAYOUT, ROBOTS).bind(None, [Pin(slice(0, 2), x_init[..., :2])])
    with pytest.raises(ConfigError, match="sweeps is 0"):
        Known(sweeps=0).fit(LAYOUT, ROBOTS)

"""Laws of responses: F [x(0); u] is the roll-out, whatever the sizes, and a fleet is its robots one by one."""

from __future__ import annotations

import numpy as np
import pytest
from laws import fleet, members, tolerance, varying_system

from dadiff.behaviours.stages import stages_of
from dadiff.trajectory.response import along, forced_response, free_response

HORIZON = 7


@pytest.mark.parametrize("horizon", [1, 2, HORIZON])
def test_the_trajectory_map_and_the_offset_are_the_roll_out(affine, rng, horizon):
    system, layout = affine, affine.layout(horizon)
    x_init = rng.standard_normal((5, layout.state_dim))
    inputs = rng.standard_normal((5, horizon, layout.input_dim))
    tau = layout.flatten(system.simulate(x_init, inputs), inputs)
    sources = np.concatenate([x_init, inputs.reshape(5, -1)], axis=-1)
    mapped = sources @ system.trajectory_map(horizon).T + system.offset(horizon)
    np.testing.assert_allclose(mapped, tau, atol=tolerance(size=layout.size) * np.abs(tau).max())


def test_the_dynamics_matrix_gives_the_offset(affine, rng):
    """G tau = [c_0; ...; c_{T-1}] of every roll-out, and of nothing else: it has full row rank."""
    x_init, inputs = rng.standard_normal(affine.state_dim), rng.standard_normal((HORIZON, affine.input_dim))
    layout = affine.layout(HORIZON)
    G, g = stages_of(affine, HORIZON).matrix(layout)
    np.testing.assert_allclose(G @ layout.flatten(affine.simulate(x_init, inputs), inputs), g, atol=1e-12)
    assert np.linalg.matrix_rank(G) == len(G) == HORIZON * affine.state_dim


def test_a_roll_out_satisfies_the_dynamics_step_by_step(affine, rng):
    system = affine
    x_init, inputs = rng.standard_normal(system.state_dim), rng.standard_normal((HORIZON, system.input_dim))
    noise = rng.standard_normal((HORIZON, system.state_dim))
    x = system.simulate(x_init, inputs, noise)
    assert np.array_equal(x[0], x_init)
    for t in range(HORIZON):
        A, B, c = system.at(t)
        np.testing.assert_allclose(x[t + 1], A @ x[t] + B @ inputs[t] + c + noise[t], atol=1e-13)


def test_responses_are_made_of_powers(system):
    A, B = system.A, system.B
    n, m = B.shape
    stacked_A, stacked_B, _ = system.matrices(HORIZON)
    P = [np.linalg.matrix_power(A, t) for t in range(HORIZON + 1)]
    free = free_response(stacked_A).reshape(HORIZON + 1, n, n)
    forced = forced_response(stacked_A, stacked_B).reshape(HORIZON + 1, n, HORIZON, m)
    for t in range(HORIZON + 1):
        np.testing.assert_allclose(free[t], P[t], atol=1e-12)
        for s in range(HORIZON):
            np.testing.assert_allclose(forced[t, :, s], P[t - 1 - s] @ B if s < t else 0 * B, atol=1e-13)


def test_the_trajectory_map_has_full_column_rank(system):
    F = system.trajectory_map(HORIZON)
    assert F.shape == (system.layout(HORIZON).size, system.layout(HORIZON).rank)
    assert np.linalg.matrix_rank(F) == system.layout(HORIZON).rank


@pytest.mark.parametrize("robots", [fleet(), varying_system(3, 2, 12, 0, 3)], ids=["linear", "time-varying"])
def test_a_fleet_is_its_robots_one_by_one(robots, rng):
    x_init, inputs = rng.standard_normal((3, 5, 3)), rng.standard_normal((3, 5, HORIZON, 2))
    noise = rng.standard_normal((3, 5, HORIZON, 3))
    together, F = robots.simulate(x_init, inputs, noise), robots.trajectory_map(HORIZON)
    for k, robot in enumerate(members(robots)):
        np.testing.assert_allclose(together[k], robot.simulate(x_init[k], inputs[k], noise[k]), atol=1e-13)
        np.testing.assert_allclose(F[k], robot.trajectory_map(HORIZON), atol=1e-13)
        np.testing.assert_allclose(robots.offset(HORIZON)[k], robot.offset(HORIZON), atol=1e-13)


def test_one_initial_state_serves_many_inputs(affine, rng):
    system = affine
    x_init = rng.standard_normal((4, 1, system.state_dim))
    inputs = rng.standard_normal((4, 6, HORIZON, system.input_dim))
    states = system.simulate(x_init, inputs)
    assert states.shape == (4, 6, HORIZON + 1, system.state_dim)
    np.testing.assert_allclose(states[2, 3], system.simulate(x_init[2, 0], inputs[2, 3]), atol=1e-13)


@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
@pytest.mark.parametrize("between", [(), (4,), (4, 5)])
def test_along_multiplies_every_vector(rng, lead, between):
    M, v = rng.standard_normal((*lead, 3, 6)), rng.standard_normal((*lead, *between, 6))
    by_einsum = np.einsum("rab,rkb->rka", M.reshape(-1, 3, 6), v.reshape(int(np.prod(lead)), -1, 6))
    np.testing.assert_allclose(along(M, v), by_einsum.reshape(*lead, *between, 3), atol=1e-13)


def test_values_that_leave_float_range_stay_visible():
    from dadiff.systems import Linear

    states = Linear([[1e200]], [[1.0]]).simulate(np.ones(1), np.zeros((3, 1)))
    assert np.isfinite(states[1]).all()
    assert not np.isfinite(states[2:]).any()

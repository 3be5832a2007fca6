"""Nonlinear systems: their derivatives agree however they are found, and steps agree with a fine integrator."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.nonlinear import Continuous, Nonlinear, Simulated
from dadiff.systems.quadrotors import GRAVITY, PlanarQuadrotor

QUADROTORS = PlanarQuadrotor(
    thrust_gain=np.array([0.5, 1.0, 1.5]), torque_gain=np.array([2.0, 1.0, 0.4]), drag=np.array([0.0, 0.5, 1.0])
)
SINGLE = PlanarQuadrotor(integrator="euler")


def points(system, rng, shape=(5, 4)):
    lead = (*system.robots, *shape)
    return rng.standard_normal((*lead, system.state_dim)), rng.standard_normal((*lead, system.input_dim))


@pytest.mark.parametrize("system", [QUADROTORS, SINGLE], ids=["three robots", "euler"])
def test_the_jacobian_agrees_with_differences(system, rng):
    x, u = points(system, rng)
    robots = system.robots[0] if system.robots else None
    differences = Simulated(system.step, system.state_dim, system.input_dim, robots=robots)
    for found, expected in zip(system.linearise(x, u), differences.linearise(x, u), strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-8)


@pytest.mark.parametrize("system", [QUADROTORS, SINGLE], ids=["three robots", "euler"])
def test_the_linearisation_passes_through_its_point(system, rng):
    x, u = points(system, rng)
    A, B, c = system.linearise(x, u)
    along = (A @ x[..., None] + B @ u[..., None])[..., 0] + c
    np.testing.assert_allclose(along, system.step(x, u), atol=1e-13)


def test_torch_functions_are_differentiated(rng):
    def rate(x, u):
        a, c = torch.tensor([[0.5], [1.5]]), 0.3
        thrust = GRAVITY + a * u[..., 0]
        accelerations = [-thrust * torch.sin(x[..., 2]) - c * x[..., 3], thrust * torch.cos(x[..., 2]) - GRAVITY]
        accelerations[1] = accelerations[1] - c * x[..., 4]
        return torch.stack([x[..., 3], x[..., 4], x[..., 5], *accelerations, 0.7 * u[..., 1]], -1)

    found = Nonlinear(rate, 6, 2, integrator="rk4", time_step=0.05, robots=2)
    expected = PlanarQuadrotor(thrust_gain=np.array([0.5, 1.5]), torque_gain=np.full(2, 0.7), drag=np.full(2, 0.3))
    x, u = points(expected, rng, (4,))
    np.testing.assert_allclose(found.step(x, u), expected.step(x, u), atol=1e-14)
    for one, other in zip(found.linearise(x, u), expected.linearise(x, u), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def test_a_given_jacobian_is_used(rng):
    A, B = rng.standard_normal((3, 3)), rng.standard_normal((3, 2))
    system = Nonlinear(lambda x, u: x @ A.T + u @ B.T, 3, 2, jacobian=lambda x, u: (A, B))
    found = system.linearise(*points(system, rng))
    np.testing.assert_array_equal(found[0], A)
    np.testing.assert_allclose(found[2], 0, atol=1e-14)


def test_a_step_is_of_fourth_order():
    """A tenth of the time step leaves a ten-thousandth of the error."""
    x, u = np.array([0.0, 0.0, 0.3, 1.0, -1.0, 0.5]), np.array([2.0, 1.0])
    fine = PlanarQuadrotor(drag=0.5, time_step=0.05 / 200)
    truth = fine.simulate(x, np.tile(u, (200, 1)))[-1]
    coarse = [PlanarQuadrotor(drag=0.5, time_step=0.05 / k).simulate(x, np.tile(u, (k, 1)))[-1] for k in (1, 2)]
    errors = [np.abs(state - truth).max() for state in coarse]
    assert 12 < errors[0] / errors[1] < 20


def test_hover_is_an_equilibrium_of_every_robot():
    x = np.zeros((3, 6))
    x[:, :2] = [1.0, -2.0]
    np.testing.assert_array_equal(QUADROTORS.step(x, np.zeros((3, 2))), x)


def test_what_cannot_be_is_refused():
    with pytest.raises(ShapeError, match=r"maps states \(3, 2\) and inputs \(3, 1\) to \(3,\); expected \(3, 2\)"):
        Simulated(lambda x, u: x[..., 0], 2, 1)
    with pytest.raises(ConfigError, match=r"torch cannot differentiate the function \(.*use Simulated"):
        Nonlinear(lambda x, u: np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1), 2, 1)
    with pytest.raises(ConfigError, match="integrator rk4 needs a time_step"):
        Nonlinear(lambda x, u: x, 2, 1, integrator="rk4")
    with pytest.raises(ConfigError, match="continuous dynamics need a time_step"):
        PlanarQuadrotor(time_step=None)
    with pytest.raises(ConfigError, match="difference is 0"):
        Simulated(lambda x, u: x, 2, 1, difference=0.0)


@pytest.mark.parametrize("system", [QUADROTORS, SINGLE], ids=["robots", "single"])
@pytest.mark.parametrize("plans", [(), (4,), (4, 5)])
def test_steps_in_machine_code_are_those_of_the_integrator(system, plans, rng):
    x, u = (rng.standard_normal((*system.robots, *plans, size)) for size in (6, 2))
    np.testing.assert_allclose(system.step(x, u), Continuous.step(system, x, u), rtol=1e-13, atol=1e-13)
    for found, expected in zip(system.linearise(x, u), Continuous.linearise(system, x, u), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)

"""How wrong a network is, measured: what is taken off is process noise, and nothing else."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dadiff.behaviours import Known, disturbances
from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.measured import DEMONSTRATIONS, Measured, asked, measured, unexplained
from dadiff.diffusion.schedule import cosine
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems import DampedIntegrators, double_integrator
from dadiff.tasks import LQR, Fleet
from dadiff.trajectory.coordinates import physical

SYSTEM, HORIZON = double_integrator(axes=1, process_noise=0.05), 4
TASK, LAYOUT = LQR(horizon=HORIZON, state_cost=1.0), SYSTEM.layout(HORIZON)
SHOWN = TASK.demonstrations(SYSTEM, 20_000, np.random.default_rng(0))
LAW, SCHEDULE, STEPS = TASK.law(SYSTEM), cosine(40), [40, 20, 1]
BIAS = 0.01 * np.random.default_rng(1).standard_normal((LAYOUT.size, 8))


def estimate() -> Estimate:
    return Estimate.of_demonstrations(LAYOUT, physical(LAYOUT), SHOWN.trajectories, SHOWN.environment)


def of(denoise, noise: np.ndarray | None = None) -> Measured:
    return measured(estimate(), denoise, SCHEDULE, STEPS, SHOWN.trajectories, SHOWN.environment, noise)


def biased(tau, i, E):
    """A network that never looks at tau_i, and is wrong in a way that depends on E."""
    wrong = torch.sin(37 * E @ torch.linspace(-1, 1, 8 * E.shape[-1], dtype=E.dtype).reshape(-1, 8))
    return torch.as_tensor(LAW.mean(E.numpy())) + wrong @ torch.as_tensor(BIAS.T)


def process_noise(layout, tau: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    x, u = layout.split(tau)
    following = x[..., :-1, :] @ A.swapaxes(-1, -2) + u @ B.swapaxes(-1, -2)
    return (x[..., 1:, :] - following).reshape(len(tau), -1)


def test_a_right_denoiser_is_wrong_by_what_the_law_leaves_open():
    found = of(ExactDenoiser(LAW, physical(LAYOUT), SCHEDULE))
    for i in STEPS:
        expected = Estimate(LAW.covariance, np.ones(LAYOUT.size), np.ones(LAYOUT.size)).at(float(SCHEDULE.alpha_bar[i]))
        np.testing.assert_allclose(found.at_step(i).matrix, expected.matrix, atol=0.05 * expected.matrix.max())


def test_process_noise_is_no_error_of_a_plan():
    w = disturbances(LAYOUT, SHOWN.trajectories, family=False)
    wrong = biased(None, 1, torch.as_tensor(SHOWN.environment)).numpy() - LAW.mean(SHOWN.environment)
    expected = wrong.T @ wrong / len(wrong)
    found = of(biased, w).at_step(1).matrix
    np.testing.assert_allclose(found, expected, atol=0.05 * expected.max())
    assert np.trace(of(biased).at_step(1).matrix) > 5 * np.trace(found)  # with process noise taken for an error


def test_the_noise_of_one_robot_is_found_in_its_demonstrations():
    true = process_noise(LAYOUT, SHOWN.trajectories, SYSTEM.A, SYSTEM.B)
    found = disturbances(LAYOUT, SHOWN.trajectories, family=False)
    assert np.abs(found - true).max() < 0.05 * 0.05


def test_the_noise_of_each_robot_of_a_family_is_found_in_its_demonstrations():
    task, family = Fleet(horizon=30, robots=100, interpolation=2, extrapolation=0), DampedIntegrators()
    shown = task.demonstrations(family, 1, np.random.default_rng(0))
    layout = task.target(family).layout(30)
    states, _ = layout.split(shown.trajectories)
    found = disturbances(layout, shown.trajectories, family=True)
    assert 0.8 * family.process_noise < found.std() < family.process_noise
    assert found.std() < 0.2 * np.diff(states, axis=1).std()


def test_steps_between_take_the_nearest_and_the_floor_is_that_of_the_noisiest():
    found = of(biased)
    assert found.at_step(1) is found.at_step(9)  # of 40, 20 and 1
    more = found.at_step(1, floor=0.5).matrix - found.at_step(1).matrix
    np.testing.assert_allclose(more, 0.5 * found.errors["40"], atol=1e-12)
    few = found.at_step(1, floor=0.5, directions=2)
    np.testing.assert_allclose(np.diag(few.matrix), np.diag(found.at_step(1, floor=0.5).matrix), atol=1e-12)


def test_the_metric_is_that_of_the_errors():
    found = of(biased)

    def at(made: Estimate) -> SimpleNamespace:
        return SimpleNamespace(known_estimate=lambda: made, schedule=SCHEDULE, step=SimpleNamespace(i=20))

    assert Conditional("measured").covariance(at(found)) is found.at_step(20, 0.01, 0.5)
    assert Conditional("measured").measures
    assert not Conditional().measures
    with pytest.raises(NotApplicableError, match="none were measured"):
        Conditional("measured").covariance(at(estimate()))


def test_known_errors_are_undone_by_known_dynamics():
    """The error's covariance and the set together tell the plan: where the errors span fewer directions than G rows."""
    set_ = Known().fit(LAYOUT, SYSTEM).bind()
    found = of(biased, disturbances(LAYOUT, SHOWN.trajectories, family=False))
    E = torch.as_tensor(SHOWN.environment[:50])
    mean, hat = LAW.mean(E.numpy()), biased(None, 1, E).numpy()
    off = {C: np.square(set_(hat, C) - mean).mean() for C in (None, found.at_step(1))}
    assert off[found.at_step(1)] < 0.05 * off[None]


def test_demonstrations_are_asked_about_evenly_and_must_be_many():
    assert len(range(10_000)[asked(10_000, 184)]) == DEMONSTRATIONS
    assert asked(1000, 184) == slice(None, None, 1)
    with pytest.raises(ConfigError, match="takes at least 368 demonstrations of d = 184 numbers, and there are 300"):
        asked(300, 184)
    np.testing.assert_allclose(unexplained(np.ones((4, 2)), np.zeros((4, 0))), 1)


def test_of_what_was_measured_all_directions_are_kept_or_as_many_as_are_asked_for():
    C = np.diag(np.arange(1.0, LAYOUT.size + 1))
    one = Measured(C, np.ones(LAYOUT.size), np.ones(LAYOUT.size), layout=LAYOUT, errors={"1": C})
    np.testing.assert_allclose(one.at_step(1).matrix, C, atol=1e-12)
    few = one.at_step(1, directions=2)
    assert few.factor.shape == (LAYOUT.size, 2)
    np.testing.assert_allclose(np.diag(few.matrix), np.diag(C))

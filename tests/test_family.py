"""A family as prior knowledge: what demonstrations of many robots say of one that is hardly recorded."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dadiff.behaviours import IdentifiedFamily, Transitions, compared, family, least_squares
from dadiff.behaviours.family import Belief, Channels, Moments, posterior, prior
from dadiff.behaviours.sets import Dynamics
from dadiff.behaviours.stages import Stages, stages_of
from dadiff.errors import ConfigError
from dadiff.systems import DampedIntegrators, GaussianExcitation, Recording
from dadiff.tasks import Fleet

FAMILY = DampedIntegrators()
TASK = Fleet(horizon=12, robots=150, interpolation=6, extrapolation=2)
ROBOTS = TASK.target(FAMILY)
LAYOUT = ROBOTS.layout(12)


@cache
def shown() -> np.ndarray:
    return TASK.demonstrations(FAMILY, 4, np.random.default_rng(0)).trajectories


@cache
def usual() -> Belief:
    return prior(LAYOUT, shown())


def parameters(robots) -> np.ndarray:
    """theta = [A B]' of each robot, row by row."""
    return np.concatenate([robots.A, robots.B], axis=-1).swapaxes(-1, -2).reshape(len(robots.A), -1)


def recording(length: int, noise: float = 0.05, seed: int = 0) -> Recording:
    return GaussianExcitation(length=length, process_noise=noise, seed=seed).record(ROBOTS)


@pytest.mark.parametrize("centred", [True, False])
def test_channels_are_of_size_1_about_their_mean_or_about_0(centred):
    tau = shown() + 3.0
    channels = Channels.of(LAYOUT, tau, centred=centred)
    for values, centre in zip(
        LAYOUT.split(channels.scaled_trajectories(LAYOUT, tau)), (channels.centre_x, channels.centre_u), strict=True
    ):
        np.testing.assert_allclose(np.square(values).mean(axis=(0, 1)), 1, rtol=1e-12)
        if centred:
            np.testing.assert_allclose(values.mean(axis=(0, 1)), 0, atol=1e-12)
        else:
            np.testing.assert_array_equal(centre, 0)


def test_dynamics_in_channels_are_the_same_in_physical_units(rng):
    n, m = LAYOUT.state_dim, LAYOUT.input_dim
    channels = Channels.of(LAYOUT, shown() + 3.0, centred=True)
    within = Stages.constant(*(rng.standard_normal((n, k)) for k in (n, m)), rng.standard_normal(n), LAYOUT.horizon)
    c, x, u = rng.standard_normal(n), rng.standard_normal((5, n)), rng.standard_normal((5, m))
    following = x @ within.A[0].T + u @ within.B[0].T + within.c[0]
    found = channels.physical(within, c)
    x, u = x * channels.size_x + channels.centre_x, u * channels.size_u + channels.centre_u
    expected = following * channels.size_x + channels.centre_x + c
    np.testing.assert_allclose(x @ found.A[0].T + u @ found.B[0].T + found.c[0], expected, atol=1e-10)


def test_the_family_is_found_in_its_demonstrations():
    many = parameters(FAMILY.inside(4000, np.random.default_rng(1)))
    deviation, varies = np.sqrt(np.diag(usual().covariance)), many.std(axis=0) > 1e-9
    np.testing.assert_allclose(usual().mean, many.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(deviation[varies], many.std(axis=0)[varies], rtol=0.2)
    assert deviation[~varies].max() < 0.1 * deviation[varies].min()
    np.testing.assert_allclose(np.sqrt(usual().noise), FAMILY.process_noise, rtol=0.05)


@pytest.mark.parametrize("constant", [False, True])
def test_the_search_for_it_begins_at_the_dynamics_that_fit_all_robots_best(constant, monkeypatch):
    monkeypatch.setattr(family, "ITERATIONS", 0)
    begun, (x, u) = prior(LAYOUT, shown() + 1.0, constant=constant), LAYOUT.split(shown() + 1.0)
    phi = np.concatenate([x[:, :-1], u, np.ones((*u.shape[:-1], int(constant)))], axis=-1)
    found, left, *_ = np.linalg.lstsq(phi.reshape(-1, phi.shape[-1]), x[:, 1:].reshape(-1, x.shape[-1]))
    np.testing.assert_allclose(begun.mean, found.ravel(), atol=1e-9)
    np.testing.assert_allclose(begun.noise, left / (phi.shape[0] * phi.shape[1] - phi.shape[-1]), rtol=0.01)


@pytest.mark.parametrize(("length", "better"), [(100, 3), (30, 5)])
def test_a_robot_is_known_much_better_than_by_its_recording_alone(length, better):
    data = Transitions.of(recording(length).states, recording(length).inputs)
    alone = least_squares(data)
    found = posterior(usual(), Moments.of(data))
    true, inside = parameters(ROBOTS), slice(0, 6)
    by_recording = np.concatenate([alone.A, alone.B], axis=-1).swapaxes(-1, -2).reshape(len(true), -1)
    errors = [np.linalg.norm(estimate - true, axis=-1) for estimate in (by_recording, found.mean)]
    assert errors[0][inside].mean() > better * errors[1][inside].mean()
    assert errors[0].mean() > better * errors[1].mean(), "outside of the ranges, too"
    np.testing.assert_allclose(np.sqrt(found.noise).mean(), 0.05, rtol=0.15)


def test_without_data_the_family_is_believed_and_with_much_the_data_are():
    nothing = Moments(np.zeros((6, 6)), np.zeros((6, 4)), np.zeros(4), 1)
    believed = usual().given(nothing, usual().noise)
    np.testing.assert_allclose(believed.mean, usual().mean, atol=1e-9)
    np.testing.assert_allclose(believed.covariance, usual().covariance, atol=1e-9)
    far = Belief(usual().mean + 1.0, usual().covariance + np.eye(24), usual().noise)
    found = posterior(far, Moments.of(Transitions.of(recording(5000, 0.01).states, recording(5000, 0.01).inputs)))
    np.testing.assert_allclose(found.mean, parameters(ROBOTS), atol=0.01)


def test_the_true_parameters_lie_as_far_off_as_is_stated():
    """Over robots of the family, the squared distance in the posterior covariance is the number of parameters."""
    robots = FAMILY.inside(60, np.random.default_rng(3))
    made = GaussianExcitation(length=60, process_noise=0.05).record(robots)
    found = posterior(usual(), Moments.of(Transitions.of(made.states, made.inputs)))
    off = parameters(robots) - found.mean
    varies = np.flatnonzero(parameters(robots).std(axis=0) > 1e-9)
    part = found.covariance[:, varies][:, :, varies]
    distance = (off[:, varies] * np.linalg.solve(part, off[:, varies, None])[..., 0]).sum(-1)
    assert 0.5 < np.mean(distance) / len(varies) < 1.5


def test_a_fleet_is_its_robots_one_by_one_and_the_set_is_near_the_truth():
    rec = recording(30)
    together = IdentifiedFamily().fit(LAYOUT, ROBOTS, rec, shown())
    one = IdentifiedFamily().fit(LAYOUT, None, Recording(rec.states[2], rec.inputs[2]), shown())
    np.testing.assert_allclose(together.stages.A[2], one.stages.A, atol=1e-9)
    np.testing.assert_allclose(
        together.spread[2] @ together.spread[2].T, one.spread @ one.spread.T, atol=1e-9 * np.square(one.spread).max()
    )
    variances = np.einsum("rik,rik->ri", together.spread, together.spread)
    assert together.notes["residual_deviation"] == pytest.approx(np.sqrt(variances.mean()))
    truth = Dynamics(LAYOUT, stages_of(ROBOTS, 12))
    data = Transitions.of(rec.states, rec.inputs)
    alone = Dynamics(LAYOUT, least_squares(data).stages(12))
    assert compared(alone, truth)["projector_distance"] > 3 * compared(together, truth)["projector_distance"]


def test_a_recording_of_a_few_steps_is_of_use():
    few, truth = recording(3), Dynamics(LAYOUT, stages_of(ROBOTS, 12))
    learned = IdentifiedFamily().fit(LAYOUT, ROBOTS, few, shown())
    none = Dynamics(LAYOUT, usual().stages(LAYOUT))
    assert compared(learned, truth)["projector_distance"] < compared(none, truth)["projector_distance"]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_it_needs_both_and_says_so(noise):
    assert np.isfinite(IdentifiedFamily().fit(LAYOUT, ROBOTS, recording(60, noise), shown()).spread).all()
    with pytest.raises(ConfigError, match="needs a recording"):
        IdentifiedFamily().fit(LAYOUT, demonstrations=shown())
    with pytest.raises(ConfigError, match="needs a dataset"):
        IdentifiedFamily().fit(LAYOUT, recording=recording(60))
    with pytest.raises(ConfigError, match="inflation is 0"):
        IdentifiedFamily(inflation=0.0)
    with pytest.raises(ConfigError, match="the demonstrations of many robots"):
        prior(LAYOUT, shown()[:1])

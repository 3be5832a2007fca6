"""Dynamics that are linear in features: derivatives, estimates from recordings, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from laws import exciting, fleet, trajectories

from dadiff.behaviours import (
    Dynamics,
    Hankel,
    HankelLowRank,
    Identified,
    IdentifiedSoft,
    IdentifiedSparse,
    Known,
    Koopman,
    Lifted,
    Manifold,
    Pin,
    pins,
    prediction_error,
)
from dadiff.behaviours.least_squares import regression
from dadiff.errors import ConfigError, ExcitationError, ShapeError
from dadiff.systems import GaussianExcitation, PlanarQuadrotors, Recording, Simulated, double_integrator
from dadiff.systems.features import Features, Regressed
from dadiff.trajectory.covariance import Covariance

TERMS = [
    ("constant", "identity"),
    ("identity", "products"),
    ("constant", "identity", "trigonometric", "control_affine"),
    ("constant", "identity", "trigonometric", "products", "control_affine"),
    ("trigonometric", "control_affine"),
    ("identity", "control_affine"),
    ("identity", "trigonometric", "turning", "control_affine"),
]


def features(terms):
    return Features(3, 2, terms, (1,) if "trigonometric" in terms else ())


@pytest.mark.parametrize("terms", TERMS, ids=",".join)
@pytest.mark.parametrize("robots", [None, 4])
def test_derivatives_agree_with_differences(terms, robots, rng):
    phi = features(terms)
    lead = () if robots is None else (robots,)
    system = Regressed(phi, 0.1 * rng.standard_normal((*lead, 3, phi.count)))
    x, u = rng.standard_normal((*lead, 5, 3)), rng.standard_normal((*lead, 5, 2))
    differences = Simulated(system.step, 3, 2, robots=robots)
    for found, expected in zip(system.linearise(x, u), differences.linearise(x, u), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize("terms", TERMS, ids=",".join)
@pytest.mark.parametrize(("ridge", "error"), [(0.0, 1e-6), (1e-10, 0.1)])
def test_dynamics_in_the_span_of_the_features_are_found(terms, ridge, error, rng):
    """With a ridge, features that are nearly dependent where the recording went are told apart less well."""
    phi = features(terms)
    truth = Regressed(phi, 0.02 * rng.standard_normal((2, 3, phi.count)) * (np.arange(phi.count) < 20))
    recording = GaussianExcitation(20, count=40, process_noise=0.0).record(truth)
    layout = truth.layout(6)
    projector = Identified(features=terms, angles=phi.angles, ridge=ridge)
    found = projector.fit(layout, truth, recording)
    inputs = rng.standard_normal((2, 4, 6, 2))
    tau = layout.flatten(truth.simulate(rng.standard_normal((2, 4, 3)), inputs), inputs)
    assert isinstance(found, Manifold)
    assert prediction_error(found, truth, tau)["prediction_error"] < error


def test_a_quadrotor_is_predicted_far_better_with_features_than_linearly(rng):
    robots = PlanarQuadrotors().inside(3, rng)
    recording = GaussianExcitation(300, input_std=3.0).record(robots)
    layout = robots.layout(20)
    inputs = rng.standard_normal((3, 8, 20, 2))
    tau = layout.flatten(robots.simulate(np.zeros((3, 8, 6)), inputs), inputs)
    terms = ("constant", "identity", "trigonometric", "control_affine")
    good = Identified("fixed", features=terms, angles=(2,), ridge=0.01).fit(layout, robots, recording)
    linear = Identified("fixed").fit(layout, robots, recording)
    assert isinstance(linear, Dynamics)
    errors = [prediction_error(found, robots, tau)["prediction_error"] for found in (good, linear)]
    assert errors[0] < 0.5 * errors[1]
    x_init = rng.standard_normal((3, 8, 6))
    project = good.bind(None, pins(Identified("fixed"), layout, x_init))
    assert np.isfinite(project(tau)).all()


TURNING = ("constant", "identity", "trigonometric", "turning", "control_affine")


def test_few_features_are_kept_and_they_predict_far_better(rng):
    """Noise puts a little of every feature into an estimate; what is left out after is exactly 0."""
    phi = Features(6, 2, TURNING, (2,))
    robots = PlanarQuadrotors().inside(3, rng)
    recording = GaussianExcitation(300, input_std=2.0, process_noise=0.01).record(robots)
    layout = robots.layout(40)
    inputs = rng.standard_normal((3, 8, 40, 2))
    tau = layout.flatten(robots.simulate(np.zeros((3, 8, 6)), inputs), inputs)
    sparse = IdentifiedSparse("fixed", features=TURNING, angles=(2,)).fit(layout, robots, recording)
    dense = Identified("fixed", features=TURNING, angles=(2,)).fit(layout, robots, recording)
    errors = [prediction_error(found, robots, tau)["prediction_error"] for found in (sparse, dense)]
    assert errors[0] < 0.3 * errors[1]
    assert 12 <= sparse.notes["terms"] <= 25 < 6 * phi.count


def test_dynamics_of_few_features_are_found_with_their_zeros(rng):
    phi = Features(3, 2, ("constant", "identity"))
    theta = np.zeros((2, 3, phi.count))
    theta[:, 0, 1], theta[:, 1, 4], theta[:, 2, 2] = 0.1, 0.5, -0.2
    truth = Regressed(phi, theta)
    recording = GaussianExcitation(200, process_noise=0.01).record(truth)
    found = IdentifiedSparse(features=phi.terms).fit(truth.layout(5), truth, recording)
    np.testing.assert_array_equal(found.system.theta != 0, theta != 0)
    np.testing.assert_allclose(found.system.theta, theta, atol=0.1)


def test_the_truth_predicts_itself(rng):
    system = double_integrator()
    layout = system.layout(5)
    assert prediction_error(Known().fit(layout, system), system, rng.standard_normal((4, layout.size))) == {
        "prediction_error": pytest.approx(0.0, abs=1e-12)
    }


@pytest.mark.parametrize("offset", ["none", "estimated"])
def test_windows_predict_as_the_dynamics_that_they_identify(offset):
    """The only trajectory of their span that has this start and these inputs."""
    robots = fleet(process_noise=0.0)
    (tau, _), layout, recording = trajectories(robots, 6, 5), robots.layout(6), exciting(120).record(robots)
    windows = HankelLowRank(offset=offset).fit(layout, robots, recording)
    assert prediction_error(windows, robots, tau)["prediction_error"] < 1e-9
    assert prediction_error(Hankel().fit(layout, robots, exciting(30, 0.1).record(robots)), robots, tau) == {}


def test_what_makes_no_sense_is_refused(rng):
    system = double_integrator()
    recording, layout = GaussianExcitation(10).record(system), system.layout(5)
    for make, message in [
        (lambda: Features(3, 2, ("trigonometric",)), "trigonometric terms need"),
        (lambda: Features(3, 2, ("identity",), (1,)), "and only they do"),
        (lambda: Features(3, 2, ("turning",)), "name trigonometric and the angles, too"),
        (lambda: IdentifiedSparse(), "need some features, no ridge"),
        (lambda: Features(3, 2, ("trigonometric",), (3,)), "the states are 0 to 2"),
        (lambda: Identified(ridge=1.0), "angles and ridge are of features"),
        (lambda: Identified(ridge=-1.0), "ridge is -1"),
        (lambda: Identified(features=("identity",), offset="known"), "the offset is one of them"),
    ]:
        with pytest.raises(ConfigError, match=message):
            make()
    with pytest.raises(ShapeError, match="theta has shape"):
        Regressed(Features(3, 2), np.zeros((3, 7)))
    with pytest.raises(ExcitationError, match="10 transitions span 10 of the 17 features"):
        Identified(features=("constant", "identity", "products")).fit(layout, system, recording)
    with pytest.raises(ConfigError, match=r"use projector\.residual=each"):
        IdentifiedSoft(features=("identity",), residual="averaged")


@pytest.mark.parametrize("directions", [0, 4])
def test_koopman_of_linear_dynamics_is_the_affine_projection(directions, rng):
    system = double_integrator(process_noise=0.0)
    recording, layout = GaussianExcitation(100).record(system), system.layout(6)
    metric = Covariance(rng.uniform(0.5, 2, layout.size), rng.standard_normal((layout.size, directions)))
    pin, tau = Pin.initial_state(layout, rng.standard_normal((5, 4))), rng.standard_normal((5, layout.size))
    found = Koopman().fit(layout, system, recording)
    expected = Known().fit(layout, system)
    for C in (None, metric):
        np.testing.assert_allclose(found.bind(None, [pin])(tau, C), expected.bind(None, [pin])(tau, C), atol=1e-8)


def test_koopman_finds_what_closes_on_its_observables(rng):
    """x1+ = a x1 + u, x2+ = b x2 + c x1^2: with x1^2 observed it is linear where no input acts on x1^2."""
    truth = Simulated(lambda x, u: np.stack([0.9 * x[..., 0], 0.5 * x[..., 1] + x[..., 0] ** 2 + u[..., 0]], -1), 2, 1)
    states = truth.simulate(rng.standard_normal((30, 2)), inputs := rng.standard_normal((30, 5, 1)))
    layout = truth.layout(5)
    found = Koopman(features=("products",), ridge=1e-12).fit(layout, truth, Recording(states[:, :], inputs))
    assert isinstance(found, Lifted)
    tau = layout.flatten(states, inputs)
    assert prediction_error(found, truth, tau)["prediction_error"] < 1e-3
    linear = Koopman().fit(layout, truth, Recording(states, inputs))
    assert prediction_error(linear, truth, tau)["prediction_error"] > 0.1
    project = found.bind(None, [Pin.initial_state(layout, states[:, 0])])
    np.testing.assert_allclose(project(tau), tau, atol=1e-2)


@pytest.mark.parametrize("ridge", [0.0, 0.5, 20.0])
def test_a_ridge_weighs_what_is_found_against_the_deviations_of_the_features(ridge, rng):
    """The normal equations, solved; the residual's variance takes one degree of freedom off for each feature."""
    Phi, target = rng.standard_normal((2, 30, 4)) * [1, 2, 3, 0.1], rng.standard_normal((2, 30, 3))
    theta, root, noise = regression(Phi, target, ridge)
    for k in range(2):
        inverse = np.linalg.inv(Phi[k].T @ Phi[k] + ridge * np.diag(Phi[k].var(axis=0)))
        np.testing.assert_allclose(theta[k].T, inverse @ Phi[k].T @ target[k], atol=1e-10)
        np.testing.assert_allclose(root[k] @ root[k].T, inverse, atol=1e-12 * inverse.max())
        left = target[k] - Phi[k] @ theta[k].T
        np.testing.assert_allclose(noise[k], np.square(left).sum(axis=0) / 26)


def test_koopman_lifts_at_x0_and_sees_states_alone():
    layout = double_integrator().layout(5)
    with pytest.raises(ConfigError, match=r"pin x\(0\), and nothing else"):
        Koopman().fit(layout, None, GaussianExcitation(50).record(double_integrator())).bind()
    with pytest.raises(ConfigError, match="observables are of states alone"):
        Koopman(features=("control_affine",))

"""The conditional projection is Bayes' rule: with a Gaussian law's exact denoiser, plans follow the conditional law.

A chain whose enforcement is affine is an affine map of its noise, so that its law is read off without sampling: plans
that are given one unit of one draw each are the columns of that map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from laws import double_integrator

from dadiff.behaviours import Dynamics, Pin, Stages, Uncertain
from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion import chain
from dadiff.diffusion.chain import sample
from dadiff.diffusion.conditional import Conditional, bridge
from dadiff.diffusion.context import Context, Counted
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.samplers import DDIM, DDPM
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.tasks import LQR
from dadiff.trajectory import TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance

LAYOUT, SCHEDULE = TrajectoryLayout(2, 1, 3), paper_linear(200, 1 / 200)
SIZE = LAYOUT.size
EXACT = {"floor": 0.0, "shrinkage": 0.0}


@dataclass
class Gaussian:
    """tau | E ~ N(mean_map E + offset, noise_map noise_map')."""

    mean_map: np.ndarray
    offset: np.ndarray
    noise_map: np.ndarray


def law(robots: tuple[int, ...] = ()) -> Gaussian:
    rng = np.random.default_rng(1)
    return Gaussian(*(rng.standard_normal((*robots, SIZE, *more)) for more in ((2,), (), (SIZE,))))


WHERE = Coordinates(np.linspace(-1, 1, SIZE), np.linspace(0.5, 2, SIZE))


def estimate(prior: Gaussian, where: Coordinates = WHERE) -> Estimate:
    noise = prior.noise_map / where.scale[:, None]
    return Estimate(noise @ noise.swapaxes(-1, -2), np.ones(SIZE), 1 / where.scale)


def stages(robots: tuple[int, ...] = ()) -> Stages:
    rng = np.random.default_rng(2)
    return Stages(*(0.5 * rng.standard_normal((*robots, 3, *shape)) for shape in ((2, 2), (2, 1), (2,))))


def law_of_the_chain(enforcement, project, sampler, denoiser, E: np.ndarray, weighed: Estimate, monkeypatch):
    """(mean (d,), covariance (d, d)) of a plan, exactly: noise comes one unit at a time."""
    draws = 1 + 5 * len(sampler.steps(SCHEDULE))
    plans, drawn = draws * SIZE + 1, []

    def one_unit_each(shape, **_):
        eps = torch.zeros(shape, dtype=torch.float64)
        first = len(drawn) * SIZE
        eps[first : first + SIZE] = torch.eye(SIZE, dtype=torch.float64)
        drawn.append(first)
        return eps

    monkeypatch.setattr(chain.torch, "randn", one_unit_each)
    environment = torch.from_numpy(np.tile(E, (plans, 1)))
    tau = sample(
        sampler, SCHEDULE, denoiser, environment, (plans, SIZE), torch.Generator(), project, enforcement,
        estimate=weighed,
    ).tau.numpy()  # fmt: skip
    assert len(drawn) <= draws
    columns = tau[:-1] - tau[-1]
    return tau[-1], columns.T @ columns


def conditional_law(prior: Gaussian, E: np.ndarray, G: np.ndarray, g: np.ndarray, R: np.ndarray):
    """Of tau given G tau = g + r, r ~ N(0, R), in physical units."""
    Sigma, mean = prior.noise_map @ prior.noise_map.T, prior.mean_map @ E + prior.offset
    K = Sigma @ G.T @ np.linalg.inv(G @ Sigma @ G.T + R)
    return mean - K @ (G @ mean - g), Sigma - K @ G @ Sigma


def constraint(kind: str):
    """(set, pins, G, g, R)."""
    rng, rows = np.random.default_rng(3), stages()
    G, g = rows.matrix(LAYOUT)
    R, held, dynamics = np.zeros((len(G), len(G))), (), Dynamics(LAYOUT, rows)
    if kind == "uncertain":
        V = 0.5 * rng.standard_normal((len(G), 4))
        R, dynamics = V @ V.T, Uncertain(LAYOUT, rows, V)
    if kind != "dynamics":
        x_init = rng.standard_normal((1, 2))
        held, G, g = (Pin.initial_state(LAYOUT, x_init),), np.concatenate([np.eye(SIZE)[:2], G]), np.append(x_init, g)
        R = np.pad(R, ((2, 0), (2, 0)))
    return dynamics, held, G, g, R


@pytest.mark.parametrize("kind", ["dynamics", "pinned", "uncertain"])
@pytest.mark.parametrize(
    "sampler", [DDIM(1), DDIM(4), DDPM(last_step_noise=False, skip_below=0)], ids=["1", "4", "ddpm"]
)
def test_with_spread_plans_follow_the_conditional_law_whatever_the_number_of_steps(kind, sampler, monkeypatch):
    prior, E = law(), np.array([0.3, -0.7])
    dynamics, held, G, g, R = constraint(kind)
    mean, covariance = law_of_the_chain(
        Conditional(spread=True, **EXACT), dynamics.bind(WHERE, held), sampler,
        ExactDenoiser(prior, WHERE, SCHEDULE), E, estimate(prior), monkeypatch,
    )  # fmt: skip
    true_mean, true_covariance = conditional_law(prior, E, G, g, R)
    np.testing.assert_allclose(WHERE.to_physical(mean), true_mean, atol=1e-9)
    np.testing.assert_allclose(WHERE.scale[:, None] * covariance * WHERE.scale, true_covariance, atol=1e-8)


@pytest.mark.parametrize("kind", ["dynamics", "pinned", "uncertain"])
def test_without_spread_the_mean_is_exact_and_the_covariance_is_so_to_the_discretisation(kind, monkeypatch):
    prior, E = law(), np.array([0.3, -0.7])
    dynamics, held, G, g, R = constraint(kind)
    mean, covariance = law_of_the_chain(
        Conditional(**EXACT), dynamics.bind(WHERE, held),
        DDPM(last_step_noise=False, variance="posterior", skip_below=0),
        ExactDenoiser(prior, WHERE, SCHEDULE), E, estimate(prior), monkeypatch,
    )  # fmt: skip
    true_mean, true_covariance = conditional_law(prior, E, G, g, R)
    np.testing.assert_allclose(WHERE.to_physical(mean), true_mean, atol=1e-9)
    error = np.abs(WHERE.scale[:, None] * covariance * WHERE.scale - true_covariance).max()
    assert error < 0.15 * np.abs(true_covariance).max()  # of first order in a step, and there are 200


@pytest.mark.parametrize("i", [1, 60, 199, 200])
def test_the_corrected_estimate_is_that_of_the_conditional_law(i):
    """E[tau_0 | tau_i, G tau = g] by joint Gaussian algebra."""
    prior, E = law(), np.array([0.3, -0.7])
    dynamics, held, G, g, _ = constraint("pinned")
    a = float(SCHEDULE.alpha_bar[i])
    tau = np.random.default_rng(4).standard_normal((1, SIZE))
    tau0_hat = ExactDenoiser(prior, WHERE, SCHEDULE)(torch.from_numpy(tau), i, torch.from_numpy(E[None]))
    corrected = dynamics.bind(WHERE, held)(tau0_hat, estimate(prior).at(a)).numpy()[0]
    D = np.diag(1 / WHERE.scale)
    Sigma, mean = D @ prior.noise_map @ prior.noise_map.T @ D, WHERE.to_scaled(prior.mean_map @ E + prior.offset)
    seen = np.concatenate([np.sqrt(a) * np.eye(SIZE), G @ np.linalg.inv(D)])
    noise = np.diag(np.concatenate([np.full(SIZE, 1 - a), np.zeros(len(G))]))
    innovation = np.concatenate([tau[0], g - G @ WHERE.mean]) - seen @ mean
    expected = mean + Sigma @ seen.T @ np.linalg.solve(seen @ Sigma @ seen.T + noise, innovation)
    np.testing.assert_allclose(corrected, expected, atol=1e-7)


def test_a_fleet_is_its_robots_one_by_one():
    prior, robots, plans = law((3,)), (3,), 4
    tau, E = torch.randn(3, plans, SIZE, dtype=torch.float64), torch.zeros(3, plans, 2, dtype=torch.float64)
    denoise, P = ExactDenoiser(prior, WHERE, SCHEDULE), Dynamics(LAYOUT, stages(robots)).bind(WHERE)
    together = P(denoise(tau, 50, E), estimate(prior).at(0.3))
    for k in range(3):
        one = Gaussian(prior.mean_map[k], prior.offset[k], prior.noise_map[k])
        alone = Dynamics(LAYOUT, Stages(*(getattr(stages(robots), name)[k] for name in ("A", "B", "c")))).bind(WHERE)
        tau0_hat = ExactDenoiser(one, WHERE, SCHEDULE)(tau[k], 50, E[k])
        np.testing.assert_allclose(together[k], alone(tau0_hat, estimate(one).at(0.3)), atol=1e-9)


# --- the estimate's covariance


@pytest.mark.parametrize("alpha_bar", [0.0, 1e-6, 0.5, 1 - 1e-9, 1.0])
def test_C_is_the_posterior_covariance_of_the_forward_process(alpha_bar):
    Sigma = estimate(law()).covariance
    seen = alpha_bar * Sigma + (1 - alpha_bar) * np.eye(SIZE)
    expected = Sigma - alpha_bar * Sigma @ np.linalg.solve(seen, Sigma)
    found = estimate(law()).at(alpha_bar, floor=0.2).matrix - 0.2 * Sigma
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_shrinkage_leads_from_Sigma_to_equal_variances_of_the_channels():
    made, deviation = estimate(law()), np.linspace(0.5, 3, SIZE)
    made = Estimate(made.covariance, deviation, made.unit)
    np.testing.assert_allclose(made.at(0.0).matrix, made.covariance, atol=1e-9)
    across = made.at(0.0, shrinkage=1.0).matrix / np.outer(deviation, deviation)
    np.testing.assert_allclose(across, across[0, 0] * np.eye(SIZE), atol=1e-9)
    standard = made.covariance / np.outer(deviation, deviation)
    np.testing.assert_allclose(across[0, 0], np.trace(standard) / SIZE)


def test_Sigma_of_demonstrations_is_what_regression_on_E_leaves():
    system, task = double_integrator(process_noise=0.05), LQR(horizon=6)
    shown, layout = task.demonstrations(system, 6000, np.random.default_rng(0)), system.layout(6)
    made = Estimate.of_demonstrations(layout, physical(layout), shown.trajectories, shown.environment)
    true = task.law(system).covariance
    np.testing.assert_allclose(made.covariance, true, atol=0.05 * np.abs(true).max())
    channels = layout.states(made.deviation)
    np.testing.assert_allclose(channels, np.broadcast_to(channels[0], channels.shape))


@pytest.mark.parametrize("count", [5, 9])
def test_few_demonstrations_are_counted_without_the_freedom_that_regression_takes(count):
    rng = np.random.default_rng(3)
    E, layout = rng.standard_normal((count, 3)), TrajectoryLayout(1, 1, 2)
    tau, where = rng.standard_normal((count, layout.size)), Coordinates(np.ones(layout.size), np.full(layout.size, 2.0))
    made = Estimate.of_demonstrations(layout, where, tau, E)
    design = np.column_stack([E, np.ones(count)])
    left = (tau - design @ np.linalg.lstsq(design, tau, rcond=None)[0]) / 2
    np.testing.assert_allclose(made.covariance, left.T @ left / (count - 3 - 1), atol=1e-12)
    np.testing.assert_allclose(made.physical.matrix, np.eye(layout.size) / 4)


def test_nothing_is_left_open_of_a_certain_entry_that_is_seen_without_noise():
    made = Estimate(np.diag([0.0, 1.0]), np.ones(2), np.ones(2))
    np.testing.assert_array_equal(made.diagonal(1.0).matrix, np.zeros((2, 2)))


def test_equal_questions_get_the_one_object_so_that_projections_are_made_once():
    made = estimate(law())
    assert made.at(0.3, 0.1) is made.at(0.3, 0.1)
    assert made.diagonal(0.3) is made.diagonal(0.3)
    first = made.at(0.1)
    for k in range(100):
        made.at(0.2 + k / 1000)
    assert made.at(0.1) is not first  # no more than a few are held


def test_leading_directions_project_nearly_alike():
    prior = law()
    z = np.random.default_rng(0).standard_normal((5, SIZE))
    P, made = Dynamics(LAYOUT, stages()).bind(WHERE), estimate(prior)
    whole = P(z, made.at(0.5))
    errors = [np.abs(P(z, made.at(0.5, directions=k)) - whole).max() for k in (2, 8, SIZE)]
    assert errors[-1] < 1e-9 < errors[1] < errors[0] * 2


NO_SPREAD = Estimate(np.zeros((SIZE, SIZE)), np.linspace(0.5, 3, SIZE), np.ones(SIZE))


def test_demonstrations_that_do_not_spread_leave_equal_variances_of_the_channels():
    z = np.random.default_rng(0).standard_normal((5, SIZE))
    P = Dynamics(LAYOUT, stages()).bind(WHERE)
    np.testing.assert_allclose(P(z, NO_SPREAD.at(0.3, 0.01, 0.5)), P(z, NO_SPREAD.standardised), atol=1e-9)


@pytest.mark.parametrize("ask", [lambda made: made.at(0.3), lambda made: made.diagonal(0.3)], ids=["full", "diagonal"])
def test_without_shrinkage_they_say_nothing(ask):
    with pytest.raises(ConfigError, match="demonstrations do not spread at all given E"):
        ask(NO_SPREAD)


def test_demonstrations_within_the_dynamics_are_not_moved_by_rounding():
    """Sigma lies in the set, so that G C G' is 0 but for rounding, which must not become a gain."""
    dynamics = Dynamics(LAYOUT, Stages(*(np.stack([part] * 3) for part in (np.eye(2), np.ones((2, 1)), np.zeros(2)))))
    inside = dynamics.directions(np.arange(0)) @ np.random.default_rng(0).standard_normal((SIZE - 6, SIZE))
    made = Estimate(inside @ inside.T, np.ones(SIZE), np.ones(SIZE))
    z = np.random.default_rng(1).standard_normal((5, SIZE))
    for alpha_bar in (0.0, 0.5):
        np.testing.assert_allclose(dynamics.bind()(z, Covariance.dense(made.covariance)), z, atol=1e-9)
        moved = dynamics.bind()(z, made.at(alpha_bar))
        assert np.abs(moved - z).max() < 1e-6


@pytest.mark.parametrize(("size", "kept"), [(600, 0), (601, 64)])
def test_of_long_trajectories_leading_directions_are_kept(size, kept):
    assert Conditional().kept(size) == kept
    assert Conditional(directions=5).kept(size) == 5


# --- the enforcement


def context(made: Estimate | None) -> Context:
    step, tau = DDIM(10).steps(SCHEDULE)[3], torch.zeros(2, SIZE, dtype=torch.float64)
    P = Dynamics(LAYOUT, stages()).bind(WHERE)
    return Context(step, SCHEDULE, tau, tau, P, Counted(None), lambda: tau, made)


def test_it_says_when_nothing_is_known_of_the_estimate():
    with pytest.raises(
        NotApplicableError, match="it weighs by the covariance of the clean estimate, and none is known"
    ):
        Conditional().clean(torch.zeros(2, SIZE, dtype=torch.float64), context(None))


@pytest.mark.parametrize("metric", ["standardised", "physical"])
def test_metrics_that_say_nothing_of_the_task(metric):
    made = Estimate(estimate(law()).covariance, np.linspace(1, 2, SIZE), 1 / WHERE.scale)
    tau = torch.randn(2, SIZE, dtype=torch.float64)
    found = Conditional(metric).clean(tau, context(made))
    weights = {"standardised": made.deviation**2, "physical": made.unit**2}[metric]
    np.testing.assert_allclose(found, context(made).project(tau, Covariance.diagonal_of(weights)), atol=1e-12)
    in_units = Coordinates(WHERE.mean, np.ones(SIZE))
    if metric == "physical":
        plain = Dynamics(LAYOUT, stages()).bind(in_units)
        shifted = torch.from_numpy(in_units.to_scaled(WHERE.to_physical(tau.numpy())))
        expected = WHERE.to_scaled(in_units.to_physical(plain(shifted).numpy()))
        np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("bad", [{"floor": -1.0}, {"shrinkage": 1.5}, {"directions": -1}])
def test_parameters_without_meaning_are_refused(bad):
    with pytest.raises(ConfigError, match="enforcement: floor is"):
        Conditional(**bad)


@pytest.mark.parametrize(("i", "j"), [(200, 60), (60, 3), (3, 0)])
def test_the_bridge_keeps_the_marginals_of_the_forward_process(i, j):
    step, a = bridge(DDIM(1).steps(SCHEDULE)[0].__class__(i, j, 0, 0, 0), SCHEDULE), SCHEDULE.alpha_bar
    np.testing.assert_allclose(step.clean + step.sample * np.sqrt(a[i]), np.sqrt(a[j]), atol=1e-12)
    np.testing.assert_allclose(step.sample**2 * (1 - a[i]) + step.noise**2, 1 - a[j], atol=1e-12)

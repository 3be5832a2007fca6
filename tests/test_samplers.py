"""Laws of samplers: the steps they take, and with the exact denoiser the law they sample from."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from laws import SYSTEMS, component, presets, tolerance, variants

from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.chain import Samples, sample
from dadiff.diffusion.enforcement import PostHoc
from dadiff.diffusion.samplers import DDIM, DDPM, skipped_weight
from dadiff.diffusion.schedule import Schedule, cosine, paper_linear
from dadiff.errors import ConfigError
from dadiff.randomness import torch_generator
from dadiff.systems import Linear
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

HORIZON = 4
SAMPLERS = variants(
    "sampler", {"last_step_noise": (False,), "variance": ("posterior",), "skip_below": (0.0,), "eta": (1.0,)}
)
SCHEDULES = {name: component("schedule", name) for name in presets("schedule")}

every_sampler = pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS.keys())
every_schedule = pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES.keys())


def lqr(system: Linear) -> LQR:
    return LQR(horizon=HORIZON, state_cost=(1.0,) * system.state_dim)


def exact(system: Linear, schedule: Schedule) -> ExactDenoiser:
    return ExactDenoiser(lqr(system).law(system), physical(system.layout(HORIZON)), schedule)


def one_environment(system: Linear, plans: int) -> torch.Tensor:
    return torch.linspace(-1, 1, 2 * system.state_dim, dtype=torch.float64).repeat(plans, 1)


def draw(sampler, schedule: Schedule, system: Linear, plans: int = 3, seed: int = 0, **options) -> Samples:
    environment = one_environment(system, plans)
    shape = (plans, system.layout(HORIZON).size)
    return sample(
        sampler, schedule, exact(system, schedule), environment, shape, torch_generator(seed, "test"), **options
    )


# --- steps


@every_sampler
@every_schedule
class TestSteps:
    def test_they_lead_from_L_down_to_0(self, sampler, schedule):
        steps = sampler.steps(schedule)
        assert steps[0].i == schedule.num_steps
        assert steps[-1].j == 0
        assert all(step.i > step.j for step in steps)
        assert all(a.j == b.i for a, b in pairwise(steps))

    def test_they_keep_the_signal(self, sampler, schedule):
        """Where tau_i has mean sqrt(alpha_bar_i) tau_0 and tau0_hat = tau_0, tau_j has mean sqrt(alpha_bar_j) tau_0."""
        for step in sampler.steps(schedule):
            signal = step.clean + step.sample * np.sqrt(schedule.alpha_bar[step.i])
            np.testing.assert_allclose(signal, np.sqrt(schedule.alpha_bar[step.j]), atol=tolerance(size=100))

    def test_all_weights_are_finite_and_none_negative(self, sampler, schedule):
        for step in sampler.steps(schedule):
            weights = np.array([step.clean, step.sample, step.noise])
            assert np.isfinite(weights).all()
            assert (weights >= -1e-12).all()

    def test_a_skipped_call_comes_before_every_other_and_weighs_little(self, sampler, schedule):
        steps = sampler.steps(schedule)
        calls = [step.call for step in steps]
        assert calls == sorted(calls)
        assert calls[-1]
        assert skipped_weight(steps) <= getattr(sampler, "skip_below", 0.0)


@every_schedule
def test_the_posterior_variance_keeps_the_noise_of_the_forward_process(schedule):
    """From tau_i = a tau_0 + s eps to tau_j with variance 1 - alpha_bar_j: DDPM with posterior variance, any DDIM."""
    for sampler in (DDPM(variance="posterior", skip_below=0), DDIM(50, eta=0.0), DDIM(50, eta=1.0), DDIM(7, eta=0.5)):
        for step in sampler.steps(schedule):
            variance = step.sample**2 * (1 - schedule.alpha_bar[step.i]) + step.noise**2
            np.testing.assert_allclose(variance, 1 - schedule.alpha_bar[step.j], atol=1e-12)


@every_schedule
def test_ddim_with_all_steps_and_eta_1_is_ddpm_with_posterior_variance(schedule):
    ddim = DDIM(schedule.num_steps, eta=1.0).steps(schedule)
    ddpm = DDPM(variance="posterior", skip_below=0).steps(schedule)
    for a, b in zip(ddim, ddpm, strict=True):
        assert (a.i, a.j) == (b.i, b.j)
        assert b.call or a.clean == 0
        np.testing.assert_allclose([a.clean, a.sample, a.noise], [b.clean, b.sample, b.noise], atol=1e-9)


def test_ddim_and_ddpm_draw_the_same_plans_then():
    schedule, system = cosine(60), SYSTEMS["n=3,m=1"]
    ddim = draw(DDIM(60, eta=1.0), schedule, system).tau
    ddpm = draw(DDPM(variance="posterior", skip_below=0), schedule, system).tau
    np.testing.assert_allclose(ddim, ddpm, atol=1e-9)


def test_the_last_step_adds_the_noise_of_beta_1_only_if_it_is_asked_to():
    schedule = paper_linear()
    assert DDPM().steps(schedule)[-1].noise == np.sqrt(schedule.beta[1])
    assert DDPM(last_step_noise=False).steps(schedule)[-1].noise == 0
    assert DDPM(variance="posterior").steps(schedule)[-1].noise == 0
    assert DDPM().steps(schedule)[:-1] == DDPM(last_step_noise=False).steps(schedule)[:-1]


@given(st.integers(1, 300), st.integers(1, 400), st.floats(0, 1))
def test_ddim_takes_as_many_steps_as_asked_and_there_are(L, count, eta):
    steps = DDIM(count, eta).steps(paper_linear(L, 1 / L))
    assert len(steps) == min(count, L)
    assert all(step.i > step.j for step in steps)


# --- skipping


@every_schedule
def test_skipping_moves_the_sample_by_less_than_its_bound(schedule):
    """Both chains draw the same noise; the difference is measured where the network is called first."""
    system, largest = SYSTEMS["n=3,m=1"], []
    all_calls, skipping = DDPM(skip_below=0), DDPM(skip_below=3e-4)
    first = next(step.i for step in skipping.steps(schedule) if step.call)
    seen: dict[str, torch.Tensor] = {}

    def watch(name: str):
        return lambda j, stage, tau: seen.setdefault(name, tau.clone()) if j == first and stage == "project" else None

    denoise = exact(system, schedule)

    def spy(tau, i, environment):
        tau0_hat = denoise(tau, i, environment)
        largest.append(float(tau0_hat.abs().max()))
        return tau0_hat

    environment, shape = one_environment(system, 3), (3, system.layout(HORIZON).size)
    for name, sampler in (("all", all_calls), ("skipping", skipping)):
        result = sample(sampler, schedule, spy, environment, shape, torch_generator(0, "test"), observe=watch(name))
        assert result.network_calls == sum(step.call for step in sampler.steps(schedule))
    if first == schedule.num_steps:  # nothing was skipped: tau_L carries too much signal
        assert schedule.alpha_bar[-1] > 1e-9
        return
    moved = float((seen["all"] - seen["skipping"]).abs().max())
    bound = skipped_weight(skipping.steps(schedule)) * max(largest)
    assert 0 < moved <= bound * (1 + 1e-9)
    assert bound <= 3e-4 * max(largest)


def test_most_of_the_papers_chain_needs_no_call():
    calls = sum(step.call for step in component("sampler", "ddpm").steps(paper_linear()))
    assert 100 < calls <= 200


@every_schedule
def test_the_last_call_is_never_skipped(schedule):
    assert DDPM(skip_below=1 - 1e-9).steps(schedule)[-1].call


# --- the law


FINE = [DDPM(variance="posterior"), DDPM(last_step_noise=False), DDIM(400), DDIM(400, eta=1.0)]


@pytest.mark.parametrize("sampler", FINE, ids=str)
def test_with_the_exact_denoiser_plans_have_the_laws_mean_and_covariance(sampler, system):
    """The chain is affine and Gaussian, so its own law is computed without sampling.

    What is left is that its steps are finite: the error is small where the law is wide against the last steps' noise,
    which a process noise of 0.3 makes it, and falls with the number of steps.
    """
    wide = replace(system, process_noise=0.3)
    law, environment = lqr(wide).law(wide), one_environment(wide, 1).numpy()[0]
    mean, covariance = chain_law(sampler, cosine(400), wide)
    np.testing.assert_allclose(mean, law.mean_map @ environment, atol=1e-3)
    np.testing.assert_allclose(covariance, law.covariance, atol=0.03 * np.abs(law.covariance).max())


def chain_law(sampler, schedule: Schedule, system: Linear) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of tau_0, from one chain without noise and the propagation of what noise each step adds."""
    denoise, d = exact(system, schedule), system.layout(HORIZON).size
    environment = one_environment(system, d + 1)
    probes = torch.cat([torch.zeros(1, d, dtype=torch.float64), torch.eye(d, dtype=torch.float64)])
    mean, covariance = np.zeros(d), np.eye(d)
    for step in sampler.steps(schedule):
        image = step.sample * probes + (step.clean * denoise(probes, step.i, environment) if step.call else 0)
        offset, M = image[0].numpy(), (image[1:] - image[0]).numpy().T
        mean, covariance = M @ mean + offset, M @ covariance @ M.T + step.noise**2 * np.eye(d)
    return mean, covariance


def test_sampled_plans_have_the_mean_and_covariance_that_the_chain_should_give():
    schedule, system, plans = cosine(40), SYSTEMS["n=3,m=1"], 4000
    sampler = DDPM(variance="posterior")
    tau = draw(sampler, schedule, system, plans).tau.numpy()
    mean, covariance = chain_law(sampler, schedule, system)
    sigma = np.sqrt(np.diag(covariance))
    assert (np.abs(tau.mean(axis=0) - mean) <= 5 * sigma / np.sqrt(plans) + 1e-9).all()
    error = np.abs(np.cov(tau.T) - covariance)
    assert (error <= 5 * np.sqrt(2 / plans) * np.outer(sigma, sigma) + 1e-12).all()


def test_more_steps_come_closer_to_the_law():
    system = replace(SYSTEMS["n=3,m=1"], process_noise=0.3)
    law = lqr(system).law(system).covariance
    errors = [np.abs(chain_law(DDPM(variance="posterior"), cosine(L), system)[1] - law).max() for L in (25, 100, 400)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_the_last_step_noise_adds_exactly_beta_1():
    system, schedule = SYSTEMS["n=3,m=1"], paper_linear()
    with_noise, without = (chain_law(DDPM(last_step_noise=noise), schedule, system) for noise in (True, False))
    assert np.array_equal(with_noise[0], without[0])
    np.testing.assert_allclose(with_noise[1] - without[1], schedule.beta[1] * np.eye(len(without[1])), atol=1e-12)


# --- the chain


@every_sampler
def test_the_same_seed_gives_the_same_plans(sampler):
    schedule, system = cosine(30), SYSTEMS["n=5,m=2"]
    one, two, other = (draw(sampler, schedule, system, seed=seed).tau for seed in (0, 0, 1))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)
    assert one.dtype == torch.float64


def test_a_chain_stops_where_a_value_leaves_the_bound():
    def denoise(tau, i, environment):
        return 1e3 * torch.ones_like(tau) if i > 10 else torch.full_like(tau, torch.nan)

    def run(bound: float) -> Samples:
        shape, environment = (2, 5), torch.zeros(2, 1, dtype=torch.float64)
        return sample(
            DDIM(20), cosine(20), denoise, environment, shape, torch_generator(0, "x"), divergence_bound=bound
        )

    assert run(1e6).diverged_at == 10  # nan
    stopped = run(500.0)
    assert stopped.diverged_at > 10
    assert stopped.network_calls == 20 - stopped.diverged_at + 1


def test_a_projection_at_the_end_that_leaves_the_bound_is_seen():
    seen = []
    samples = sample(
        DDIM(5), cosine(20), lambda tau, i, environment: torch.zeros_like(tau), torch.zeros(2, 1), (2, 5),
        torch_generator(0, "x"), lambda tau: tau + 1e12, PostHoc(), lambda j, stage, tau: seen.append((j, stage)),
    )  # fmt: skip
    assert samples.diverged_at == 0
    assert seen[-2:] == [(0, "project"), (0, "end")]


@pytest.mark.parametrize(
    "make",
    [
        lambda: DDPM(skip_below=-1e-3),
        lambda: DDPM(skip_below=1.0),
        lambda: DDPM(skip_below=float("nan")),
        lambda: DDIM(num_steps=0),
        lambda: DDIM(eta=1.1),
        lambda: DDIM(eta=float("nan")),
    ],
)
def test_values_out_of_range_are_refused_in_one_line(make):
    with pytest.raises(ConfigError, match=r"^sampler: [^\n]*$"):
        make()

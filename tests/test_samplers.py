"""Laws of samplers: the steps they take, and with the exact denoiser the law they sample from."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from laws import SYSTEMS, component, presets, tolerance, variants

from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion import chain, samplers
from dadiff.diffusion.chain import Samples, sample
from dadiff.diffusion.enforcement import PostHoc
from dadiff.diffusion.samplers import DDIM, DDPM, LEAST_SIGNAL, DPMSolver, Step, visited
from dadiff.diffusion.schedule import Schedule, cosine, paper_linear
from dadiff.errors import ConfigError
from dadiff.randomness import torch_generator
from dadiff.systems import Linear
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

HORIZON = 4
SAMPLERS = variants(
    "sampler",
    {
        "last_step_noise": (False,),
        "variance": ("posterior",),
        "skip_below": (0.0,),
        "eta": (1.0,),
        "spacing": ("uniform", "log_snr"),
    },
)
SCHEDULES = {name: component("schedule", name) for name in presets("schedule")}

every_sampler = pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS.keys())
every_schedule = pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES.keys())


def skipped_weight(steps: list[Step]) -> float:
    """The weight W of skipped clean estimates: the sample at the first call is off by at most W max |tau0_hat|."""
    weight = 0.0
    for step in steps:
        if step.call:
            return weight
        weight = step.sample * weight + step.clean
    return weight


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
            signal = step.clean + step.previous + step.sample * np.sqrt(schedule.alpha_bar[step.i])
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


@every_schedule
@pytest.mark.parametrize("make", [DDIM, DPMSolver])
def test_noise_is_proportional_to_eta(schedule, make):
    """sigma = eta times the posterior's deviation, so that eta = 1/2 has half of it and not its root."""
    for half, whole in zip(make(9, eta=0.5).steps(schedule), make(9, eta=1.0).steps(schedule), strict=True):
        np.testing.assert_allclose(half.noise, 0.5 * whole.noise, atol=1e-15)
    assert any(step.noise > 0.1 for step in make(9, eta=1.0).steps(schedule))


@given(st.integers(1, 300), st.integers(1, 400), st.floats(0, 1))
def test_ddim_takes_as_many_steps_as_asked_and_there_are(L, count, eta):
    steps = DDIM(count, eta).steps(paper_linear(L, 1 / L))
    assert len(steps) == min(count, L)
    assert all(step.i > step.j for step in steps)


# --- where the steps lie


@given(st.integers(1, 300), st.integers(1, 400), st.sampled_from(["uniform", "log_snr"]))
def test_no_step_is_visited_twice(L, count, spacing):
    for schedule in (paper_linear(L, 1 / L), cosine(L)):
        chosen = visited(schedule, count, spacing)
        assert (chosen[0], chosen[-1]) == (L, 0)
        assert 2 <= len(chosen) <= count + 1
        assert all(a > b for a, b in pairwise(chosen))


@every_schedule
@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_calls_are_as_many_as_are_asked_for(schedule, count):
    assert len(visited(schedule, count, "log_snr")) == count + 1


@every_schedule
@pytest.mark.parametrize("count", [3, 5, 10, 20])
def test_steps_in_log_snr_go_from_the_mean_to_where_signal_begins_and_on_evenly(schedule, count):
    first, *inner, last = visited(schedule, count, "log_snr")
    assert (first, last, len(inner)) == (schedule.num_steps, 0, count - 1)
    assert schedule.alpha_bar[inner[0]] >= LEAST_SIGNAL > schedule.alpha_bar[inner[0] + 1]
    assert inner[-1] == 1
    level = schedule.half_log_snr[inner]
    even = np.linspace(level[0], level[-1], count - 1)
    coarsest = np.abs(np.diff(schedule.half_log_snr[1 : inner[0] + 1])).max()  # steps are whole numbers
    assert np.abs(level - even).max() <= 1.5 * coarsest


@every_schedule
def test_the_half_log_snr_is_what_its_name_says(schedule):
    i = np.flatnonzero((schedule.alpha_bar > 1e-12) & (schedule.alpha_bar < 1))
    a = schedule.alpha_bar[i]
    np.testing.assert_allclose(schedule.half_log_snr[i], np.log(a / (1 - a)) / 2, atol=1e-9)
    assert (np.diff(schedule.half_log_snr) < 0).all()
    assert schedule.half_log_snr[0] == np.inf


@pytest.mark.parametrize("eta", [0.0, 1.0])
@every_schedule
def test_the_solver_is_ddim_where_the_clean_estimate_does_not_move(schedule, eta):
    for a, b in zip(DPMSolver(9, eta).steps(schedule), DDIM(9, eta, "log_snr").steps(schedule), strict=True):
        assert (a.i, a.j, a.sample, a.noise) == (b.i, b.j, b.sample, b.noise)
        np.testing.assert_allclose(a.clean + a.previous, b.clean, atol=1e-12)
    assert DPMSolver(9, eta).steps(schedule)[0].previous == DPMSolver(9, eta).steps(schedule)[-1].previous == 0


@pytest.mark.parametrize(("sampler", "order"), [(DDIM, 1), (DPMSolver, 2)])
def test_the_error_falls_with_the_samplers_order(sampler, order):
    """Against very many steps of the same grid's ends, with the exact denoiser: by 2 or by 4 when steps are doubled."""
    schedule, system = cosine(40_000), SYSTEMS["n=3,m=1"]
    exactly = draw(DPMSolver(2000), schedule, system).tau
    found = [draw(sampler(count, 0.0, "log_snr"), schedule, system).tau for count in (20, 40, 80)]
    errors = [float((tau - exactly).norm()) for tau in found]
    ratios = [a / b for a, b in pairwise(errors)]
    assert all(0.75 * 2**order < ratio < 1.35 * 2**order for ratio in ratios), ratios


# --- skipping


@every_schedule
def test_skipping_moves_the_sample_by_less_than_its_bound(schedule):
    """Both chains take every step and draw the same noise; what differs is whether the clean estimate is added."""
    system = SYSTEMS["n=3,m=1"]
    denoise, environment = exact(system, schedule), one_environment(system, 3)
    silent = [step for step in DDPM(skip_below=3e-4).steps(schedule) if not step.call]
    if not silent:  # tau_L carries too much signal
        assert schedule.alpha_bar[-1] > 1e-9
        return
    eps = torch.randn(len(silent) + 1, 3, system.layout(HORIZON).size, dtype=torch.float64)
    all_calls, skipping, largest = eps[0], eps[0], 0.0
    for step, noise in zip(silent, eps[1:], strict=True):
        tau0_hat = denoise(all_calls, step.i, environment)
        largest = max(largest, float(tau0_hat.abs().max()))
        all_calls = step.sample * all_calls + step.clean * tau0_hat + step.noise * noise
        skipping = step.sample * skipping + step.noise * noise
    bound = skipped_weight(DDPM(skip_below=3e-4).steps(schedule)) * largest
    assert 0 < float((all_calls - skipping).abs().max()) <= bound * (1 + 1e-9)
    assert bound <= 3e-4 * largest


def test_most_of_the_papers_chain_needs_no_call():
    calls = sum(step.call for step in component("sampler", "ddpm").steps(paper_linear()))
    assert 100 < calls <= 200


@pytest.mark.parametrize(("bound", "skipped"), [(0.0, 1), (0.2, 1), (0.25, 2), (0.5, 2), (0.625, 3)])
def test_calls_are_skipped_as_long_as_they_weigh_no_more_than_the_bound_together(bound, skipped):
    """Their weights are 0, 1/4, 1/2 * 1/4 + 1/2 = 5/8 and 1."""
    steps = [
        Step(4, 3, 0.0, 1.0, 0.0),
        Step(3, 2, 0.25, 1.0, 0.0),
        Step(2, 1, 0.5, 0.5, 0.0),
        Step(1, 0, 1.0, 0.0, 0.0),
    ]
    assert [step.call for step in samplers._skip(steps, bound)] == [False] * skipped + [True] * (4 - skipped)


@every_schedule
def test_the_last_call_is_never_skipped(schedule):
    assert DDPM(skip_below=1 - 1e-9).steps(schedule)[-1].call


# --- the law


FINE = [DDPM(variance="posterior"), DDPM(last_step_noise=False), DDIM(400), DDIM(400, eta=1.0)]
FINE += [DPMSolver(50), DPMSolver(50, 1.0)]


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
    """Mean and covariance of tau_0, propagated step by step; the clean estimate of the step before is a state, too."""
    denoise, d = exact(system, schedule), system.layout(HORIZON).size
    environment = one_environment(system, d + 1)
    probes = torch.cat([torch.zeros(1, d, dtype=torch.float64), torch.eye(d, dtype=torch.float64)])
    mean, covariance = np.zeros(2 * d), np.diag([1.0] * d + [0.0] * d)
    for step in sampler.steps(schedule):
        tau0_hat = denoise(probes, step.i, environment).numpy() if step.call else np.zeros((d + 1, d))
        constant, estimate = tau0_hat[0], (tau0_hat[1:] - tau0_hat[0]).T
        offset = np.concatenate([step.clean * constant, constant])
        M = np.block(
            [[step.sample * np.eye(d) + step.clean * estimate, step.previous * np.eye(d)], [estimate, np.zeros((d, d))]]
        )
        mean, covariance = M @ mean + offset, M @ covariance @ M.T
        covariance[:d, :d] += step.noise**2 * np.eye(d)
    return mean[:d], covariance[:d, :d]


# Least and largest share of the law's spread (trace of the covariance) that is left, by calls: of the paper's task,
# schedule and noise, with the exact denoiser. What is missing at 50 calls is missing from the last call's estimate.
KEPT = {3: (0.08, 0.12), 5: (0.40, 0.50), 10: (0.80, 1.0), 20: (0.83, 1.0), 50: (0.84, 1.0)}
KEPT_FIRST_ORDER = {3: (0.08, 0.12), 5: (0.25, 0.35), 10: (0.5, 0.65), 20: (0.65, 0.8), 50: (0.7, 0.85)}
KEPT_EVENLY = {3: (0.0, 1e-9), 5: (0.0, 1e-6), 10: (0.0, 2e-4), 20: (0.0, 0.01), 50: (0.04, 0.08)}
FEW = {DPMSolver: KEPT, partial(DDIM, spacing="log_snr"): KEPT_FIRST_ORDER, DDIM: KEPT_EVENLY}


@pytest.mark.parametrize(("make", "kept"), FEW.items(), ids=["dpm_solver", "ddim in log-SNR", "ddim"])
def test_few_calls_keep_the_mean_and_so_much_of_the_spread(make, kept):
    """Tables show spread beside error: a sampler that always returns the mean has the least error of all."""
    system, schedule = SYSTEMS["paper"], paper_linear()
    variance = ExactDenoiser(LQR().law(system), physical(system.layout(LQR().horizon)), schedule).variance
    for calls, (least, most) in kept.items():
        mean, spread = spectral_law(make(calls), schedule, variance)
        np.testing.assert_allclose(mean, 1, atol=1e-9)
        assert least <= spread / variance.sum() <= most, (calls, spread / variance.sum())


def spectral_law(sampler, schedule: Schedule, variance: np.ndarray) -> tuple[np.ndarray, float]:
    """The mean as a multiple of the law's, and the trace of the covariance on its support, direction by direction."""
    second = np.zeros((len(variance), 2, 2))
    second[:, 0, 0], mean = 1.0, np.zeros((len(variance), 2))
    for step in sampler.steps(schedule):
        a = schedule.alpha_bar[step.i]
        gain = np.sqrt(a) * variance / (a * variance + 1 - a)
        M = np.zeros((len(variance), 2, 2))
        M[:, 0, 0], M[:, 0, 1], M[:, 1, 0] = step.sample + step.clean * gain, step.previous, gain
        rest = 1 - gain * np.sqrt(a)
        mean = np.einsum("kij,kj->ki", M, mean) + np.stack([step.clean * rest, rest], axis=-1)
        second = M @ second @ M.transpose(0, 2, 1)
        second[:, 0, 0] += step.noise**2
    return mean[:, 0], float(second[:, 0, 0].sum())


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


@pytest.mark.parametrize("skip_below", [0.0, 0.1])
def test_the_sample_of_the_first_call_is_shown_where_steps_came_before_it(skip_below):
    seen, sampler, schedule = [], DDPM(skip_below=skip_below), cosine(20)
    still, nothing = (lambda tau, i, environment: tau), torch.zeros(1, 1, dtype=torch.float64)
    first = next(step.i for step in sampler.steps(schedule) if step.call)
    sample(
        sampler,
        schedule,
        still,
        nothing,
        (1, 2),
        torch_generator(0, "x"),
        observe=lambda j, stage, _: seen.append((j, stage)),
    )
    assert (first < 20) == bool(skip_below)
    expected = [(j, stage) for j in range(first - 1, -1, -1) for stage in ("predict", "project")]
    assert seen == [(first, "project")] * (first < 20) + expected + [(0, "end")]


@pytest.mark.parametrize("progress", [False, True])
def test_a_chain_shows_its_progress_only_if_it_is_asked_to(progress, monkeypatch):
    shown = []
    monkeypatch.setattr(chain, "tqdm", lambda steps, **_: shown.append(len(steps)) or steps)
    still, nothing = (lambda tau, i, environment: tau), torch.zeros(1, 1, dtype=torch.float64)
    sample(DDIM(4), cosine(9), still, nothing, (1, 2), torch_generator(0, "x"), progress=progress)
    assert shown == [4] * progress


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

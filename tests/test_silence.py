"""The silent start of a chain, drawn as one, has the law of its steps taken one by one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from laws import component, presets, variants

from dadiff.diffusion.chain import sample
from dadiff.diffusion.context import Context, Counted, unprojected
from dadiff.diffusion.enforcement import Convex, Never, Normalised
from dadiff.diffusion.samplers import DDPM, Step
from dadiff.diffusion.schedule import Schedule, cosine, paper_linear
from dadiff.diffusion.silence import Silence, begin
from dadiff.randomness import torch_generator

SCHEDULE = paper_linear(40, 1 / 40)
STEPS = [*(Step(i, i - 1, 0.0, 0.9 - i / 100, 0.2 + i / 100, call=False) for i in range(40, 30, -1))]
STEPS += [Step(i, i - 1, 0.5, 0.5, 0.0) for i in range(30, 0, -1)]
SILENT = STEPS[:10]
ENFORCEMENTS = variants("enforcement", {"acts_on": ("sample", "clean_estimate")})


def affine(orthogonal: bool, offset: bool, d: int = 6, rank: int = 3):
    """(Pi, o) of P(z) = Pi z + o with P(P(z)) = P(z)."""
    rng = np.random.default_rng(0)
    onto, along = rng.standard_normal((2, d, rank))
    Pi = onto @ np.linalg.pinv(onto) if orthogonal else onto @ np.linalg.solve(along.T @ onto, along.T)
    return Pi, (np.eye(d) - Pi) @ rng.standard_normal(d) * offset


def as_projection(Pi, o):
    Pi, o = torch.from_numpy(Pi), torch.from_numpy(o)
    return lambda z: z @ Pi.T + o


def reaching(step: Step, schedule: Schedule, project) -> Context:
    """What an enforcement reads of the chain."""
    nothing = torch.zeros(0)
    return Context(step, schedule, nothing, nothing, project, Counted(lambda tau, i, environment: tau), lambda: nothing)


def law_step_by_step(enforcement, Pi, o) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of tau after the silent steps, each an affine map whose matrix is read off."""
    d = len(o)
    P = as_projection(Pi, o)
    mean, covariance = np.zeros(d), np.eye(d)
    for step in SILENT:
        mean, covariance = step.sample * mean, step.sample**2 * covariance + step.noise**2 * np.eye(d)
        probes = torch.cat([torch.zeros(1, d, dtype=torch.float64), torch.eye(d, dtype=torch.float64)])
        image = enforcement.sample(probes, reaching(step, SCHEDULE, P)).numpy()
        K = (image[1:] - image[0]).T
        mean, covariance = K @ mean + image[0], K @ covariance @ K.T
    return mean, covariance


def law_at_once(enforcement, Pi, o) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of what `begin` gives, which is affine in its two draws: these are read off, too."""
    d = len(o)
    unit, zero = torch.eye(d, dtype=torch.float64), torch.zeros(d, d, dtype=torch.float64)
    draws = iter([torch.cat([0 * unit[:1], unit, zero]), torch.cat([0 * unit[:1], zero, unit])])
    tau, left = begin(STEPS, SCHEDULE, lambda: next(draws), as_projection(Pi, o), enforcement)
    assert list(left) == STEPS[10:]
    J = (tau[1:] - tau[0]).numpy().T
    return tau[0].numpy(), J @ J.T


@pytest.mark.parametrize("enforcement", [Never(), Normalised(), Convex(), Convex("clean_estimate")], ids=str)
@pytest.mark.parametrize("orthogonal", [True, False])
@pytest.mark.parametrize("offset", [True, False])
def test_drawn_as_one_they_have_exactly_the_mean_and_covariance_of_the_steps(enforcement, orthogonal, offset):
    Pi, o = affine(orthogonal, offset)
    for one_by_one, at_once in zip(law_step_by_step(enforcement, Pi, o), law_at_once(enforcement, Pi, o), strict=True):
        np.testing.assert_allclose(at_once, one_by_one, atol=1e-12 * np.abs(one_by_one).max())


@pytest.mark.parametrize("enforcement", ENFORCEMENTS.values(), ids=ENFORCEMENTS.keys())
@pytest.mark.parametrize("schedule", [SCHEDULE, cosine(30)], ids=["paper_linear", "cosine"])
def test_an_enforcement_keeps_of_the_displacement_what_it_says(enforcement, schedule):
    P = as_projection(*affine(orthogonal=True, offset=enforcement.affine))
    tau = torch.randn(5, 6, dtype=torch.float64, generator=torch_generator(0, "test"))
    for j in (0, 1, 10, 29):
        if (k := enforcement.keeps(schedule, j)) is not None:
            expected = P(tau) + k * (tau - P(tau))
            at = reaching(Step(j + 1, j, 0.0, 1.0, 0.0, call=False), schedule, P)
            np.testing.assert_allclose(enforcement.sample(tau, at), expected, atol=1e-12)


def test_what_is_not_an_affine_idempotent_map_is_taken_step_by_step():
    eps = torch.randn(2, 7, 6, dtype=torch.float64, generator=torch_generator(0, "test"))
    P = as_projection(*affine(orthogonal=True, offset=True))
    for project in (lambda z: z.clamp(-0.5, 0.5), lambda z: 0.9 * P(z), lambda z: P(z) + z**2):
        draws = iter(eps)
        tau, left = begin(STEPS, SCHEDULE, lambda: next(draws), project, Normalised())  # noqa: B023
        assert torch.equal(tau, eps[0])
        assert list(left) == STEPS


def test_without_silent_steps_the_chain_begins_with_one_draw():
    draws = iter(torch.ones(1, 3))
    tau, left = begin(STEPS[10:], SCHEDULE, lambda: next(draws), unprojected, Never())
    assert torch.equal(tau, torch.ones(3))
    assert list(left) == STEPS[10:]


def test_the_noise_that_is_drawn_does_not_depend_on_what_is_projected():
    P, after = as_projection(*affine(orthogonal=False, offset=True)), []
    cases = ((lambda z: z, Never()), (P, Never()), (P, Normalised()), (lambda z: z.sin(), Normalised()))
    for project, enforcement in cases:
        generator = torch_generator(0, "test")
        draw = partial(torch.randn, 2, 6, generator=generator, dtype=torch.float64)
        begin(STEPS, SCHEDULE, draw, project, enforcement)
        after.append(torch.randn(3, generator=generator))
    assert all(torch.equal(after[0], other) for other in after)


@pytest.mark.parametrize("name", presets("schedule"))
def test_the_papers_chain_reaches_its_first_call_in_unit_noise(name):
    """Where alpha_bar is next to nothing, each step takes as much variance as it adds."""
    schedule, law = component("schedule", name), Silence()
    for step in DDPM().steps(schedule):
        if step.call:
            break
        law = law.after(step, 1.0)
    assert law.inside == law.across == law.outside
    assert law.shift == 0
    np.testing.assert_allclose(law.inside, 1, atol=1e-4)


class OneByOne(DDPM):
    """DDPM whose silent steps ask for a clean estimate of no weight, so that they are taken one by one."""

    def steps(self, schedule):
        return [replace(step, call=True, clean=step.clean * step.call) for step in super().steps(schedule)]


def test_plans_after_the_silent_start_have_the_moments_of_plans_without_it():
    """The whole chain of the paper, drawn both ways, on 20,000 plans of one number each."""
    schedule, plans = paper_linear(), 20_000
    environment = torch.zeros(plans, 1, dtype=torch.float64)

    def draw(sampler):
        denoise = lambda tau, i, environment: 0.3 * tau + 1  # noqa: E731
        return sample(sampler, schedule, denoise, environment, (plans, 1), torch_generator(0, "x")).tau.numpy()

    at_once, one_by_one = draw(DDPM()), draw(OneByOne())
    assert abs(at_once.mean() - one_by_one.mean()) < 5 * one_by_one.std() * np.sqrt(2 / plans)
    assert abs(at_once.std() / one_by_one.std() - 1) < 5 / np.sqrt(plans)

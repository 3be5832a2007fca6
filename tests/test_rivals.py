"""The rivals against their formulas, with G written out, on a small Gaussian law whose Jacobian is a matrix."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
import torch
from test_conditional import LAYOUT, SCHEDULE, SIZE, WHERE, constraint, estimate, law

from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.context import Context, Counted
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.rivals import (
    DPS,
    MCG,
    PPR,
    TMPD,
    DiRecT,
    LateEstimate,
    PiGDM,
    ProjectedSamples,
    Replacement,
    RolloutBlend,
    Selected,
    Tracked,
)
from dadiff.diffusion.samplers import DDIM
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.trajectory.covariance import Covariance

PLANS, STEP = 3, DDIM(20).steps(SCHEDULE)[18]  # where there is signal
A_I, A_J = (float(SCHEDULE.alpha_bar[step]) for step in (STEP.i, STEP.j))
E = torch.tensor([[0.3, -0.7]], dtype=torch.float64).repeat(PLANS, 1)
DENOISE = ExactDenoiser(law(), WHERE, SCHEDULE)


def draws(seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((PLANS, SIZE)))


TAU, EPS = draws(1), draws(2)


def context(denoise=DENOISE) -> Context:
    dynamics, held, *_ = constraint("pinned")
    P = dynamics.bind(WHERE, held)
    return Context(STEP, SCHEDULE, TAU, E, P, Counted(denoise), lambda: EPS, estimate(law()))


def rows() -> tuple[torch.Tensor, torch.Tensor]:
    """G z = g in scaled coordinates, with x(0) among the rows."""
    *_, G, g, _ = constraint("pinned")
    return torch.from_numpy(G * WHERE.scale), torch.from_numpy(g - G @ WHERE.mean)


def jacobian() -> torch.Tensor:
    """J of the exact denoiser: sqrt(a) Sigma (a Sigma + (1 - a) I)^-1."""
    Sigma = estimate(law()).covariance
    return torch.from_numpy(sqrt(A_I) * Sigma @ np.linalg.inv(A_I * Sigma + (1 - A_I) * np.eye(SIZE)))


def corrected(z: torch.Tensor, C: torch.Tensor) -> torch.Tensor:
    G, g = rows()
    return z - (z @ G.T - g) @ torch.linalg.inv(G @ C @ G.T) @ G @ C


TAU0 = DENOISE(TAU, STEP.i, E)
IDENTITY = torch.eye(SIZE, dtype=torch.float64)
CHANGE = corrected(TAU0, IDENTITY) - TAU0


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_step_has_signal_and_the_set_is_missed():
    assert 0.2 < A_I < A_J < 1
    assert CHANGE.abs().max() > 0.1


def test_pseudo_inverse_guidance_is_the_gradient_of_the_likelihood_of_the_pseudo_inverse():
    at = context()
    clean = PiGDM().clean(TAU0, at)
    close(clean, TAU0)
    G, g = rows()
    guidance = (g - TAU0 @ G.T) @ torch.linalg.inv(G @ G.T) @ G @ jacobian()
    close(PiGDM().sample(TAU, at), TAU + sqrt(A_I) * guidance)
    assert at.denoise.calls == 1


@pytest.mark.parametrize("at_once", [1, 8192])
def test_the_jacobian_is_the_same_however_many_directions_are_taken_at_once(at_once, monkeypatch):
    monkeypatch.setattr("dadiff.diffusion.context.AT_ONCE", at_once)
    close(context().jacobian(), jacobian().expand(*TAU.shape, SIZE))


def test_tmpd_of_an_exact_denoiser_is_the_conditional_projection():
    found = TMPD().clean(TAU0, context())
    close(found, Conditional(floor=0.0, shrinkage=0.0).clean(TAU0, context()))
    close(found, corrected(TAU0, (1 - A_I) / sqrt(A_I) * jacobian()))


def test_posterior_sampling_follows_the_gradient_of_the_distance():
    tau = TAU.clone().requires_grad_()
    tau0 = DENOISE.estimate(tau, STEP.i, E)
    distance = (tau0 - corrected(tau0, IDENTITY)).norm(dim=-1)
    (gradient,) = torch.autograd.grad(distance.sum(), tau)
    at = context()
    close(DPS(0.7).clean(TAU0, at), TAU0)
    close(DPS(0.7).sample(TAU, at), TAU - 0.7 * gradient)


def test_posterior_sampling_does_not_move_what_is_in_the_set():
    at = context()
    inside = corrected(TAU0, IDENTITY)
    at = Context(STEP, SCHEDULE, TAU, E, lambda z, *_, **__: z, Counted(DENOISE), lambda: EPS)
    DPS(1.0).clean(inside, at)
    close(DPS(1.0).sample(TAU, at), TAU)


def test_what_the_set_fixes_is_replaced_by_its_forward_process():
    moved = Replacement().sample(TAU, context())
    G, g = rows()
    inverse = torch.linalg.inv(G @ G.T)
    Pi = IDENTITY - G.T @ inverse @ G
    origin = G.T @ inverse @ g
    close(moved, TAU @ Pi + sqrt(A_J) * origin + sqrt(1 - A_J) * EPS @ (IDENTITY - Pi))
    at = context()
    MCG(0.7).clean(TAU0, at)
    gradient_step = DPS(0.7).sample(TAU, at)
    close(MCG(0.7).sample(TAU, at), Replacement().sample(gradient_step, context()))


def test_direct_moves_the_step_by_what_the_projection_changes():
    at = context()
    close(DiRecT().clean(TAU0, at), TAU0)
    close(DiRecT().sample(TAU, at), TAU + sqrt(A_J) * CHANGE)


def test_the_public_variant_blends_by_the_signal_that_it_comes_from():
    close(RolloutBlend().clean(TAU0, context()), TAU0 + A_I * CHANGE)


@pytest.mark.parametrize("sweeps", [1, 3])
def test_predict_project_renoise(sweeps):
    at, expected = context(), TAU0
    for k in range(sweeps):
        if k:
            expected = DENOISE(sqrt(A_I) * expected + sqrt(1 - A_I) * EPS, STEP.i, E)
        expected = corrected(expected, IDENTITY)
    close(PPR(sweeps).clean(TAU0, at), expected)
    assert at.denoise.calls == sweeps - 1
    step = PPR().weights(STEP, SCHEDULE)
    np.testing.assert_allclose([step.clean**2 + step.noise**2, step.sample], [1, 0])


@pytest.mark.parametrize("signal", [0.0, A_J, (A_J + 1) / 2, 1.0])
def test_what_acts_late_begins_where_enough_signal_is_left(signal):
    moved = ProjectedSamples(signal).sample(TAU, context())
    close(moved, corrected(TAU, IDENTITY) if signal <= A_J else TAU)
    assert ProjectedSamples(signal).keeps(SCHEDULE, STEP.j) == float(signal > A_J)
    late = LateEstimate(signal).clean(TAU0, context())
    close(late, TAU0 + CHANGE if signal <= A_I else TAU0)


@pytest.mark.parametrize("enforcement", [PiGDM(), DPS(), MCG(), TMPD()], ids=lambda e: type(e).__name__)
def test_gradients_need_a_denoiser_that_has_them(enforcement):
    with pytest.raises(NotApplicableError, match="it needs the denoiser's gradient"):
        enforcement.clean(TAU0, context(lambda tau, i, E: tau))


@pytest.mark.parametrize("make", [lambda: DPS(-1.0), lambda: PPR(0), lambda: ProjectedSamples(1.01)])
def test_parameters_without_meaning_are_refused(make):
    with pytest.raises(ConfigError, match="it must lie in"):
        make()


def test_a_tracked_plan_is_the_solution_of_the_quadratic_programme():
    """min sum q |x - x_hat|^2 + r |u - u_hat|^2 within G tau = g, in physical units, by its optimality conditions."""
    made = estimate(law())
    at = replace(context(), estimate=Estimate(made.covariance, made.deviation, made.unit, LAYOUT))
    weights = np.full(SIZE, 0.2)
    weights[LAYOUT.all_states] = 3.0
    *_, G, g, _ = constraint("pinned")
    wanted, W = WHERE.to_physical(TAU.numpy()), np.diag(weights)
    conditions = np.block([[W, G.T], [G, np.zeros((len(G), len(G)))]])
    right = np.concatenate([wanted @ W, np.tile(g, (PLANS, 1))], axis=-1)
    expected = np.linalg.solve(conditions, right.T).T[:, :SIZE]
    close(WHERE.to_physical(Tracked(3.0, 0.2).end(TAU, at).numpy()), expected)
    with pytest.raises(ConfigError, match="which entries are states is not known"):
        Tracked().end(TAU, context())


def test_of_the_plans_for_one_case_that_is_selected_which_was_moved_least():
    rival, moved = Selected(0.0), 0.0
    E = torch.tensor([[0.0, 1.0], [0.0, 1.0], [2.0, 1.0]], dtype=torch.float64)
    at = replace(context(), environment=E)
    for tau in (TAU, EPS):
        close(rival.sample(tau, at), corrected(tau, IDENTITY))
        moved = moved + (corrected(tau, IDENTITY) - tau).norm(dim=-1)
    close(at.memory["moved"], moved)
    best = int(moved[:2].argmin())
    close(rival.end(TAU, at), TAU[[best, best, 2]])
    fleet = replace(at, environment=E[None].expand(2, -1, -1), memory={"moved": torch.stack([moved, -moved])})
    plans = torch.stack([TAU, EPS])
    close(rival.end(plans, fleet), torch.stack([TAU[[best, best, 2]], EPS[[1 - best, 1 - best, 2]]]))


@pytest.mark.parametrize("count", [0, SIZE])
def test_a_metric_for_each_plan_projects_each_plan_in_its_own(count):
    rng, P = np.random.default_rng(5), context().project
    factors, variances = rng.standard_normal((PLANS, SIZE, count)), rng.uniform(0.1, 1, (PLANS, SIZE))
    together = P(TAU0, Covariance(variances, factors))
    for k in range(PLANS):
        alone = P(TAU0[[k]], Covariance(variances[k], factors[k]))
        close(together[[k]], alone)

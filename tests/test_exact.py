"""The exact bench: laws of plans in closed form, held against draws and against independent formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm

from dadiff.behaviours import Identified, Known
from dadiff.denoisers import MLP, MomentMatched
from dadiff.denoisers import Gaussian as GaussianRecipe
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.enforcement import CleanEstimate, Enforcement, Never, Normalised, PostHoc
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.rivals import DPS, Selected
from dadiff.diffusion.samplers import DDIM, DDPM, DPMSolver, Sampler
from dadiff.diffusion.schedule import Schedule, paper_linear
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.exact import Gaussian, conditional_law, exactness, law_of_plans, sampled_exactness, wasserstein
from dadiff.experts.lqr import GaussianLaw
from dadiff.planning import Planner
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.systems import DampedIntegrators, GaussianExcitation, double_integrator
from dadiff.tasks import LQR, Fleet
from dadiff.trajectory.coordinates import Coordinates, physical, standardised

T = 8
TASK, FAMILY, SCHEDULE = Fleet(horizon=T, robots=60), DampedIntegrators(), paper_linear()
SHOWN = TASK.demonstrations(FAMILY, 30, numpy_generator(0, "demonstrations"))
LAW = GaussianLaw.of_demonstrations(SHOWN.trajectories, SHOWN.environment)
ROBOT = TASK.target(FAMILY).take([3])
LAYOUT = ROBOT.layout(T)
CASES = TASK.cases(ROBOT, 1, numpy_generator(0, "cases"))
EXACT = Conditional(floor=0.0, shrinkage=0.0, spread=True)


def planner(
    enforcement: Enforcement | None = None,
    sampler: Sampler | None = None,
    where: Coordinates | None = None,
    schedule: Schedule = SCHEDULE,
) -> Planner:
    where = where or physical(LAYOUT)
    covariance = LAW.covariance / where.scale[:, None] / where.scale
    denoiser = MomentMatched().exact(LAW, where, schedule)
    return Planner(
        TASK, ROBOT, schedule, sampler or DDIM(10, eta=1.0, spacing="log_snr"), denoiser, where,
        Known("fixed").fit(LAYOUT, system=ROBOT), enforcement or CleanEstimate(), True,
        estimate=Estimate.of_covariance(LAYOUT, where, SHOWN.trajectories, covariance),
    )  # fmt: skip


def test_the_law_of_demonstrations_is_their_regression_on_E_and_what_that_leaves():
    E = np.column_stack([np.ones(len(SHOWN.environment)), SHOWN.environment])
    coefficients = np.linalg.lstsq(E, SHOWN.trajectories)[0]
    left = SHOWN.trajectories - E @ coefficients
    np.testing.assert_allclose(LAW.covariance, left.T @ left / (len(E) - E.shape[1]), atol=1e-12)
    np.testing.assert_allclose(LAW.mean(E[:5, 1:]), E[:5] @ coefficients, atol=1e-10)


def test_the_distance_of_gaussians_is_the_formula_of_givens_and_shortt():
    rng = np.random.default_rng(0)
    (a, b), (m, n) = (F @ F.T for F in rng.standard_normal((2, 5, 5))), rng.standard_normal((2, 5))
    expected = np.sqrt(np.square(m - n).sum() + np.trace(a + b - 2 * sqrtm(sqrtm(b) @ a @ sqrtm(b)).real))
    assert wasserstein(Gaussian(m, a), Gaussian(n, b)) == pytest.approx(expected, rel=1e-10)
    assert wasserstein(Gaussian(m, a), Gaussian(m, a)) < 1e-6


def test_the_right_law_is_that_of_the_prior_given_the_dynamics():
    """Against the formula of conditional Gaussians with G written out."""
    A, B = ROBOT.A[0], ROBOT.B[0]
    x, u = LAYOUT.split(np.eye(LAYOUT.size))
    G = (x[:, 1:] - x[:, :-1] @ A.T - u @ B.T).reshape(LAYOUT.size, -1).T
    G = np.concatenate([G, np.eye(LAYOUT.size)[LAYOUT.initial_state]])
    g = np.concatenate([np.zeros(4 * T), CASES.x_init[0, 0]])
    S, mean = LAW.covariance, LAW.mean(CASES.environment)[0, 0]
    K = S @ G.T @ np.linalg.pinv(G @ S @ G.T, rcond=1e-10, hermitian=True)
    right = conditional_law(planner(), CASES.environment)
    np.testing.assert_allclose(right.mean, mean - K @ (G @ mean - g), atol=1e-4)
    np.testing.assert_allclose(right.covariance, S - K @ G @ S, atol=1e-4)


SAMPLERS = [DDIM(10, eta=1.0, spacing="log_snr"), DPMSolver(6), DDIM(7), DDPM(last_step_noise=False)]
ENFORCEMENTS = [Never(), PostHoc(), CleanEstimate(), Normalised(), Conditional(), EXACT]


@pytest.mark.parametrize("sampler", SAMPLERS[:3], ids=["ancestral", "dpm_solver", "ddim"])
@pytest.mark.parametrize("enforcement", ENFORCEMENTS, ids=lambda e: f"{type(e).__name__}{getattr(e, 'spread', '')}")
def test_the_law_of_plans_is_that_of_draws(enforcement, sampler):
    one = planner(enforcement, sampler)
    law, calls = law_of_plans(one, CASES.environment)
    plans = one.plan(CASES.environment, samples=4000)
    assert calls == plans.network_calls
    drawn = plans.tau.reshape(4000, -1)
    deviation = np.sqrt(np.diag(law.covariance).max())
    np.testing.assert_allclose(drawn.mean(axis=0), law.mean, atol=5 * deviation / np.sqrt(4000) + 1e-8)
    np.testing.assert_allclose(np.cov(drawn.T), law.covariance, atol=0.12 * deviation**2)


def test_silent_steps_are_part_of_the_law():
    """The paper's chain, whose leading steps the sampler draws as one, in a short schedule."""
    one = planner(Normalised(), DDPM(last_step_noise=False), schedule=paper_linear(50, 0.02))
    law, _ = law_of_plans(one, CASES.environment)
    drawn = one.plan(CASES.environment, samples=4000).tau.reshape(4000, -1)
    deviation = np.sqrt(np.diag(law.covariance).max())
    np.testing.assert_allclose(drawn.mean(axis=0), law.mean, atol=5 * deviation / np.sqrt(4000) + 1e-8)


@pytest.mark.parametrize("where", [physical(LAYOUT), standardised(LAYOUT, SHOWN.trajectories)], ids=["physical", "std"])
@pytest.mark.parametrize("steps", [3, 10])
def test_draws_of_the_conditional_law_are_exact_at_any_number_of_steps(steps, where):
    found = exactness(planner(EXACT, DPMSolver(steps), where), CASES.environment)
    assert found.distance < 0.01
    assert found.mean_distance < 1e-3
    assert found.spread == pytest.approx(1, abs=0.01)


def test_the_papers_readings_are_far_from_it():
    found = {type(e).__name__: exactness(planner(e), CASES.environment) for e in (CleanEstimate(), Normalised())}
    assert min(f.distance for f in found.values()) > 10 * exactness(planner(EXACT), CASES.environment).distance


def test_what_is_right_knows_the_dynamics_whatever_the_method_knows():
    recording = GaussianExcitation(40).record(ROBOT)
    estimated = replace(planner(EXACT), behaviour=Identified("fixed").fit(LAYOUT, recording=recording))
    against_itself = exactness(estimated, CASES.environment)
    against_truth = exactness(estimated, CASES.environment, planner())
    assert against_truth.distance > 10 * against_itself.distance


def test_draws_give_the_closed_form_up_to_their_noise():
    for enforcement in (CleanEstimate(), EXACT):
        closed = exactness(planner(enforcement), CASES.environment)
        drawn = sampled_exactness(planner(enforcement), CASES.environment, draws=3000)
        assert drawn.distance == pytest.approx(closed.distance, abs=0.05)
        assert not drawn.exact


def test_a_chain_that_is_not_affine_is_refused():
    with pytest.raises(NotApplicableError, match="a step of the chain is not affine"):
        exactness(planner(DPS()), CASES.environment)


def test_what_selects_among_plans_is_refused_in_a_line():
    with pytest.raises(ConfigError, match="depends on all plans"):
        exactness(planner(Selected()), CASES.environment)


def test_a_trained_denoiser_has_no_law():
    network = MLP(width=8, blocks=1).build(
        LAYOUT, TASK.condition(ROBOT), SCHEDULE, torch_generator(0, "initialisation")
    )
    with pytest.raises(NotApplicableError, match="its law not known"):
        exactness(replace(planner(), denoiser=network), CASES.environment)


def test_the_law_of_the_task_serves_as_well():
    task, system = LQR(horizon=T), double_integrator()
    law, layout = task.law(system), system.layout(T)
    where = physical(layout)
    lqr = Planner(
        task, system, SCHEDULE, DPMSolver(10), GaussianRecipe().exact(law, where, SCHEDULE), where,
        Known("fixed").fit(layout, system=system), CleanEstimate(), True,
    )  # fmt: skip
    cases = task.cases(system, 1, numpy_generator(0, "cases"))
    assert exactness(lqr, cases.environment).network_calls == 10


def test_one_call_of_the_moment_matched_denoiser_is_linear_regression():
    one = replace(planner(Never(), DDIM(1)), behaviour=None)
    tau = one.plan(CASES.environment).tau[0, 0, 0]
    design = np.concatenate([SHOWN.environment, np.ones((len(SHOWN.environment), 1))], axis=-1)
    coefficients = np.linalg.lstsq(design, SHOWN.trajectories, rcond=None)[0]
    np.testing.assert_allclose(tau, np.append(CASES.environment[0, 0], 1) @ coefficients, atol=1e-10)

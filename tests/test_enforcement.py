"""Laws of enforcement: where a projection acts, how often, how strongly, and where it makes the chain diverge."""

from __future__ import annotations

from math import sqrt
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from laws import SYSTEMS, component, presets, tolerance, variants

from dadiff.behaviours import Known, pins
from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.chain import Samples, sample
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.context import Context, Counted, unprojected
from dadiff.diffusion.enforcement import CleanEstimate, Convex, Literally, Never, Normalised, PostHoc, Repeated
from dadiff.diffusion.limiting import Barrier, QPFilter
from dadiff.diffusion.measured import Measured
from dadiff.diffusion.rivals import DPS, MCG, PPR, TMPD, PiGDM, Replacement, RolloutBlend, Selected
from dadiff.diffusion.samplers import DDIM, DDPM, Step
from dadiff.diffusion.schedule import Schedule, cosine, ddpm_linear, paper_linear
from dadiff.randomness import torch_generator
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

HORIZON, PLANS = 5, 4
SYSTEM = SYSTEMS["n=3,m=1"]
LAYOUT = SYSTEM.layout(HORIZON)
ENFORCEMENTS = variants("enforcement", {"acts_on": ("sample", "clean_estimate")})
OWN_NOISE = (Replacement, MCG, PPR)
OFF_THE_SET = (Never, PiGDM, DPS, RolloutBlend, TMPD)  # what comes out may lie anywhere; see test_rivals.py
ABOUT_BOUNDS = (QPFilter, Barrier)  # see test_limiting.py
STABLE = {name: e for name, e in ENFORCEMENTS.items() if not isinstance(e, (Literally, *ABOUT_BOUNDS))}
# How often each calls P in a chain of that many steps and network calls; a new enforcement is a new row.
CALLS = {
    Never(): lambda steps, calls: 0,
    PostHoc(): lambda steps, calls: 1,
    Normalised(): lambda steps, calls: steps,
    Convex(): lambda steps, calls: steps,
    Convex("clean_estimate"): lambda steps, calls: calls,
    CleanEstimate(): lambda steps, calls: calls,
    Literally(): lambda steps, calls: steps,
    Conditional(): lambda steps, calls: calls,
}

every_enforcement = pytest.mark.parametrize("enforcement", ENFORCEMENTS.values(), ids=ENFORCEMENTS.keys())
every_stable = pytest.mark.parametrize("enforcement", STABLE.values(), ids=STABLE.keys())


class Spy:
    """A projection that counts its calls."""

    def __init__(self, project):
        self.project, self.calls = project, 0

    def __call__(self, tau, metric=None, start=None, noise=None):
        self.calls += 1
        return self.project(tau, metric, start, noise)


X_INIT = np.linspace(-1, 1, 2 * SYSTEM.state_dim)[: SYSTEM.state_dim].repeat(PLANS).reshape(-1, PLANS).T


def projection(initial_state="free"):
    known = Known(initial_state)
    return known.fit(LAYOUT, SYSTEM).bind(pins=pins(known, LAYOUT, X_INIT))


LAW = LQR(horizon=HORIZON, state_cost=(1.0,) * 3).law(SYSTEM)
ESTIMATE = Measured(
    LAW.covariance, np.full(LAYOUT.size, 0.02), np.ones(LAYOUT.size), layout=LAYOUT, errors={"1": LAW.covariance}
)


def draw(enforcement, project, sampler=None, schedule: Schedule | None = None, **options) -> Samples:
    schedule = schedule or cosine(40)
    environment = torch.linspace(-1, 1, 2 * SYSTEM.state_dim, dtype=torch.float64).repeat(PLANS, 1)
    return sample(
        sampler or DDPM(last_step_noise=False),
        schedule,
        ExactDenoiser(LAW, physical(LAYOUT), schedule),
        environment,
        (PLANS, LAYOUT.size),
        torch_generator(0, "test"),
        project,
        enforcement,
        estimate=ESTIMATE,
        **options,
    )


def off_the_set(tau: torch.Tensor) -> float:
    return float((tau - projection()(tau)).abs().max())


# --- the chain


@every_enforcement
def test_without_a_projector_plans_are_vanilla_bit_for_bit(enforcement):
    vanilla = draw(None, None).tau
    assert torch.equal(draw(enforcement, None).tau, vanilla)
    assert torch.equal(draw(Never(), projection()).tau, vanilla)


@every_stable
def test_projecting_onto_everything_is_vanilla(enforcement):
    if isinstance(enforcement, OWN_NOISE) or getattr(enforcement, "spread", False):
        pytest.skip("it draws noise of its own")
    if isinstance(enforcement, Selected):
        pytest.skip("it takes one plan for all")
    np.testing.assert_allclose(draw(enforcement, unprojected).tau, draw(None, None).tau, atol=1e-12)


@pytest.mark.parametrize("enforcement", CALLS, ids=str)
@pytest.mark.parametrize("sampler", [component("sampler", name) for name in presets("sampler")], ids=presets("sampler"))
@pytest.mark.parametrize("schedule", [cosine(40), paper_linear(200, 1 / 200)], ids=["cosine", "paper_linear"])
def test_the_projector_is_called_as_often_as_the_enforcement_says(enforcement, sampler, schedule):
    spy = Spy(projection())
    samples = draw(enforcement, spy, sampler, schedule, divergence_bound=np.inf)
    steps = sampler.steps(schedule)
    assert samples.network_calls == sum(step.call for step in steps)
    silent = len(steps) - samples.network_calls
    if silent and enforcement.keeps(schedule, 1) is not None:  # they are drawn as one, with three projections
        silent = 5 if enforcement.keeps(schedule, 1) != 1 else 0  # and two that ask whether that is exact
    assert spy.calls == CALLS[enforcement](silent + samples.network_calls, samples.network_calls)


@every_stable
@pytest.mark.parametrize("initial_state", ["free", "fixed"])
def test_what_comes_out_of_a_stable_enforcement_is_admissible(enforcement, initial_state):
    project = projection(initial_state)
    tau = draw(enforcement, project).tau
    if type(enforcement) in OFF_THE_SET:
        assert torch.isfinite(tau).all()
        return
    assert off_the_set(tau) < 1e-12
    if initial_state == "fixed":
        np.testing.assert_allclose(LAYOUT.states(tau)[:, 0], X_INIT, atol=1e-12)


@pytest.mark.parametrize("enforcement", [CleanEstimate(), Convex("clean_estimate")], ids=str)
def test_the_noise_of_the_last_step_leads_off_the_set_again(enforcement):
    assert off_the_set(draw(enforcement, projection(), DDPM(last_step_noise=True)).tau) > 1e-3
    assert off_the_set(draw(Normalised(), projection(), DDPM(last_step_noise=True)).tau) < 1e-12


# --- the operators


def at_step(schedule: Schedule, j: int, project=None) -> Context:
    """The context of a step that reaches j."""
    tau = torch.zeros(PLANS, LAYOUT.size, dtype=torch.float64)
    step = Step(j + 1, j, 0.5, 0.5, 0.1)
    return Context(step, schedule, tau, tau, project or projection(), Counted(None), lambda: tau)


def gains(enforcement, schedule: Schedule, j: int) -> tuple[float, float]:
    """(on im F, across it) of what acts on the sample or on the clean estimate at step j."""
    P, tau = projection(), torch.randn(LAYOUT.size, dtype=torch.float64, generator=torch_generator(1, "test"))
    within, across, at = P(tau), tau - P(tau), at_step(schedule, j, P)

    def operator(v):
        return enforcement.sample(enforcement.clean(v, at), at)

    on, off = operator(within), operator(across)
    for image, of in ((on, within), (off, across)):  # both are eigenspaces
        np.testing.assert_allclose(image, (image @ of / (of @ of)) * of, atol=tolerance(size=LAYOUT.size) * 10)
    return float(on @ within / (within @ within)), float(off @ across / (across @ across))


@pytest.mark.parametrize("j", [0, 1, 10, 250, 700, 999])
def test_the_gains_are_those_of_the_formulas(j):
    schedule = paper_linear()
    b, a = schedule.beta[j], schedule.alpha_bar[j]
    expected = {
        Never(): (1, 1),
        PostHoc(): (1, 1),
        Normalised(): (1, sqrt(b)),
        Convex(): (1, 1 - a),
        Convex("clean_estimate"): (1, 1 - a),
        CleanEstimate(): (1, 0),
        Literally(): (sqrt(1 - b) + sqrt(b), sqrt(b)),
    }
    assert set(CALLS) == {*expected, Conditional()} <= set(ENFORCEMENTS.values())
    for enforcement, gain in expected.items():
        np.testing.assert_allclose(gains(enforcement, schedule, j), gain, atol=1e-12)


def test_the_literal_gain_is_largest_in_the_middle_and_1_at_the_ends():
    schedule = paper_linear()
    on_image = [gains(Literally(), schedule, j)[0] for j in (0, 500, 1000)]
    np.testing.assert_allclose(on_image, [1, sqrt(2), 1], atol=1e-12)


def test_at_the_last_step_what_acts_on_the_sample_projects_exactly():
    for enforcement in (Normalised(), Convex(), Literally()):
        np.testing.assert_allclose(gains(enforcement, paper_linear(), 0), (1, 0), atol=1e-12)


@pytest.mark.parametrize("schedule", [paper_linear(), ddpm_linear()], ids=["paper_linear", "ddpm_linear"])
def test_the_literal_operator_diverges_and_the_step_is_told(schedule):
    stopped = draw(Literally(), projection(), schedule=schedule, divergence_bound=1e6)
    assert 1 < stopped.diverged_at < schedule.num_steps
    assert stopped.tau.abs().max() > 1e6
    unbounded = draw(Literally(), projection(), schedule=schedule, divergence_bound=np.inf)
    assert unbounded.diverged_at is None  # float range is never left: the plans are just wrong by many orders


def test_the_literal_operator_grows_noise_by_the_product_of_its_gains():
    """Where the clean estimate weighs nothing, a chain without noise is the operator applied again and again."""
    schedule, grown = paper_linear(), []
    on = np.array([sqrt(1 - b) + sqrt(b) for b in schedule.beta])
    assert 1e25 < on[100:].prod() < 1e150
    noise = torch.randn(PLANS, LAYOUT.size, dtype=torch.float64, generator=torch_generator(2, "test"))
    tau = projection()(noise)
    for j in range(900, 880, -1):
        tau = Literally().sample(tau, at_step(schedule, j))
        grown.append(float(tau.norm() / projection()(noise).norm()))
    np.testing.assert_allclose(grown, np.cumprod(on[900:880:-1]), rtol=1e-10)


def test_a_stable_enforcement_never_diverges_where_vanilla_does_not():
    for enforcement in STABLE.values():
        for sampler in (DDPM(), DDIM(20)):
            assert draw(enforcement, projection(), sampler, paper_linear(), divergence_bound=100).diverged_at is None


@pytest.mark.parametrize("times", [1, 2, 5])
def test_plans_are_projected_as_often_as_is_asked_for(times):
    """Each time from what the last time gave."""

    def half(tau, metric=None, start=None, noise=None):
        return (tau if start is None else start) / 2

    assert Repeated(times).end(1.0, SimpleNamespace(project=half)) == 0.5**times

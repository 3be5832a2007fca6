"""What others do about bounds, against their formulas: tightening, clipping, a filter at the end, a barrier."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import cvxpy
import numpy as np
import pytest
import torch
from laws import SYSTEMS, trajectories
from test_conditional import LAYOUT, SCHEDULE, SIZE, WHERE, estimate, law, stages

from dadiff.behaviours import Dynamics, Known, KnownClipped, KnownTightened, Limited, Pin, pins
from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.chain import sample
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.context import Context, Counted
from dadiff.diffusion.limiting import Barrier, QPFilter
from dadiff.diffusion.samplers import DDIM
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems import Bounds
from dadiff.systems.quadrotors import PlanarQuadrotor

PLANS, STEP = 3, DDIM(20).steps(SCHEDULE)[12]
E = torch.tensor([[0.3, -0.7]], dtype=torch.float64).repeat(PLANS, 1)
DENOISE, ESTIMATE = ExactDenoiser(law(), WHERE, SCHEDULE), estimate(law())
BOUNDS = Bounds(-0.6, 0.5, state_high=[0.4, np.inf])


def projection():
    dynamics = Dynamics(LAYOUT, stages())
    return Limited(dynamics, BOUNDS).bind(WHERE, [Pin.initial_state(LAYOUT, np.full((1, 2), 0.2))])


def draws(seed: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((PLANS, SIZE)))


TAU = draws(1)


def context(project) -> Context:
    return Context(STEP, SCHEDULE, TAU, E, project, Counted(DENOISE), lambda: draws(2), ESTIMATE)


def chain(enforcement, project, steps: int = 20) -> np.ndarray:
    generator = torch.Generator().manual_seed(0)
    tau = sample(
        DDIM(steps), SCHEDULE, DENOISE, E, (PLANS, SIZE), generator, project, enforcement, estimate=ESTIMATE
    ).tau
    return WHERE.to_physical(tau.numpy())


@pytest.mark.parametrize("enforcement", [QPFilter(), Barrier()], ids=["filter", "barrier"])
def test_in_the_chain_the_clean_estimate_obeys_the_dynamics_alone(enforcement):
    project = projection()
    expected = Conditional().clean(TAU, context(project.unlimited))
    torch.testing.assert_close(enforcement.clean(TAU, context(project)), expected)


def test_the_filter_is_the_projection_of_the_chain_without_limits():
    project = projection()
    without = chain(Conditional(), project.unlimited)
    expected = WHERE.to_physical(project(WHERE.to_scaled(without)))
    np.testing.assert_allclose(chain(QPFilter(), project), expected, atol=1e-9)
    assert LAYOUT.inputs(without).max() > 0.5 + 1e-3, "bounds matter here"


@pytest.mark.parametrize("tube", [0.0, 0.7])
@pytest.mark.parametrize("rate", [0.3, 1.0])
def test_the_barrier_moves_samples_as_little_as_its_quadratic_program(tube, rate):
    project, barrier = projection(), Barrier(rate=rate, tube=tube)
    found = barrier.sample(draws(3), context(project)).numpy()
    before, after = (tube * sqrt(1 - SCHEDULE.alpha_bar[step]) for step in (STEP.i, STEP.j))
    low, high = project.box
    for tau_i, tau_j, one in zip(TAU.numpy(), draws(3).numpy(), found, strict=True):
        y, rules = cvxpy.Variable(SIZE), []
        for k in range(SIZE):
            both = np.isfinite(low[k]) and np.isfinite(high[k])
            share = (1 - rate) * ((high[k] - low[k] + 2 * after) / (high[k] - low[k] + 2 * before) if both else 1)
            if np.isfinite(high[k]):
                rules.append(high[k] + after - y[k] >= share * (high[k] + before - tau_i[k]))
            if np.isfinite(low[k]):
                rules.append(y[k] - low[k] + after >= share * (tau_i[k] - low[k] + before))
        cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(y - tau_j)), rules).solve(solver="CLARABEL")
        np.testing.assert_allclose(one, y.value, atol=1e-6)


def test_what_is_pinned_between_equal_bounds_is_left_there():
    """Without a tube an interval of no width has 0 / 0 of its width left."""
    project = Limited(Dynamics(LAYOUT, stages()), Bounds(0.3, 0.3)).bind(WHERE)
    found = Barrier(tube=0.0).sample(draws(3), context(project)).numpy()
    np.testing.assert_allclose(LAYOUT.inputs(WHERE.to_physical(found)), 0.3, rtol=1e-12)


def test_a_chain_that_begins_within_the_tube_ends_within_bounds():
    bounded = np.isfinite(projection().box[1])
    inputs, states = LAYOUT.split(chain(Barrier(tube=10.0), projection()))[::-1]
    assert bounded.sum() == 3 + 3  # three inputs, and one state but for its pinned start
    assert inputs.max() <= 0.5 + 1e-12
    assert inputs.min() >= -0.6 - 1e-12
    assert states[:, 1:, 0].max() <= 0.4 + 1e-12


def test_what_is_about_bounds_needs_some():
    dynamics = Dynamics(LAYOUT, stages()).bind(WHERE)
    for enforcement in (QPFilter(), Barrier()):
        with pytest.raises(NotApplicableError, match="use projector=known_bounded"):
            chain(enforcement, dynamics)
    for options in ({"rate": 0.0}, {"rate": 1.5}, {"tube": -1.0}):
        with pytest.raises(ConfigError, match="rate is"):
            Barrier(**options)
    with pytest.raises(ConfigError, match="tightening is 1"):
        KnownTightened(tightening=1.0)


def test_tightened_bounds_are_nearer_to_each_other():
    bounds = Bounds(-1.0, [2.0, 3.0], state_high=4.0).tightened(0.2)
    np.testing.assert_allclose(bounds.input_low, [-0.7, -0.6])
    np.testing.assert_allclose(bounds.input_high, [1.7, 2.6])
    assert (bounds.state_low, bounds.state_high) == (-np.inf, 4.0)
    system = replace(SYSTEMS["paper"], bounds=Bounds(-1.0, 1.0))
    layout, narrow = system.layout(6), replace(system, bounds=Bounds(-0.9, 0.9))
    tau = trajectories(system, 6, 3)[0]
    tightened = KnownTightened().fit(layout, system).bind()(tau)
    np.testing.assert_allclose(tightened, Known(bounds="enforced").fit(layout, narrow).bind()(tau))


@pytest.mark.parametrize("curved", [False, True], ids=["linear", "nonlinear"])
def test_plans_are_clipped_and_replayed(curved, rng):
    bounds = Bounds(-0.3, 0.3, state_high=0.5)
    system = PlanarQuadrotor(bounds=bounds) if curved else replace(SYSTEMS["paper"], bounds=bounds)
    layout, x_init = system.layout(8), np.full((4, system.state_dim), 0.1)
    z = rng.standard_normal((4, layout.size))

    def projected(known) -> np.ndarray:
        return known.fit(layout, system).bind(pins=pins(known, layout, x_init))(z)

    plan = projected(Known("fixed"))
    states, inputs = layout.split(plan)
    np.testing.assert_allclose(
        projected(KnownClipped("fixed")), layout.flatten(states.clip(max=0.5), inputs.clip(-0.3, 0.3))
    )
    replayed = projected(KnownClipped("fixed", replay=True))
    kept = inputs.clip(-0.3, 0.3)
    np.testing.assert_allclose(replayed, layout.flatten(system.simulate(x_init, kept), kept), atol=1e-12)


def test_of_clipped_plans_those_are_missed_whose_states_leave_their_bounds_when_replayed(rng):
    system = replace(SYSTEMS["paper"], bounds=Bounds(-3.0, 3.0, state_high=5.0))
    layout = system.layout(8)
    z = rng.uniform(1, 20, (12, 1)) * rng.standard_normal((12, layout.size))
    P, replayed = (KnownClipped(replay=replay).fit(layout, system).bind() for replay in (False, True))
    assert np.abs(P(z)).max() > 2
    assert P.info.unconverged == 0
    beyond = (layout.states(replayed(z)).max(axis=(-2, -1)) > 5).sum()
    assert 0 < replayed.info.unconverged == beyond < 12

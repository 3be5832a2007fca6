"""Theorem 1, as far as it can be tested: the distance to the law of optimal trajectories along the reverse chain.

The law's covariance is singular, so the theorem's inverse does not exist: the distance is measured on the support, and
the part off it beside it. "Sequentially minimising" is what the projections do and the predictions do not.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
from laws import SYSTEMS

from dadiff.behaviours import Known
from dadiff.denoisers.exact import ExactDenoiser
from dadiff.diffusion.chain import Samples, sample
from dadiff.diffusion.enforcement import Literally, Never, Normalised
from dadiff.diffusion.samplers import DDPM
from dadiff.diffusion.schedule import paper_linear
from dadiff.evaluation.mahalanobis import ClosedLoopDistance, MahalanobisDistance, distance_to
from dadiff.evaluation.records import ChainRecorder
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

SYSTEM, TASK, PLANS = SYSTEMS["paper"], LQR(horizon=12), 8
LAYOUT = SYSTEM.layout(TASK.horizon)


@pytest.fixture
def distance(system):
    """(distance, law, environment) of a few plans of an LQR task."""
    task = LQR(horizon=6, state_cost=(1.0,) * system.state_dim)
    environment = task.sample_environments(system, (500,), numpy_generator(0, "test"))
    law = task.law(system)
    return MahalanobisDistance.of(law, environment), law, environment


def test_the_mean_is_at_distance_0(distance):
    measure, law, environment = distance
    on, off = measure(environment @ law.mean_map.T)
    np.testing.assert_allclose(on, 0, atol=1e-15)
    np.testing.assert_allclose(off, 0, atol=1e-20)


def test_the_distance_is_the_quadratic_form_of_the_pseudo_inverse(distance, rng):
    measure, law, environment = distance
    deviation = rng.standard_normal((len(environment), len(law.mean_map)))
    on, off = measure(environment @ law.mean_map.T + deviation)
    inverse = np.linalg.pinv(law.covariance, rcond=1e-12, hermitian=True)
    np.testing.assert_allclose(on, np.einsum("ki,ij,kj->k", deviation, inverse, deviation), rtol=1e-6)
    outside = deviation - deviation @ law.covariance @ inverse
    np.testing.assert_allclose(off, np.square(outside).sum(-1), rtol=1e-6)


def test_draws_of_the_law_lie_on_its_support_at_a_chi_square_distance(distance, rng):
    measure, law, environment = distance
    noise = rng.standard_normal((len(environment), law.noise_map.shape[-1]))
    on, off = measure(environment @ law.mean_map.T + noise @ law.noise_map.T)
    freedom = measure.support.shape[-1]
    assert freedom == law.noise_map.shape[-1]
    np.testing.assert_allclose(on.mean(), freedom, atol=5 * np.sqrt(2 * freedom / len(on)))
    np.testing.assert_allclose(off, 0, atol=1e-20)


def test_the_distance_along_time_is_the_dense_one(monkeypatch, system, rng):
    task = LQR(horizon=6, state_cost=(1.0,) * system.state_dim)
    environment = task.sample_environments(system, (20,), rng)
    law = task.law(system)
    dense = distance_to(law, environment)
    monkeypatch.setattr("dadiff.experts.lqr.DENSE_UP_TO", 10)
    recursive = distance_to(law, environment)
    assert (type(dense), type(recursive)) == (MahalanobisDistance, ClosedLoopDistance)
    tau = law.mean(environment) + rng.standard_normal((20, len(law.mean_map)))
    for one, other in zip(dense(tau), recursive(tau), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


@cache
def chain(enforcement) -> tuple[Samples, pd.DataFrame]:
    cases = TASK.cases(SYSTEM, PLANS, numpy_generator(0, "test"))
    law, schedule = TASK.law(SYSTEM), paper_linear()
    measure = MahalanobisDistance.of(law, cases.environment)
    recorder = ChainRecorder(measure, np.arange(PLANS), physical(LAYOUT).to_physical)
    samples = sample(
        DDPM(last_step_noise=False),
        schedule,
        ExactDenoiser(law, physical(LAYOUT), schedule),
        torch.as_tensor(cases.environment),
        (PLANS, LAYOUT.size),
        torch_generator(0, "test"),
        Known().fit(LAYOUT, SYSTEM).bind(),
        enforcement,
        recorder,
    )
    return samples, recorder.table()


def share_that_grew(table: pd.DataFrame, stage: str) -> float:
    return float(table[table.stage == stage].grew.mean())


def test_the_chain_is_recorded_half_step_by_half_step():
    _, table = chain(Normalised())
    growth = ["growth", "growth_error", "step_growth", "step_growth_error"]
    assert list(table.columns) == ["i", "stage", "on_support", "off_support", "grew", *growth]
    first = next(step.i for step in DDPM().steps(paper_linear()) if step.call)
    assert list(table.i) == [first, *(j for j in range(first - 1, -1, -1) for _ in range(2))]
    assert list(table.stage) == ["project", *["predict", "project"] * first]
    assert table.grew.isna().sum() == 1  # the first has nothing before it
    distance = table.on_support.to_numpy()
    np.testing.assert_allclose(table.growth[1:], np.diff(distance), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(table.step_growth[2::2], distance[2::2] - distance[:-2:2], rtol=1e-6, atol=1e-6)
    assert (table.growth_error[1:] >= 0).all()


def test_projections_bring_plans_nearer_to_the_law_and_predictions_do_not_always():
    _, table = chain(Normalised())
    assert share_that_grew(table, "project") < 0.01
    assert share_that_grew(table, "predict") > 0.5


def test_without_projection_the_second_half_step_does_nothing():
    _, table = chain(Never())
    assert (table.on_support[1::2].to_numpy() == table.on_support[2::2].to_numpy()).all()
    assert share_that_grew(table, "project") == 0


def test_the_projected_chain_ends_nearer_on_the_support():
    (_, projected), (_, vanilla) = chain(Normalised()), chain(Never())
    assert projected.on_support.iloc[-1] < vanilla.on_support.iloc[-1] < 1e-3 * vanilla.on_support.iloc[0]


def test_projecting_leads_off_the_support_since_noisy_trajectories_are_not_in_the_image():
    (_, projected), (_, vanilla) = chain(Normalised()), chain(Never())
    assert vanilla.off_support.iloc[-1] < 1e-20
    assert 1e-6 < projected.off_support.iloc[-1] < 0.1


def test_the_literal_operator_leads_away_from_the_law():
    samples, table = chain(Literally())
    assert samples.diverged_at is not None
    assert table.i.iloc[-1] == samples.diverged_at - 1
    assert table.on_support.iloc[-1] > 1e6 * table.on_support.iloc[0]

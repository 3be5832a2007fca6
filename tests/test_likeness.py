"""Plans against fresh runs of the expert: what draws of the same law score, and what the mean scores."""

from __future__ import annotations

import numpy as np
import pytest

from dadiff.evaluation.likeness import energy_distance, likeness
from dadiff.systems import DampedIntegrators, double_integrator
from dadiff.tasks import LQR, Fleet
from dadiff.trajectory.response import along

TASK, SYSTEM = LQR(horizon=6), double_integrator(process_noise=0.05)
LAYOUT, LAW = SYSTEM.layout(6), TASK.law(SYSTEM)
CASES = TASK.cases(SYSTEM, 40, np.random.default_rng(0))


def draws(samples: int, size: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(1)
    mean = LAW.mean(CASES.environment)[:, None]
    return mean + size * rng.standard_normal((40, samples, LAW.noise_map.shape[-1])) @ LAW.noise_map.T


def scores(planned: np.ndarray) -> dict[str, float]:
    found = likeness(LAYOUT, planned, LAW, CASES.environment, np.random.default_rng(2))
    return {name: float(np.nanmean(values)) for name, values in {**found.per_plan, **found.per_step}.items()}


def test_draws_of_the_experts_law_are_like_its_runs():
    found = scores(draws(10))
    assert found["energy_distance"] == pytest.approx(0, abs=0.01)
    assert found["coverage"] == pytest.approx(1, abs=0.04)
    assert found["state_spread_ratio"] == pytest.approx(1, abs=0.1)


def test_plans_that_are_always_the_mean_have_no_error_and_are_not():
    found, usual = scores(draws(10, 0.0)), scores(draws(10))
    assert found["energy_distance"] > 0.05 > usual["energy_distance"]
    assert found["coverage"] < 0.2 + 1 / 7  # at t = 0 all are the same
    assert found["state_spread_ratio"] == pytest.approx(0, abs=1e-9)


def test_the_energy_distance_is_that_of_its_definition():
    rng = np.random.default_rng(3)
    X, Y = rng.standard_normal((2, 4, 3)), rng.standard_normal((2, 5, 3)) + 1

    def mean_distance(A: np.ndarray, B: np.ndarray, *, same: bool) -> float:
        found = [np.linalg.norm(a - b) for i, a in enumerate(A) for j, b in enumerate(B) if not (same and i == j)]
        return float(np.mean(found))

    for k in range(2):
        expected = 2 * mean_distance(X[k], Y[k], same=False) - sum(mean_distance(Z, Z, same=True) for Z in (X[k], Y[k]))
        assert energy_distance(X, Y)[k] == pytest.approx(expected, rel=1e-9)


def test_robots_have_laws_of_their_own():
    task = Fleet(horizon=4, robots=3, interpolation=2, extrapolation=1)
    robots = task.target(DampedIntegrators())
    cases = task.cases(robots, 2, np.random.default_rng(0))
    law, told = task.of_runs(robots, cases.environment)
    eps = np.random.default_rng(1).standard_normal((*robots.robots, 2, 3, law.noise_map.shape[-1]))
    planned = law.mean(told)[..., None, :] + along(law.noise_map, eps)
    found = likeness(robots.layout(4), planned, law, told, np.random.default_rng(2))
    assert found.per_plan["energy_distance"].shape == (3, 2, 3)
    assert found.per_step["coverage"].shape == found.per_step["state_spread_ratio"].shape == (3, 2, 3, 5)


def test_one_plan_a_case_says_nothing_of_it():
    assert likeness(LAYOUT, draws(1), LAW, CASES.environment, np.random.default_rng(2)).per_plan == {}

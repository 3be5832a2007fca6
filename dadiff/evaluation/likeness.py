"""Do plans look like fresh runs of the expert? Scores that a planner cannot have by always drawing the mean.

An error against the noise-free reference is least for plans without any spread. Where the law of the expert's runs is
known, plans of a case are held against runs that no network has seen, drawn from it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dadiff.tasks import Scores
from dadiff.trajectory.layout import TrajectoryLayout

RUNS = 64
"""Fresh runs of the expert for each case."""


class Law(Protocol):
    """tau | E ~ N(mean(E), noise_map noise_map'), noise_map (*robots, d, k)."""

    @property
    def noise_map(self) -> np.ndarray: ...

    def mean(self, environment: np.ndarray) -> np.ndarray: ...


def likeness(
    layout: TrajectoryLayout, planned: np.ndarray, law: Law, environment: np.ndarray, rng: np.random.Generator
) -> Scores:
    """Energy distance, coverage and spread of a case's plans, against RUNS fresh runs of the expert.

    `energy_distance` is 2 E|X - Y| - E|X - X'| - E|Y - Y'| of plans X and runs Y (Székely & Rizzo 2013), without bias,
    so that it may be below 0. Along time, `coverage` is the share of the expert's states within the range of the plans,
    entry by entry, over (S - 1) / (S + 1), that of S plans of the same law; `state_spread_ratio` the plans' squared
    distance from their mean over its mean under that law, nan where the law does not spread. One plan a case has none.

    Args:
        planned: (*robots, cases, samples, d).
        environment: E, (*robots, cases, c).
    """
    if planned.shape[-2] < 2:
        return Scores()
    mean, robots = law.mean(environment), planned.shape[:-3]
    found: dict[str, list[np.ndarray]] = {"energy_distance": [], "coverage": [], "state_spread_ratio": []}
    for robot in np.ndindex(robots):
        noise_map = law.noise_map[robot]
        eps = rng.standard_normal((len(mean[robot]), RUNS, noise_map.shape[-1]))
        runs = mean[robot][:, None] + eps @ noise_map.T
        found["energy_distance"].append(energy_distance(planned[robot], runs))
        found["coverage"].append(_coverage(layout, planned[robot], runs))
        found["state_spread_ratio"].append(_spread_ratio(layout, planned[robot], noise_map))
    joined = {name: np.stack(values).reshape(*robots, *values[0].shape) for name, values in found.items()}
    per_step = {"coverage": _each(joined["coverage"], planned), "state_spread_ratio": joined["state_spread_ratio"]}
    return Scores(per_plan={"energy_distance": _each(joined["energy_distance"], planned)}, per_step=per_step)


def _each(values: np.ndarray, planned: np.ndarray) -> np.ndarray:
    """What is said of a case, once for each of its plans."""
    samples, lead = planned.shape[-2], planned.ndim - 2
    return np.repeat(np.expand_dims(values, lead), samples, axis=lead)


def energy_distance(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    """Of draws X (..., N, d) and Y (..., M, d), without bias: (...)."""
    apart = _distances(X, Y).mean(axis=(-2, -1))
    within = [_distances(Z, Z).sum(axis=(-2, -1)) / (Z.shape[-2] * (Z.shape[-2] - 1)) for Z in (X, Y)]
    return 2 * apart - within[0] - within[1]


def _distances(X: np.ndarray, Y: np.ndarray) -> np.ndarray:
    centre = Y.mean(axis=-2, keepdims=True)  # differences of what is close would cancel
    X, Y = X - centre, Y - centre
    squares = np.square(X).sum(axis=-1)[..., :, None] + np.square(Y).sum(axis=-1)[..., None, :]
    return np.sqrt(np.maximum(squares - 2 * X @ Y.swapaxes(-1, -2), 0))


def _coverage(layout: TrajectoryLayout, planned: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """(cases, T+1)."""
    x, seen, samples = layout.states(planned), layout.states(runs), planned.shape[-2]
    low, high = (edge(x, axis=-3, keepdims=True) for edge in (np.min, np.max))
    within = ((seen >= low) & (seen <= high)).mean(axis=(-3, -1))
    return within * (samples + 1) / (samples - 1)


def _spread_ratio(layout: TrajectoryLayout, planned: np.ndarray, noise_map: np.ndarray) -> np.ndarray:
    """(cases, samples, T+1)."""
    x, samples = layout.states(planned), planned.shape[-2]
    away = np.square(x - x.mean(axis=-3, keepdims=True)).sum(axis=-1) * samples / (samples - 1)
    usual = layout.states(np.square(noise_map).sum(axis=-1)).sum(axis=-1)
    return np.divide(away, usual, out=np.full_like(away, np.nan), where=usual > 0)

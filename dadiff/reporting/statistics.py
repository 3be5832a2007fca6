"""Intervals and bands by a hierarchical bootstrap: pure functions of float64 arrays.

An array of results has its levels of replication first, the outermost leading: (seeds, robots, cases).
A resample draws seeds with replacement, then robots within each drawn seed, then cases within each drawn
robot. The plans of one case are averaged before: their scatter is part of the case's mean, and drawing
them once more would count it twice. A level of size 1 contributes no variation, so with one training
seed the intervals cover robots and cases only.

A resample is kept as the weights that it gives to the entries, (resamples, *levels). Means are then one
matrix product, and whatever is computed with the same weights is paired.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dadiff.errors import ShapeError

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value with the interval that covers it with probability `CONFIDENCE`."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Band:
    """A curve with bounds that hold at all its points at once; each array is (points,)."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def bootstrap_weights(levels: tuple[int, ...], resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Weights (resamples, *levels) of nested draws with replacement; those of a resample sum to 1.

    Args:
        levels: sizes, outermost first, for example (seeds, robots, cases).

    Raises:
        ShapeError: if a level is empty.
    """
    if not levels or min(levels) < 1:
        raise ShapeError(f"bootstrap: levels are {levels}; each must hold at least one entry")
    drawn = np.zeros((resamples, 1), dtype=np.int64)
    for size in levels:
        inner = rng.integers(size, size=(resamples, drawn.shape[1], size))
        drawn = (drawn[:, :, None] * size + inner).reshape(resamples, -1)
    entries = int(np.prod(levels))
    cells = drawn + entries * np.arange(resamples)[:, None]
    return np.bincount(cells.ravel(), minlength=resamples * entries).reshape(resamples, *levels) / entries


def _check(values: np.ndarray, weights: np.ndarray) -> None:
    levels = weights.shape[1:]
    if values.shape[: len(levels)] != levels:
        raise ShapeError(f"bootstrap: values have shape {values.shape}; the weights are for {levels} on its left")


def resampled_means(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means (resamples, *rest) of values (*levels, *rest); nan entries are undefined there and carry no weight."""
    _check(values, weights)
    levels, defined = weights.ndim - 1, ~np.isnan(values)
    if defined.all():
        return np.tensordot(weights, values, axes=levels)
    with np.errstate(divide="ignore", invalid="ignore"):
        kept = np.where(defined, values, 0)
        return np.tensordot(weights, kept, axes=levels) / np.tensordot(weights, defined, axes=levels)


def plain_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean (*rest) itself, over the same levels."""
    equal = np.full_like(weights[:1], 1 / weights[0].size)
    return resampled_means(values, equal)[0]


def interval(resampled: np.ndarray) -> tuple[float, float]:
    """Percentile interval of (resamples,), leaving out resamples that drew nothing defined; nan if all did."""
    tail = (1 - CONFIDENCE) / 2
    resampled = resampled[~np.isnan(resampled)]
    if not resampled.size:
        return float("nan"), float("nan")
    low, high = np.quantile(resampled, [tail, 1 - tail])
    return float(low), float(high)


def mean(values: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of values (*levels,)."""
    return Estimate(float(plain_mean(values, weights)), *interval(resampled_means(values, weights)))


def interquartile_mean(values: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of the middle half of values (*levels,), entries weighted equally (Agarwal et al. 2021); nan if all are."""
    _check(values, weights)
    defined = ~np.isnan(values.ravel())
    if not defined.any():
        return Estimate(*[float("nan")] * 3)
    ordered, weights = values.ravel()[defined], weights.reshape(len(weights), -1)[:, defined]
    order = np.argsort(ordered, kind="stable")
    equal = np.full((1, ordered.size), 1 / ordered.size)
    with np.errstate(invalid="ignore"):
        weights = weights[:, order] / weights.sum(axis=1, keepdims=True)
    return Estimate(float(_middle_half(ordered[order], equal)[0]), *interval(_middle_half(ordered[order], weights)))


def _middle_half(ordered: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted mean of what lies between the quartiles; `ordered` ascends."""
    cumulated = np.clip(np.cumsum(weights, axis=1), 0.25, 0.75)
    kept = np.diff(cumulated, axis=1, prepend=0.25)
    return 2 * kept @ ordered


def difference(values: np.ndarray, baseline: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of the paired difference values - baseline, both (*levels,) on the same cases and noise."""
    return mean(values - baseline, weights)


def ratio(values: np.ndarray, baseline: np.ndarray, weights: np.ndarray) -> Estimate:
    """Ratio of means, values over baseline, both (*levels,) and resampled together; nan where the baseline is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = resampled_means(values, weights) / resampled_means(baseline, weights)
        point = plain_mean(values, weights) / plain_mean(baseline, weights)
    return Estimate(float(point), *interval(resampled))


def simultaneous_band(values: np.ndarray, weights: np.ndarray, *, log: bool = False) -> Band:
    """Band of the mean of values (*levels, points) that covers the whole curve with probability `CONFIDENCE`.

    With s(t) the bootstrap's standard deviation, the band is mean(t) -+ q s(t), where q is the quantile of
    max_t |resampled mean(t) - mean(t)| / s(t): one statement for all t, not one a point.

    Args:
        log: build the band for the logarithm of the mean, so that it stays positive; points at 0 get no width.
            Points that are nan for every entry stay nan.
    """
    resampled = resampled_means(values, weights)
    point = plain_mean(values, weights)
    if not log:
        return Band(point, *_sup_t(resampled, point))
    positive = (point > 0) & (resampled > 0).all(axis=0)
    low, high = point.copy(), point.copy()
    low[positive], high[positive] = np.exp(_sup_t(np.log(resampled[:, positive]), np.log(point[positive])))
    return Band(point, low, high)


def _sup_t(resampled: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    spread = resampled.std(axis=0)
    moving = spread > 0  # False where nan, too
    if not moving.any():
        return point.copy(), point.copy()
    deviation = np.abs(resampled[:, moving] - point[moving]) / spread[moving]
    quantile = np.quantile(deviation.max(axis=1), CONFIDENCE)
    return point - quantile * spread, point + quantile * spread

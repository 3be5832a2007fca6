"""Intervals and bands by a bootstrap over the levels of replication: pure functions of float64 arrays.

An array of results has its levels first, the outermost leading: (seeds, robots, cases). All seeds and robots are tried
on the same cases, so the levels are crossed: a resample draws seeds, robots and cases with replacement, each level by
itself, and an entry weighs the product of its levels' shares (Owen 2007). Drawing the cases anew within each seed would
take shared cases for fresh ones. The plans of one case are averaged before: their scatter is part of the case's mean,
and drawing them once more would count it twice. A level of size 1 contributes no variation, so with one training seed
the intervals cover robots and cases only; with a few, the bootstrap's deviations are widened as Student's t asks.

A resample is kept as the weights that it gives to the entries, (resamples, *levels). Means are then one
matrix product, and whatever is computed with the same weights is paired.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

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
    """Weights (resamples, *levels) of crossed draws with replacement; those of a resample sum to 1.

    The innermost level is drawn first, so that arrays on the same cases are paired whatever their outer levels.

    Args:
        levels: sizes, outermost first, for example (seeds, robots, cases).

    Raises:
        ShapeError: if a level is empty.
    """
    if not levels or min(levels) < 1:
        raise ShapeError(f"bootstrap: levels are {levels}; each must hold at least one entry")
    weights = np.ones((resamples, *[1] * len(levels)))
    for axis, size in reversed(list(enumerate(levels, start=1))):
        share = rng.multinomial(size, np.full(size, 1 / size), size=resamples) / size
        weights = weights * np.expand_dims(share, tuple(set(range(1, len(levels) + 1)) - {axis}))
    return weights


def widening(weights: np.ndarray) -> float:
    """t_{s-1} / z sqrt(s / (s-1)) at the interval's end: what a bootstrap of s replicates lacks.

    The outermost level with more than one entry is the unit of replication: s is its size.
    """
    s = next((size for size in weights.shape[1:] if size > 1), 0)
    end = (1 + CONFIDENCE) / 2
    return float(stdtrit(s - 1, end) / ndtri(end) * np.sqrt(s / (s - 1))) if s else 1.0


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


def interval(resampled: np.ndarray, point: float, weights: np.ndarray, *, log: bool = False) -> tuple[float, float]:
    """Percentile interval of (resamples,) about a point, widened for few replicates.

    Resamples that drew nothing defined are left out. nan if all did, and where a single entry leaves nothing to draw.

    Args:
        log: widen by ratios, so that the bounds of what is positive stay positive.
    """
    tail = (1 - CONFIDENCE) / 2
    resampled = resampled[~np.isnan(resampled)]
    if not resampled.size or weights[0].size == 1:
        return float("nan"), float("nan")
    low, high = np.quantile(resampled, [tail, 1 - tail])
    low, high, by = min(low, point), max(high, point), widening(weights)
    if log and low > 0:
        return float(point * (low / point) ** by), float(point * (high / point) ** by)
    return float(point - by * (point - low)), float(point + by * (high - point))


def mean(values: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of values (*levels,)."""
    point, log = float(plain_mean(values, weights)), not (values < 0).any()
    return Estimate(point, *interval(resampled_means(values, weights), point, weights, log=log))


def interquartile_mean(values: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of the middle half of values (*levels,), entries weighted equally (Agarwal et al. 2021); nan if all are."""
    _check(values, weights)
    entries, defined = values.ravel(), ~np.isnan(values.ravel())
    if not defined.any():
        return Estimate(*[float("nan")] * 3)
    ordered, drawn = entries[defined], weights.reshape(len(weights), -1)[:, defined]
    order = np.argsort(ordered, kind="stable")
    equal = np.full((1, ordered.size), 1 / ordered.size)
    with np.errstate(invalid="ignore"):
        drawn = drawn[:, order] / drawn.sum(axis=1, keepdims=True)
    point, log = float(_middle_half(ordered[order], equal)[0]), not (ordered < 0).any()
    return Estimate(point, *interval(_middle_half(ordered[order], drawn), point, weights, log=log))


def _middle_half(ordered: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted mean of what lies between the quartiles; `ordered` ascends."""
    cumulated = np.clip(np.cumsum(weights, axis=1), 0.25, 0.75)
    kept = np.diff(cumulated, axis=1, prepend=0.25)
    return 2 * kept @ ordered


def difference(values: np.ndarray, baseline: np.ndarray, weights: np.ndarray) -> Estimate:
    """Mean of the paired difference values - baseline, both (*levels,) on the same cases and noise."""
    apart = values - baseline
    point = float(plain_mean(apart, weights))
    return Estimate(point, *interval(resampled_means(apart, weights), point, weights))


def ratio(values: np.ndarray, baseline: np.ndarray, weights: np.ndarray) -> Estimate:
    """Ratio of means, values over baseline, both (*levels,) and resampled together; nan where the baseline is 0.

    Entries that are undefined in one of the two count in neither.
    """
    undefined = np.isnan(values) | np.isnan(baseline)
    values, baseline = (np.where(undefined, np.nan, part) for part in (values, baseline))
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = resampled_means(values, weights) / resampled_means(baseline, weights)
        point = float(plain_mean(values, weights) / plain_mean(baseline, weights))
    return Estimate(point, *interval(resampled, point, weights, log=True))


def simultaneous_band(values: np.ndarray, weights: np.ndarray, *, log: bool = False) -> Band:
    """Band of the mean of values (*levels, points) that covers the whole curve with probability `CONFIDENCE`.

    With s(t) the bootstrap's standard deviation, the band is mean(t) -+ q s(t), where q is the quantile of
    max_t |resampled mean(t) - mean(t)| / s(t): one statement for all t, not one a point. It is widened for few
    replicates, and nan where a single entry leaves nothing to draw.

    Args:
        log: build the band for the logarithm of the mean, so that it stays positive; points at 0 get no width.
            Points that are nan for every entry stay nan.
    """
    resampled, by = resampled_means(values, weights), widening(weights)
    point = plain_mean(values, weights)
    if weights[0].size == 1:
        return Band(point, *np.full((2, *point.shape), np.nan))
    if not log:
        return Band(point, *_sup_t(resampled, point, by))
    positive = (point > 0) & (resampled > 0).all(axis=0)
    low, high = point.copy(), point.copy()
    low[positive], high[positive] = np.exp(_sup_t(np.log(resampled[:, positive]), np.log(point[positive]), by))
    return Band(point, low, high)


def _sup_t(resampled: np.ndarray, point: np.ndarray, by: float) -> tuple[np.ndarray, np.ndarray]:
    spread = resampled.std(axis=0)
    moving = spread > 0  # False where nan, too
    if not moving.any():
        return point.copy(), point.copy()
    deviation = np.abs(resampled[:, moving] - point[moving]) / spread[moving]
    quantile = by * np.quantile(deviation.max(axis=1), CONFIDENCE)
    return point - quantile * spread, point + quantile * spread

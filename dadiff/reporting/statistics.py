"""Intervals and bands for few seeds, from a crossed analysis of variance: pure functions of one array with axes named.

An array of results has an axis for each thing that was drawn: training seed, recording, robot, case. All are tried with
all, so they are crossed random factors, and the variance of the mean is the sum of what each factor, and each group of
factors together, adds to it. With the mean squares `MS_U` of a group U of factors and N entries,

    N var(mean) = sum over U of (-1)^(|U|+1) E MS_U

so for seeds and cases MS_s + MS_c - MS_sc (Cornfield & Tukey 1956; Searle, Casella & McCulloch 1992, chapter 4). Its
degrees of freedom are Satterthwaite's (1946), (sum of terms)^2 / sum of term^2 / df. The difference of few mean squares
can come out small or negative by chance; the largest main effect is a lower bound. In simulations with 1, 3, 5 and 10
seeds and any ratio of seed to case variance the intervals cover 0.92 to 0.97, with two seeds 0.88 at worst
(tests/test_statistics.py). A factor of size 1 adds nothing: with one training seed an interval covers the others only.

Where the cases of each run are new ones they are nested in it, and the runs' means hold all variation.

What is positive is judged on a logarithmic scale: a run's value is the mean over its robots and cases, and the runs'
logarithms are averaged, which gives geometric means and ratios of geometric means, the same whichever is divided by
which. Within a run the logarithm of the mean is linear in the entries to first order (the delta method), so that all
factors enter one analysis.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, stdtrit

from dadiff.errors import ShapeError

CONFIDENCE = 0.95
UNITS = ("robot", "case")
"""Levels within a run; all others are levels of runs."""

MULTIPLIERS = 2000
"""Random draws that find the width of a simultaneous band."""


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


@dataclass(frozen=True)
class Draws:
    """Results with their leading axes named by what was drawn.

    Args:
        values: (*levels, *points); nan where a unit has no such value.
        levels: names of the leading axes, those of `UNITS` last, for example ("training seed", "robot", "case").
        nested: whether each run has robots and cases of its own.
    """

    values: np.ndarray
    levels: tuple[str, ...]
    nested: bool = False

    def __post_init__(self) -> None:
        if self.values.ndim < len(self.levels) or 0 in self.sizes:
            raise ShapeError(f"draws: an array of shape {self.values.shape} for the levels {', '.join(self.levels)}")
        if any(a in UNITS and b not in UNITS for a, b in itertools.pairwise(self.levels)):
            raise ShapeError(f"draws: levels are {', '.join(self.levels)}; expected {' and '.join(UNITS)} last")

    @property
    def units(self) -> tuple[int, ...]:
        """Axes of robots and cases."""
        return tuple(axis for axis, level in enumerate(self.levels) if level in UNITS)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the levels."""
        return self.values.shape[: len(self.levels)]

    @property
    def count(self) -> int:
        """Number of runs."""
        return math.prod(size for size, level in zip(self.sizes, self.levels, strict=True) if level not in UNITS)

    def runs(self) -> np.ndarray:
        """The mean over robots and cases of each run, (*runs, *points)."""
        return self._run_means().squeeze(self.units)

    def _run_means(self) -> np.ndarray:
        defined = ~np.isnan(self.values)
        with np.errstate(invalid="ignore"):
            kept = np.where(defined, self.values, 0).sum(axis=self.units, keepdims=True)
            return kept / defined.sum(axis=self.units, keepdims=True)

    def linear(self) -> Draws:
        """Values whose plain mean is the mean of the runs' means, units that are undefined weighing nothing."""
        defined, mean = ~np.isnan(self.values), self._run_means()
        with np.errstate(invalid="ignore", divide="ignore"):
            share = defined.mean(axis=self.units, keepdims=True)
            return replace(self, values=mean + np.where(defined, (self.values - mean) / share, 0))

    def logarithmic(self) -> Draws:
        """Values whose plain mean is the mean of the logarithms of the runs' means, to first order in the units."""
        mean = self._run_means()
        with np.errstate(invalid="ignore", divide="ignore"):
            return replace(self, values=np.log(mean) + (self.linear().values - mean) / mean)

    def above(self, floor: float) -> bool:
        """Whether every run's mean is above a floor and no entry below it."""
        return bool((self.runs() > floor).all() and (np.nan_to_num(self.values, nan=floor) >= floor).all())

    def less(self, floor: float) -> Draws:
        """All values less a number."""
        return replace(self, values=self.values - floor) if floor else self

    def times(self, factor: float) -> Draws:
        """All values times a number."""
        return replace(self, values=self.values * factor)

    def __sub__(self, other: Draws) -> Draws:
        """The paired difference; a level that one side lacks is the same for all of the other's entries."""
        levels = sorted(dict.fromkeys(self.levels + other.levels), key=UNITS.__contains__)
        pair = (draws._spread(levels) for draws in (self, other))
        return Draws(np.subtract(*pair), tuple(levels), self.nested or other.nested)

    def over_units(self) -> Draws:
        """The runs alone."""
        levels = tuple(level for level in self.levels if level not in UNITS)
        return replace(self, values=self.runs(), levels=levels)

    def _spread(self, levels: list[str]) -> np.ndarray:
        missing = tuple(axis for axis, level in enumerate(levels) if level not in self.levels)
        order = [self.levels.index(level) for level in levels if level in self.levels]
        rest = range(len(self.levels), self.values.ndim)
        return np.expand_dims(self.values.transpose(*order, *rest), missing)


@dataclass(frozen=True)
class Deviation:
    """The standard deviation of a mean, and its degrees of freedom; (*points,) each."""

    size: np.ndarray
    freedom: np.ndarray

    def interval(self, tail: float | np.ndarray) -> np.ndarray:
        """Half the width of the interval that leaves `tail` outside on each side; nan without freedom."""
        moving = self.size > 0
        with np.errstate(invalid="ignore"):
            return np.where(moving, stdtrit(np.where(moving, self.freedom, 1), 1 - tail) * self.size, self.size)


def _flat(draws: Draws) -> Draws:
    """Units that are nested in several runs are averaged: their scatter is in the runs' means."""
    return draws.over_units() if draws.nested and draws.count > 1 else draws


def _effects(values: np.ndarray, levels: int) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """Each group of factors with its effects: means over all other factors, less all smaller groups' effects."""
    factors = [axis for axis in range(levels) if values.shape[axis] > 1]
    for group in itertools.chain.from_iterable(itertools.combinations(factors, k + 1) for k in range(len(factors))):
        effect = values
        for axis in range(levels):
            mean = effect.mean(axis=axis, keepdims=True)
            effect = effect - mean if axis in group else mean
        yield group, effect


def deviation(draws: Draws) -> Deviation:
    """Of the plain mean of values (*levels, *points), from the crossed analysis of variance.

    Returns:
        size nan where nothing was drawn twice.
    """
    draws = _flat(draws)
    values, levels = draws.values, len(draws.levels)
    signed = squares = largest = np.zeros(values.shape[levels:])
    for group, effect in _effects(values, levels):
        sizes = np.array([values.shape[axis] for axis in group])
        term = (effect**2).sum(axis=tuple(range(levels))) / np.prod(sizes * (sizes - 1.0))
        signed = signed - (-1) ** len(group) * term
        squares = squares + term**2 / np.prod(sizes - 1.0)
        largest = np.maximum(largest, term) if len(group) == 1 else largest
    if max(draws.sizes) == 1:
        return Deviation(np.full_like(signed, np.nan), np.full_like(signed, np.nan))
    variance = np.maximum(signed, largest)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Deviation(np.sqrt(variance), variance**2 / squares)


def _plain(draws: Draws) -> np.ndarray:
    return draws.values.mean(axis=tuple(range(len(draws.levels))))


def _around(draws: Draws) -> Estimate:
    """Mean of a scalar with its interval."""
    point, half = float(_plain(draws)), float(deviation(draws).interval((1 - CONFIDENCE) / 2))
    return Estimate(point, point - half, point + half)


def _exponential(estimate: Estimate) -> Estimate:
    return Estimate(*(math.exp(min(x, 700)) for x in (estimate.value, estimate.low, estimate.high)))


def mean(draws: Draws, floor: float = 0.0) -> Estimate:
    """The mean over all that was drawn, (*levels,): geometric over runs where all are above the floor.

    Args:
        floor: what values cannot go below; the logarithm is of what lies above it. 1 for a cost over the optimal cost.
    """
    if not draws.above(floor):
        return _around(draws.linear())
    above = _exponential(_around(draws.less(floor).logarithmic()))
    return Estimate(floor + above.value, floor + above.low, floor + above.high)


def difference(draws: Draws, baseline: Draws) -> Estimate:
    """Mean of the paired difference draws - baseline, both on the same cases and noise."""
    return _around(draws.linear() - baseline.linear())


def ratio(draws: Draws, baseline: Draws, floor: float = 0.0) -> Estimate:
    """Ratio of means, less a floor, paired; geometric over runs. Entries that one side lacks count in neither.

    Where a run's mean is not positive the runs are averaged as they are (Fieller's linearised ratio); nan over 0.
    """
    draws, baseline = _both(draws.less(floor), baseline.less(floor))
    if (draws.runs() > 0).all() and (baseline.runs() > 0).all():
        return _exponential(_around(draws.logarithmic() - baseline.logarithmic()))
    above, below = (float(_plain(part.linear())) for part in (draws, baseline))
    if not below:
        return Estimate(math.nan, math.nan, math.nan)
    off = _around(draws.linear().times(1 / below) - baseline.linear().times(above / below**2))
    return Estimate(*(above / below + x for x in (off.value, off.low, off.high)))


def _both(draws: Draws, baseline: Draws) -> tuple[Draws, Draws]:
    """Undefined in both where it is in one, if their shapes allow a comparison entry by entry."""
    if draws.values.shape != baseline.values.shape:
        return draws, baseline
    undefined = np.isnan(draws.values) | np.isnan(baseline.values)
    first, second = (replace(part, values=np.where(undefined, np.nan, part.values)) for part in (draws, baseline))
    return first, second


def band(draws: Draws, floor: float = 0.0) -> Band:
    """Band of the mean of values (*levels, points) that covers the whole curve with probability `CONFIDENCE`.

    Points that are nan for every entry stay nan; points at the floor in every run have no width.
    """
    values = draws.less(floor)
    if not (np.nan_to_num(values.values) >= 0).all():
        return _simultaneous(draws.linear())
    positive = _positive(values)
    curve = _simultaneous(replace(values, values=values.values[..., positive]).logarithmic())
    found = np.tile(_plain(values.linear()), (3, 1))
    found[:, positive] = np.exp([curve.value, curve.low, curve.high])
    return Band(*(floor + found))


def ratio_band(draws: Draws, baseline: Draws) -> Band:
    """Band of the paired ratio of means over points; 0 where the first is 0 in a run, nan where the second is."""
    above, below = (_positive(part) for part in (draws, baseline))
    both = above & below
    curve = np.where(below, 0.0, np.nan) * np.ones((3, 1))
    first, second = (replace(part, values=part.values[..., both]).logarithmic() for part in (draws, baseline))
    found = _simultaneous(first - second)
    curve[:, both] = np.exp([found.value, found.low, found.high])
    return Band(*curve)


def _positive(draws: Draws) -> np.ndarray:
    """At which points every run's mean is above 0, (points,)."""
    runs = draws.runs()
    return np.asarray((runs > 0).reshape(-1, runs.shape[-1]).all(axis=0))


def _simultaneous(draws: Draws) -> Band:
    """mean(t) -+ the deviation times Student's t at the level at which all points hold at once.

    The level is found with the correlations of the means along the curve: q is the quantile of max_t |W(t)|, W Gaussian
    with these correlations (Hothorn, Bretz & Westfall 2008), drawn by giving each entry of each factor a normal
    multiplier; 2 (1 - Phi(q)) is then the level of each point, to be met by Student's t with its own freedom.
    """
    point, spread = _plain(draws), deviation(draws)
    if max(draws.sizes) == 1 or not point.size:
        return Band(point, *np.full((2, *point.shape), np.nan))
    half = spread.interval(_tail(_flat(draws)))
    return Band(point, point - half, point + half)


def _tail(draws: Draws) -> float:
    rng, levels = np.random.default_rng(0), len(draws.levels)
    curves = np.zeros((MULTIPLIERS, draws.values.shape[-1]))
    for group, effect in _effects(draws.values, levels):
        if len(group) == 1:
            size = draws.values.shape[group[0]]
            entries = effect.reshape(size, -1) / math.sqrt(size * (size - 1))
            curves += rng.standard_normal((MULTIPLIERS, size)) @ entries
    deviations = curves.std(axis=0)
    moving = deviations > 0  # False where nan, too
    if not moving.any():
        return (1 - CONFIDENCE) / 2
    highest = (np.abs(curves[:, moving]) / deviations[moving]).max(axis=1)
    return float(ndtr(-np.quantile(highest, CONFIDENCE)))

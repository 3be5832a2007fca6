"""Places of methods, case by case: which is better how often, whatever the scale of a metric.

A mean follows a few hard cases; ranks say what happens in most. Runs of several seeds on the same cases are averaged
first, so that a case counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, binom, rankdata

from dadiff.reporting.aggregation import Method, has_metric
from dadiff.reporting.labels import FLOORS
from dadiff.reporting.statistics import UNITS, Estimate, mean

TAIL = 0.025


@dataclass(frozen=True)
class Place:
    """Where a method stands.

    Args:
        rank: median over cases, 1 for the best, with the interval of order statistics.
        wins: share of cases in which it is better than the baseline, ties as halves, with the interval of Jeffreys.
    """

    rank: Estimate
    wins: Estimate | None


def places(methods: list[Method], metric: str, baseline: Method | None) -> list[Place | None]:
    """Of each method; None where it lacks the metric, or has results for other cases than most.

    Args:
        metric: the less the better.
    """
    found = [_by_case(method, metric) for method in methods]
    sizes = [values.size for values in found if values is not None]
    most = max(sizes, key=sizes.count, default=0)
    kept = [k for k, values in enumerate(found) if values is not None and values.size == most]
    standing: list[Place | None] = [None] * len(methods)
    if not kept:
        return standing
    values = np.stack([v for k, v in enumerate(found) if k in kept and v is not None])
    ranks = rankdata(values, axis=0)
    against = None if baseline is None else _by_case(baseline, metric)
    for row, k in enumerate(kept):
        compared = None if methods[k] is baseline or against is None or against.size != most else against
        standing[k] = Place(median(ranks[row]), None if compared is None else wins(values[row], compared))
    return standing


def at_their_best(methods: list[Method], metric: str, tuned: Sequence[str]) -> list[Method]:
    """Of methods that differ in `tuned` parameters alone the one with the least mean, on the cases it is shown on.

    Those without the metric are kept as they are.
    """
    groups = dict[str, list[Method]]()
    for method in methods:
        groups.setdefault(repr(sorted((k, v) for k, v in method.axes.items() if k not in tuned)), []).append(method)
    kept = []
    for alike in groups.values():
        judged = [method for method in alike if method.finished and has_metric(method.finished, metric)]
        best = min(judged, key=lambda method: _average(method, metric), default=None)
        kept += [method for method in alike if method is best or method not in judged]
    return kept


def _average(method: Method, metric: str) -> float:
    """The mean that tables show."""
    return mean(method.runs.scalars(metric), FLOORS.get(metric, 0)).value


def _by_case(method: Method, metric: str) -> np.ndarray | None:
    """A value for each robot and case; where each run has cases of its own, for each of these."""
    if not method.finished or not has_metric(method.finished, metric):
        return None
    draws = method.runs.scalars(metric)
    if not set(draws.levels) & set(UNITS):
        return None
    repeated = tuple(axis for axis, level in enumerate(draws.levels) if level not in UNITS)
    return np.asarray(draws.values if draws.nested else draws.values.mean(axis=repeated)).ravel()


def median(values: np.ndarray) -> Estimate:
    """With the order statistics that hold the true median in 95 % of draws; one value has no interval."""
    ordered, n = np.sort(values), len(values)
    if n < 2:
        return Estimate(float(ordered[0]), float("nan"), float("nan"))
    k = max(int(binom.ppf(TAIL, n, 0.5)) - 1, 0)
    return Estimate(float(np.median(ordered)), float(ordered[k]), float(ordered[n - 1 - k]))


def wins(own: np.ndarray, theirs: np.ndarray) -> Estimate:
    """The share of cases in which own is less."""
    n, won = len(own), float((own < theirs).sum() + (own == theirs).sum() / 2)
    low, high = beta.ppf([TAIL, 1 - TAIL], won + 0.5, n - won + 0.5)
    return Estimate(won / n, float(low), float(high))

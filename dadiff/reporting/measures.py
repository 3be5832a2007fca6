"""The statistics that claims are judged by: each gives an estimate with an interval for every method tested.

A measure takes the evidence, the methods, the axes for their labels, and its own options from the ledger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dadiff.reporting.aggregation import Evidence, Method, case_means, case_scalars, has_metric, pair, weights_for
from dadiff.reporting.labels import axis_value, method_name, metric_name, with_interval
from dadiff.reporting.selection import Selector
from dadiff.reporting.sources import Cell
from dadiff.reporting.statistics import (
    Band,
    Estimate,
    interval,
    mean,
    plain_mean,
    ratio,
    resampled_means,
    simultaneous_band,
    widening,
)


@dataclass(frozen=True)
class Measured:
    """One method's estimate and what it says in words; None if it diverged or has no result."""

    label: str
    axes: dict[str, Any]
    estimate: Estimate | None
    text: str
    runs: list[str]
    diverged: bool = False


Measure = Callable[..., list[Measured]]


def _usable(methods: list[Method], shown: list[str], out: list[Measured], metric: str = "") -> Iterator[Method]:
    """Methods with results; what became of the others goes to `out`."""
    for method in methods:
        if method.diverged or not method.finished:
            label = method_name(method.axes, shown)
            out.append(Measured(label, method.axes, None, method.outcome, method.keys, method.diverged))
        elif metric and not has_metric(method.finished, metric):
            out.append(_without(method, shown, f"has no {metric_name(metric)}"))
        else:
            yield method


def _pairs(
    evidence: Evidence, methods: list[Method], shown: list[str], out: list[Measured], metric: str, against: Selector
) -> Iterator[tuple[Method, Method]]:
    """Methods with what they are compared to."""
    for method in _usable(methods, shown, out, metric):
        other = evidence.partner(method, against)
        if other is None or not has_metric(other.finished, metric):
            wanted = ", ".join(axis_value(axis, value) for axis, value in against.items())
            out.append(_without(method, shown, f"no finished run of {wanted} to compare with"))
        else:
            yield method, other


def level(evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str) -> list[Measured]:
    """The mean of a metric."""
    out: list[Measured] = []
    for method in _usable(methods, shown, out, metric):
        values = case_scalars(method.finished, metric)
        estimate = mean(values, weights_for(values.shape))
        text = f"{metric_name(metric)} {_words(estimate)}{_lost(method)}"
        out.append(Measured(method_name(method.axes, shown), method.axes, estimate, text, method.keys))
    return out


def ratio_to(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, against: Selector
) -> list[Measured]:
    """The mean of a metric over that of a paired method."""
    out: list[Measured] = []
    for method, other in _pairs(evidence, methods, shown, out, metric, against):
        own, theirs = pair(method, other)
        values, baseline = case_scalars(own, metric), case_scalars(theirs, metric)
        estimate = ratio(values, baseline, weights_for(values.shape))
        text = (
            f"{metric_name(metric)} {_words(estimate)} times that of {_name_of(other, against)}{_lost(method, other)}"
        )
        out.append(Measured(method_name(method.axes, shown), method.axes, estimate, text, _keys(own, theirs)))
    return out


def worst_difference(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, against: Selector
) -> list[Measured]:
    """The largest over t of the paired difference along time, with its simultaneous band.

    Its upper bound is below 0 exactly where the method is below the other at every t.
    """
    out: list[Measured] = []
    for method, other in _pairs(evidence, methods, shown, out, metric, against):
        own, theirs = pair(method, other)
        values = case_means(own, metric) - case_means(theirs, metric)
        values = values[..., ~np.isnan(values).all(axis=tuple(range(values.ndim - 1)))]
        if not values.size:
            out.append(_without(method, shown, f"{metric_name(metric)} is defined nowhere"))
            continue
        band = simultaneous_band(values, weights_for(values.shape[:-1]))
        estimate = Estimate(float(band.value.max()), float(band.low.max()), float(band.high.max()))
        text = f"{metric_name(metric)} {_along(band)}, against {_name_of(other, against)}{_lost(method, other)}"
        out.append(Measured(method_name(method.axes, shown), method.axes, estimate, text, _keys(own, theirs)))
    return out


def _along(band: Band) -> str:
    """Where a band of differences is below and above 0, and the time with the highest upper bound."""
    below, above, count = int((band.high < 0).sum()), int((band.low > 0).sum()), len(band.value)
    worst = int(band.high.argmax())
    at = _words(Estimate(float(band.value[worst]), float(band.low[worst]), float(band.high[worst])))
    return f"lower at {below} and higher at {above} of {count} times (one band for all), at t = {worst} by {at}"


def dip(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, times: list[int], apart: int = 3
) -> list[Measured]:
    """A metric at a time t over its mean at t - apart and t + apart, for each of the times."""
    out: list[Measured] = []
    for method in _usable(methods, shown, out, metric):
        values = case_means(method.finished, metric)
        weights = weights_for(values.shape[:-1])
        for t in (t for t in times if t + apart < values.shape[-1]):
            around = (values[..., t - apart] + values[..., t + apart]) / 2
            estimate = ratio(values[..., t], around, weights)
            text = f"error {_words(estimate)} times that {apart} steps before and after{_lost(method)}"
            label = f"{method_name(method.axes, shown)}, t = {t}"
            out.append(Measured(label, {**method.axes, "t": t}, estimate, text, method.keys))
    return out


def longest_over_shortest(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, axis: str
) -> list[Measured]:
    """A metric at the largest value of an axis over that at the smallest, other axes alike."""
    out: list[Measured] = []
    rest = [name for name in shown if name != axis]
    for group in _groups(list(_usable(methods, shown, out, metric)), axis):
        if len(group) < 2:
            continue
        short, long = (case_scalars(m.finished, metric) for m in (group[0], group[-1]))
        estimate = _unpaired_ratio(long, short)
        ends = " and ".join(axis_value(axis, m.axes[axis]) for m in (group[-1], group[0]))
        text = f"ratio of {metric_name(metric)} at {ends}: {_words(estimate)}{_lost(group[0], group[-1])}"
        axes = {name: value for name, value in group[0].axes.items() if name != axis}
        out.append(Measured(method_name(axes, rest), axes, estimate, text, [k for m in group for k in m.keys]))
    return out


def _groups(methods: list[Method], axis: str) -> list[list[Method]]:
    groups: dict[str, list[Method]] = {}
    for method in methods:
        rest = repr(sorted((name, value) for name, value in method.axes.items() if name != axis))
        groups.setdefault(rest, []).append(method)
    return [sorted(group, key=lambda m: m.axes[axis]) for group in groups.values()]


def _unpaired_ratio(values: np.ndarray, baseline: np.ndarray) -> Estimate:
    """Of means, where numbers of replicates may differ; the cases are the same."""
    drawn = [weights_for(x.shape) for x in (values, baseline)]
    above, below = (resampled_means(x, weights) for x, weights in zip((values, baseline), drawn, strict=True))
    point = float(plain_mean(values, drawn[0]) / plain_mean(baseline, drawn[1]))
    return Estimate(point, *interval(above / below, point, max(drawn, key=widening), log=True))


def share_grew(evidence: Evidence, methods: list[Method], shown: list[str], *, stage: str) -> list[Measured]:
    """The largest share of plans, over the half-steps of a stage, whose distance of Theorem 1 grew. Counted, exact."""
    out: list[Measured] = []
    for method in methods:
        label, followed = method_name(method.axes, shown), [cell for cell in method.cells if cell.has("chain")]
        if not followed:
            out.append(Measured(label, method.axes, None, method.outcome or "its chain was not followed", []))
            continue
        rows = [cell.table("chain") for cell in followed]
        grew = np.concatenate([table.loc[table["stage"] == stage, "grew"].dropna() for table in rows])
        if not grew.size:
            out.append(Measured(label, method.axes, None, "its chain has no half-step of this kind", []))
            continue
        estimate = Estimate(*(float(grew.max()),) * 3)
        steps = f"{int((grew > 0).sum())} of {len(grew)} half-steps"
        text = f"the distance grew for up to {100 * grew.max():.3g} % of the plans, in {steps}"
        out.append(Measured(label, method.axes, estimate, text, [cell.key for cell in followed]))
    return out


def projection_share(evidence: Evidence, methods: list[Method], shown: list[str]) -> list[Measured]:
    """The time of all projections over the time of sampling; of a single run, as it was timed."""
    out: list[Measured] = []
    for method in _usable(methods, shown, out, "projection_seconds"):
        parts = ("projection_seconds", "projection_calls", "sampling_seconds")
        seconds, calls, total = (case_scalars(method.finished, name) for name in parts)
        values = seconds * calls / total
        estimate = mean(values, weights_for(values.shape)) if values.size > 1 else Estimate(*[values.item()] * 3)
        percent = Estimate(*(100 * x for x in (estimate.value, estimate.low, estimate.high)))
        text = f"{_words(percent)} % of the sampling time{' of one run' * (values.size == 1)}{_lost(method)}"
        out.append(Measured(method_name(method.axes, shown), method.axes, estimate, text, method.keys))
    return out


def schedule_conditions(evidence: Evidence, methods: list[Method], shown: list[str]) -> list[Measured]:
    """How many of (C1)-(C3) hold, for each schedule."""
    found: dict[str, Measured] = {}
    for method in methods:
        for cell in method.cells:
            conditions = cell.record.notes.get("schedule", {}) if cell.record else {}
            name = str(method.axes.get("schedule"))
            if conditions and name not in found:
                text = ", ".join(f"{c} {'holds' if true else 'fails'}" for c, true in sorted(conditions.items()))
                count = Estimate(*(float(sum(conditions.values())),) * 3)
                found[name] = Measured(name, {"schedule": name}, count, text, [cell.key])
    return list(found.values())


def _without(method: Method, shown: list[str], why: str) -> Measured:
    return Measured(method_name(method.axes, shown), method.axes, None, why, method.keys)


def _keys(*parts: list[Cell]) -> list[str]:
    """Of the runs that were compared, each once."""
    return list(dict.fromkeys(cell.key for part in parts for cell in part))


def _lost(*methods: Method) -> str:
    """A warning that a number rests on a part of the replicates."""
    parts = [f"{len(m.finished)} of {len(m.cells)} replicates: {m.outcome}" for m in methods if m.lost]
    return f" ({'; '.join(dict.fromkeys(parts))})" if parts else ""


def _name_of(other: Method, against: Selector) -> str:
    return ", ".join(axis_value(axis, other.axes[axis]) for axis in against if axis in other.axes)


def _words(estimate: Estimate) -> str:
    return with_interval(estimate.value, estimate.low, estimate.high)


MEASURES: dict[str, Measure] = {
    measure.__name__: measure
    for measure in (
        level,
        ratio_to,
        worst_difference,
        dip,
        longest_over_shortest,
        share_grew,
        projection_share,
        schedule_conditions,
    )
}
"""The ledger's vocabulary: a claim names one of these."""

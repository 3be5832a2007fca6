"""The statistics that claims are judged by: each gives an estimate with an interval for every method tested.

A measure takes the evidence, the methods, the axes for their labels, and its own options from the ledger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dadiff.reporting.aggregation import FLOORS, Evidence, Method, Runs, has_metric, pair, pairs
from dadiff.reporting.labels import axis_value, method_name, metric_name, with_interval
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Band, Draws, Estimate, mean, ratio, ratio_band


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
        estimate = mean(method.runs.scalars(metric), FLOORS.get(metric, 0))
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
        estimate = ratio(own.scalars(metric), theirs.scalars(metric), FLOORS.get(metric, 0))
        text = (
            f"{metric_name(metric)} {_words(estimate)} times that of {_name_of(other, against)}{_lost(method, other)}"
        )
        out.append(Measured(method_name(method.axes, shown), method.axes, estimate, text, _keys(own, theirs)))
    return out


def at_every_time(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, against: Selector
) -> list[Measured]:
    """The largest over t of the paired ratio along time, with its simultaneous band.

    Its upper bound is below 1 exactly where the method is below the other at every t.
    """
    out: list[Measured] = []
    for method, other in _pairs(evidence, methods, shown, out, metric, against):
        own, theirs = pair(method, other)
        found = ratio_band(own.curves(metric), theirs.curves(metric))
        if np.isnan(found.value).all():
            out.append(_without(method, shown, f"{metric_name(metric)} is defined nowhere"))
            continue
        estimate = Estimate(*(float(np.nanmax(part)) for part in (found.value, found.low, found.high)))
        whole = _words(ratio(own.scalars(metric), theirs.scalars(metric)))
        text = f"{metric_name(metric)} {whole} times that of {_name_of(other, against)}, {_along(found)}"
        out.append(
            Measured(
                method_name(method.axes, shown),
                method.axes,
                estimate,
                text + _lost(method, other),
                _keys(own, theirs),
            )
        )
    return out


def _along(found: Band) -> str:
    """Where a band of ratios is below and above 1, and the time with the highest upper bound."""
    below, above, count = (int(part.sum()) for part in (found.high < 1, found.low > 1, ~np.isnan(found.value)))
    worst = int(np.nanargmax(np.nan_to_num(found.high, nan=-1)))
    at = _words(Estimate(float(found.value[worst]), float(found.low[worst]), float(found.high[worst])))
    return f"lower at {below} and higher at {above} of {count} times (one band for all), at t = {worst} {at} times"


def dip(
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, times: list[int], apart: int = 3
) -> list[Measured]:
    """A metric at a time t over its mean at t - apart and t + apart, for each of the times."""
    out: list[Measured] = []
    for method in _usable(methods, shown, out, metric):
        draws = method.runs.curves(metric)
        for t in (t for t in times if t + apart < draws.values.shape[-1]):
            around = (draws.values[..., t - apart] + draws.values[..., t + apart]) / 2
            estimate = ratio(replace(draws, values=draws.values[..., t]), replace(draws, values=around))
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
        if len(group) < 2 or not pairs(group[-1], group[0]):
            continue
        long, short = pair(group[-1], group[0])
        estimate = ratio(long.scalars(metric), short.scalars(metric))
        ends = " and ".join(axis_value(axis, m.axes[axis]) for m in (group[-1], group[0]))
        text = f"ratio of {metric_name(metric)} at {ends}: {_words(estimate)}{_lost(group[0], group[-1])}"
        axes = {name: value for name, value in group[0].axes.items() if name != axis}
        out.append(Measured(method_name(axes, rest), axes, estimate, text, _keys(long, short)))
    return out


def _groups(methods: list[Method], axis: str) -> list[list[Method]]:
    groups: dict[str, list[Method]] = {}
    for method in methods:
        rest = repr(sorted((name, value) for name, value in method.axes.items() if name != axis))
        groups.setdefault(rest, []).append(method)
    return [sorted(group, key=lambda m: m.axes[axis]) for group in groups.values()]


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
        seconds, calls, total = (method.runs.scalars(name).values for name in parts)
        values = seconds * calls / total
        single = values.size == 1
        estimate = Estimate(*[values.item()] * 3) if single else mean(Draws(values, method.runs.levels))
        percent = Estimate(*(100 * x for x in (estimate.value, estimate.low, estimate.high)))
        text = f"{_words(percent)} % of the sampling time{' of one run' * single}{_lost(method)}"
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


def _keys(*parts: Runs) -> list[str]:
    """Of the runs that were compared, each once."""
    return list(dict.fromkeys(key for part in parts for key in part.keys))


def _lost(*methods: Method) -> str:
    """A warning that a number rests on a part of the replicates."""
    parts = [f"{len(m.keys)} of {len(m.cells)} runs: {m.outcome}" for m in methods if m.lost]
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
        at_every_time,
        dip,
        longest_over_shortest,
        share_grew,
        projection_share,
        schedule_conditions,
    )
}
"""The ledger's vocabulary: a claim names one of these."""

"""The statistics that claims are judged by: each gives an estimate with an interval for every method tested.

A measure takes the evidence, the methods, the axes for their labels, and its own options from the ledger.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from dadiff.reporting.aggregation import Evidence, Method, Runs, has_metric, pair, pairs
from dadiff.reporting.labels import FLOORS, axis_value, column_name, method_name, metric_name, with_interval
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Band, Draws, Estimate, mean, ratio, ratio_band


@dataclass(frozen=True)
class Measured:
    """One method's estimate and what it says in words; None if it is set aside.

    Args:
        estimate: what the rule is asked of.
        effect: what a reader wants to know, where that is something else.
    """

    label: str
    axes: dict[str, Any]
    estimate: Estimate | None
    text: str
    runs: list[str]
    diverged: bool = False
    effect: Estimate | None = None


Measure = Callable[..., list[Measured]]

IDENTITY = "the projector is the identity"


def _usable(methods: list[Method], shown: list[str], out: list[Measured], metric: str = "") -> Iterator[Method]:
    """Methods with results that say something; what became of the others goes to `out`."""
    for method in methods:
        if method.diverged or not method.finished:
            label = method_name(method.axes, shown)
            out.append(Measured(label, method.axes, None, method.outcome, method.keys, method.diverged))
        elif method.identity:
            out.append(_without(method, shown, IDENTITY))
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
    evidence: Evidence, methods: list[Method], shown: list[str], *, metric: str, against: Selector, exact: bool = False
) -> list[Measured]:
    """The mean of a metric over that of a paired method.

    Args:
        exact: the metric is in closed form; no chance enters it, so that the interval is the value.
    """
    out: list[Measured] = []
    for method, other in _pairs(evidence, methods, shown, out, metric, against):
        own, theirs = pair(method, other)
        estimate = ratio(own.scalars(metric), theirs.scalars(metric), FLOORS.get(metric, 0))
        estimate = Estimate(*(estimate.value,) * 3) if exact else estimate
        text = (
            f"{column_name(metric)} {_words(estimate)} times that of {_name_of(other, against)}{_lost(method, other)}"
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
        whole = ratio(own.scalars(metric), theirs.scalars(metric))
        text = f"{metric_name(metric)} {_words(whole)} times that of {_name_of(other, against)}, {_along(found)}"
        label, keys = method_name(method.axes, shown), _keys(own, theirs)
        out.append(Measured(label, method.axes, estimate, text + _lost(method, other), keys, effect=whole))
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


def steps_grew(evidence: Evidence, methods: list[Method], shown: list[str], *, stages: list[str]) -> list[Measured]:
    """The share of steps at which the mean over plans of the distance of Theorem 1 clearly grew.

    Clearly: by more than chance at any of the steps, one-sided at 5 % for all of them together (Bonferroni).

    Args:
        stages: "whole" steps, or the half-steps "predict" and "project"; a finding each.
    """
    out: list[Measured] = []
    for method, stage in itertools.product(methods, stages):
        axes = {**method.axes, "stage": stage}
        label = ", ".join([method_name(method.axes, shown), *[STAGES[stage]] * (len(stages) > 1)])
        followed = [cell for cell in method.cells if cell.has_column("chain", "step_growth")]
        growth = [_growth(cell.table("chain"), stage) for cell in followed]
        if not sum(map(len, growth)):
            why = method.outcome if method.lost and not followed else "its chain was not followed in such steps"
            out.append(Measured(label, axes, None, why, []))
            continue
        steps = pd.concat(growth)
        grew = int((steps["mean"] > steps["error"] * ndtri(1 - 0.05 / len(steps))).sum())
        estimate = Estimate(*(grew / len(steps),) * 3)
        text = f"the mean distance grew in {grew} of {len(steps)} steps"
        out.append(Measured(label, axes, estimate, text, [cell.key for cell in followed]))
    return out


STAGES = {"whole": "whole steps", "predict": "predictions", "project": "projections"}


def _growth(chain: pd.DataFrame, stage: str) -> pd.DataFrame:
    """Mean growth of the distance over each step, or half-step, and the error of that mean."""
    if stage == "whole":
        found = chain.groupby("i", sort=False)[["step_growth", "step_growth_error"]].last()
    else:
        found = chain.loc[chain["stage"] == stage, ["growth", "growth_error"]]
    return found.set_axis(["mean", "error"], axis=1).dropna()


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
    return method_name({axis: other.axes[axis] for axis in against if axis in other.axes}, against)


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
        steps_grew,
        projection_share,
        schedule_conditions,
    )
}
"""The ledger's vocabulary: a claim names one of these."""

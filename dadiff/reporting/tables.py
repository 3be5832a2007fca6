"""Tables, a row a method: for each metric the mean and a paired comparison, with intervals."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dadiff.outside import spreadsheet_safe
from dadiff.reporting.aggregation import LEVELS, Evidence, Method, has_metric, pair, varying
from dadiff.reporting.labels import FLOORS, METRICS, method_name
from dadiff.reporting.leaderboard import Place, at_their_best, places
from dadiff.reporting.naming import short_names
from dadiff.reporting.selection import Selector, matches
from dadiff.reporting.statistics import Estimate, difference, mean, ratio
from dadiff.store.record import ABOUT_DATA, is_odd


@dataclass(frozen=True)
class Value:
    """One metric of one method; the comparisons are paired, and None without a baseline."""

    mean: Estimate
    ratio: Estimate | None
    difference: Estimate | None


@dataclass(frozen=True)
class Row:
    """One method; a metric that it does not have is None, and without results `outcome` says what happened."""

    label: str
    values: dict[str, Value | None]
    outcome: str
    counts: dict[str, int]
    runs: list[str]


@dataclass(frozen=True)
class Table:
    """Rows and the order of the metrics; `baseline` names what ratios are relative to, `odd` what is odd about data,
    `usual` what names of methods leave out."""

    metrics: list[str]
    baseline: str
    rows: list[Row]
    odd: list[str] = field(default_factory=list)
    usual: str = ""

    @property
    def runs(self) -> list[str]:
        """Keys of all runs behind the numbers."""
        return [key for row in self.rows for key in row.runs]

    @property
    def notes(self) -> list[str]:
        """What became of cells without results, and what is odd about data from files."""
        return [f"{row.label}: {row.outcome}" for row in self.rows if row.outcome] + self.odd


def collect(
    evidence: Evidence,
    *,
    cells: Selector,
    metrics: list[str],
    relative_to: Selector | None = None,
    group: str | None = None,
    ranked_by: str | None = None,
    tuned: Sequence[str] = (),
    beside: Mapping[str, Any] | None = None,
) -> Table:
    """The methods that `cells` asks for; metrics that none of them has are left out, those about data from files stand
    in every table.

    Args:
        metrics: `...` stands for all scores of the task that have no name in print, those of own tasks.
        relative_to: the baseline of ratios and differences.
        group: of a fleet, the robots of this group alone.
        ranked_by: a metric, the less the better, by which methods have a `rank` and `wins`, and rows their order.
        tuned: axes of which the best value by that metric is taken and named.
        beside: `metrics` of what the methods that `cells` asks for are alike to in all but the axes of `of`, in columns
            at the end: what each would be with another denoiser, say.
    """
    methods = evidence.methods(cells)
    if ranked_by and tuned:
        methods = at_their_best(methods, ranked_by, tuned)
    shown = list(dict.fromkeys([*varying(methods), *tuned]))
    metrics = [name for asked in metrics for name in (_own(methods) if asked == "..." else [asked])]
    wanted = dict.fromkeys([*metrics, *ABOUT_DATA])
    kept = [name for name in wanted if any(m.finished and has_metric(m.finished, name) for m in methods)]
    names, usual = short_names(methods, shown) if ranked_by else ([method_name(m.axes, shown) for m in methods], "")
    rows = [_row(evidence, method, name, kept, relative_to, group) for method, name in zip(methods, names, strict=True)]
    if beside:
        kept, rows = _beside(evidence, methods, kept, rows, **beside)
    if ranked_by:
        kept, rows = _ranked(evidence, methods, kept, rows, ranked_by, relative_to)
    return Table(kept, method_name(dict(relative_to), relative_to) if relative_to else "", rows, _odd(methods), usual)


def _beside(
    evidence: Evidence, methods: list[Method], kept: list[str], rows: list[Row], *, metrics: list[str], of: Selector,
    cells: Selector,
) -> tuple[list[str], list[Row]]:  # fmt: skip
    """The metrics and rows with those of each method's counterpart, which is asked for by `of`."""
    asked = [method if method.finished and matches(method.axes, cells) else None for method in methods]
    others = [None if method is None else evidence.partner(method, of) for method in asked]
    found = [_row(evidence, other, "", metrics, None, None).values if other else {} for other in others]
    added = [name for name in metrics if any(values.get(name) for values in found)]
    return [*kept, *added], [
        replace(row, values=row.values | {name: values.get(name) for name in added})
        for row, values in zip(rows, found, strict=True)
    ]


def _ranked(
    evidence: Evidence, methods: list[Method], metrics: list[str], rows: list[Row], by: str, baseline: Selector | None
) -> tuple[list[str], list[Row]]:
    """The metrics with `rank` and `wins` before them, and the rows from the first place to the last."""
    others = [evidence.partner(method, baseline) for method in methods if method.finished] if baseline else []
    other = next((found for found in others if found is not None), None)
    found = [
        (place.rank.value if place else float("inf"), replace(row, values=row.values | _place(place)))
        for place, row in zip(places(methods, by, other), rows, strict=True)
    ]
    return ["rank", "wins", *metrics], [row for _, row in sorted(found, key=lambda pair: pair[0])]


def _place(place: Place | None) -> dict[str, Value | None]:
    shown = {"rank": place.rank, "wins": place.wins} if place else dict.fromkeys(("rank", "wins"))
    return {name: None if estimate is None else Value(estimate, None, None) for name, estimate in shown.items()}


def _odd(methods: list[Method]) -> list[str]:
    """What the worst run of each method says about its data, where that is odd."""
    found = []
    for method in methods:
        for metric, words in ABOUT_DATA.items():
            values = [cell.metrics[metric] for cell in method.finished if is_odd(metric, cell.metrics)]
            found += [f"{method_name(method.axes, varying(methods))}: {words.format(max(values))}"] if values else []
    return found


def _own(methods: list[Method]) -> list[str]:
    """Scores per plan that are not among those of this package."""
    columns = dict.fromkeys(name for m in methods for cell in m.finished[:1] for name in cell.columns("per_plan"))
    return [name for name in columns if name not in METRICS and name not in LEVELS]


def _row(
    evidence: Evidence,
    method: Method,
    name: str,
    metrics: list[str],
    baseline: Selector | None,
    group: str | None,
) -> Row:
    values: dict[str, Value | None] = {}
    other = evidence.partner(method, baseline) if baseline and method.finished else None
    for metric in metrics:
        there = method.finished and has_metric(method.finished, metric)
        values[metric] = _value(method, other, metric, group) if there else None
    return Row(name, values, method.outcome, method.counts(), method.keys)


def _value(method: Method, other: Method | None, metric: str, group: str | None) -> Value:
    average = mean(method.runs.scalars(metric, group), FLOORS.get(metric, 0))
    if other is None or other is method or not has_metric(other.finished, metric):
        return Value(average, None, None)
    own, theirs = (runs.scalars(metric, group) for runs in pair(method, other))
    return Value(average, ratio(own, theirs, FLOORS.get(metric, 0)), difference(own, theirs))


def to_csv(table: Table) -> str:
    """All numbers in full precision, a row a method."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    parts = ("mean", "ratio", "difference")
    names = [f"{metric}_{part}{end}" for metric in table.metrics for part in parts for end in ("", "_low", "_high")]
    writer.writerow(["method", "outcome", "counts", "runs", *names])
    for row in table.rows:
        counts = " ".join(f"{name}={count}" for name, count in row.counts.items())
        numbers = [x for metric in table.metrics for part in parts for x in _numbers(row.values[metric], part)]
        words = map(spreadsheet_safe, (row.label, row.outcome, counts, " ".join(row.runs)))
        writer.writerow([*words, *numbers])
    return buffer.getvalue()


def _numbers(value: Value | None, part: str) -> list[Any]:
    estimate = getattr(value, part) if value else None
    return [estimate.value, estimate.low, estimate.high] if estimate else ["", "", ""]

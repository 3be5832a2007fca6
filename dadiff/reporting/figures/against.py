"""Metrics against a numeric axis, one line a method: the length S of the recording, the length of training, ...

With a baseline the line is the ratio of means to it, on the same cases and noise; below 1 is better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, has_metric, pair, varying
from dadiff.reporting.figures.style import (
    PANEL_WIDTH,
    Look,
    at_the_edge,
    drawn,
    label_ends,
    legend_below,
    letter,
    log_axis,
    look_of,
    looks_of,
    panels,
    tag,
)
from dadiff.reporting.labels import FLOORS, axis_name, axis_value, method_name, metric_name, rounding
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean, ratio

ALONE = 1.7
"""Width of the only panel, which has room for names beside it."""

MARKS = ((0, (1, 1.5)), (0, (4, 1.5, 1, 1.5)), (0, (7, 2)))
"""Dashes of marked places."""


@dataclass(frozen=True)
class Line:
    """One method over the axis."""

    label: str
    axes: dict[str, Any]
    x: list[float]
    y: list[Estimate]


@dataclass(frozen=True)
class Panel:
    """One metric under one condition, and levels of methods that do not depend on the axis."""

    title: str
    metric: str
    lines: list[Line]
    levels: list[Line]


@dataclass(frozen=True)
class Against:
    """What the figure shows."""

    axis: str
    relative: str
    panels: list[Panel]
    marked: dict[str, float]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a metric and condition, both axes logarithmic."""
        width = PANEL_WIDTH * ALONE if columns > 1 else PANEL_WIDTH
        figure, axes = panels(len(self.panels), columns, width=width)
        for ax, panel in zip(axes, self.panels, strict=True):
            _draw_panel(ax, panel, labelled=columns > 1)
            self._mark(ax)
            ax.set_xlabel(axis_name(self.axis))
            ax.set_ylabel(f"relative to {self.relative}" if self.relative else "")
            ax.set_title("\n".join(filter(None, (metric_name(panel.metric), panel.title))))
        letter(axes)
        legend_below(figure, axes)
        return figure

    def _mark(self, ax: Axes) -> None:
        for (text, x), dots in zip(self.marked.items(), MARKS, strict=False):
            ax.axvline(x, color="#888888", lw=1, ls=dots, zorder=0, label=f"{text} ({axis_name(self.axis)} = {x:g})")
        if self.relative:
            ax.axhline(1, color="#888888", lw=0.8, zorder=0)


def _draw_panel(ax: Axes, panel: Panel, *, labelled: bool) -> None:
    for line, look in zip(panel.lines, looks_of([line.axes for line in panel.lines]), strict=True):
        exact = np.array([e.value for e in line.y])
        y = drawn(exact, rounding(panel.metric))
        bars = [[e.value - e.low for e in line.y], [e.high - e.value for e in line.y]]
        whiskers = ax.errorbar(line.x, y, bars, fmt="none", color=look.colour, capsize=2, lw=1)
        (drawn_line,) = ax.plot(line.x, y, ls=look.line, lw=1.4, label=line.label, **look.points)
        tag(line.label, drawn_line, values=True)
        tag(line.label, *whiskers.get_children())
        at_the_edge(ax, np.array(line.x), exact, look, line.label, rounding(panel.metric))
    for line in panel.levels:
        look, estimate = look_of(line.axes), line.y[0]
        if estimate.value <= rounding(panel.metric):
            continue
        level = ax.axhline(estimate.value, color=look.colour, ls=(0, (2, 2)), lw=1.2, label=line.label)
        tag(line.label, level, ax.axhspan(estimate.low, estimate.high, color=look.colour, alpha=0.12, lw=0))
    values = [e.value for line in (*panel.lines, *panel.levels) for e in line.y if not math.isnan(e.value)]
    if values and min(values) >= 0:
        log_axis(ax, "y")
        if labelled:
            label_ends(ax, [(line.label, end, look) for line, look, end in _ends(panel)])
    log_axis(ax, "x")


def _ends(panel: Panel) -> list[tuple[Line, Look, float]]:
    """The lines with their looks and the values where they end; those at rounding have no place on the axis."""
    looks = looks_of([line.axes for line in panel.lines])
    ends = [(line, look, line.y[-1].value) for line, look in zip(panel.lines, looks, strict=True) if line.y]
    return [end for end in ends if end[2] > rounding(panel.metric)]


def collect(
    evidence: Evidence,
    *,
    axis: str,
    metrics: list[str],
    cells: Selector,
    by: str | None = None,
    relative_to: Selector | None = None,
    levels: Selector | None = None,
    marked: dict[str, float] | None = None,
) -> Against:
    """Methods of `cells` over `axis`, those with two values of it or more.

    Args:
        by: an axis with a panel for each of its values.
        relative_to: the baseline that values are divided by.
        levels: methods without the axis, drawn as horizontal lines.
        marked: text -> place on the axis.
    """
    wanted = evidence.methods({**cells, axis: {"not": None}})
    used = [m for m in wanted if m.finished and (not relative_to or evidence.partner(m, relative_to))]
    flat = [m for m in evidence.methods(levels) if m.finished] if levels else []
    values = list(dict.fromkeys(m.axes.get(by) for m in used)) if by else [None]
    shown, levelled = ([name for name in varying(methods) if name not in (axis, by)] for methods in (used, flat))

    def panel(metric: str, value: Any) -> Panel:
        here = [m for m in used if has_metric(m.finished, metric) and (by is None or m.axes.get(by) == value)]
        beside = [m for m in flat if has_metric(m.finished, metric) and (by is None or m.axes.get(by) in (value, None))]
        groups = [group for group in _lines(here, axis) if len(group) > 1]
        lines = [_line(evidence, group, axis, metric, shown, relative_to) for group in groups]
        return Panel(axis_value(by, value) if by else "", metric, lines, [_level(m, metric, levelled) for m in beside])

    every = [p for p in (panel(metric, value) for metric in metrics for value in values) if p.lines]
    runs = [key for m in (*used, *flat) for key in m.keys] if every else []
    notes = [f"{method_name(m.axes, [*shown, by or '', axis])}: {m.outcome}" for m in wanted if m.lost]
    relative = method_name(dict(relative_to)) if relative_to else ""
    return Against(axis, relative, every, marked or {}, runs, notes)


def _lines(methods: list[Method], axis: str) -> list[list[Method]]:
    groups: dict[str, list[Method]] = {}
    for method in methods:
        rest = {name: value for name, value in method.axes.items() if name != axis}
        groups.setdefault(repr(sorted(rest.items())), []).append(method)
    return [sorted(group, key=lambda m: m.axes[axis]) for group in groups.values()]


def _line(
    evidence: Evidence, group: list[Method], axis: str, metric: str, shown: list[str], baseline: Selector | None
) -> Line:
    y = [_estimate(evidence, method, metric, baseline) for method in group]
    return Line(method_name(group[0].axes, shown), group[0].axes, [m.axes[axis] for m in group], y)


def _estimate(evidence: Evidence, method: Method, metric: str, baseline: Selector | None) -> Estimate:
    other = evidence.partner(method, baseline) if baseline else None
    if other is None:
        return mean(method.runs.scalars(metric), FLOORS.get(metric, 0))
    own, theirs = pair(method, other)
    return ratio(own.scalars(metric), theirs.scalars(metric), FLOORS.get(metric, 0))


def _level(method: Method, metric: str, shown: list[str]) -> Line:
    estimate = mean(method.runs.scalars(metric), FLOORS.get(metric, 0))
    return Line(method_name(method.axes, shown), method.axes, [], [estimate])

"""Errors against time with simultaneous bands: Fig. 2 and Fig. 3 (c, d) of the paper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, has_metric, varying
from dadiff.reporting.figures.style import (
    NAMED_HEIGHT,
    NAMED_WIDTH,
    at_the_edge,
    drawn,
    headline,
    label_ends,
    legend_below,
    letter,
    log_axis,
    looks_of,
    panels,
    tag,
)
from dadiff.reporting.labels import PROJECTORS, ROUNDING, axis_value, joint, method_name, metric_name, number
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Band, band


@dataclass(frozen=True)
class Curve:
    """One method in one panel; the band holds at all times at once."""

    label: str
    axes: dict[str, Any]
    band: Band


@dataclass(frozen=True)
class Panel:
    """One metric under one condition."""

    metric: str
    condition: str
    curves: list[Curve]


@dataclass(frozen=True)
class ErrorsOverTime:
    """What the figure shows."""

    panels: list[Panel]
    marked: list[int]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a metric, logarithmic, methods in the same order as in the legend."""
        size = {"width": NAMED_WIDTH, "height": NAMED_HEIGHT} if columns > 1 else {}
        figure, axes = panels(len(self.panels), columns, **size)
        for ax, panel in zip(axes, self.panels, strict=True):
            _draw_panel(ax, panel, self.marked, labelled=columns > 1)
        letter(axes)
        legend_below(figure, axes)
        headline(figure, self.found)
        return figure

    @property
    def found(self) -> str:
        """Which method has the lowest error of the first panel, in the mean over time, and how it compares."""
        means = {
            curve.label: float(np.nanmean(curve.band.value)) for panel in self.panels[:1] for curve in panel.curves
        }
        vanilla = next((label for label in means if label.split(",")[0] == PROJECTORS["none"]), None)
        if vanilla is None or len(means) < 2:
            return ""
        best, worst = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
        name, where = metric_name(self.panels[0].metric).split(" ‖")[0], self.panels[0].condition
        told = f"Lowest {name}{f' {where}' if where else ''}: {best}"
        told += f", {number(means[best] / means[vanilla], 2)} × {vanilla}" if best != vanilla else ""
        return told + (f"; highest: {worst}, {number(means[worst] / means[vanilla], 2)} ×" if worst != vanilla else "")


def _draw_panel(ax: Axes, panel: Panel, marked: list[int], *, labelled: bool) -> None:
    ends = []
    for curve, look in zip(panel.curves, looks_of([curve.axes for curve in panel.curves]), strict=True):
        t = np.arange(len(curve.band.value))
        shown = ~np.isnan(drawn(curve.band.value))  # inputs have no entry at T
        low, high = (drawn(bound)[shown] for bound in (curve.band.low, curve.band.high))
        area = ax.fill_between(t[shown], low, high, color=look.colour, alpha=0.22, lw=0)
        every = max(1, len(t) // 6)
        (line,) = ax.plot(
            t[shown], curve.band.value[shown], ls=look.line, label=curve.label, markevery=every, ms=4, **look.points
        )
        tag(curve.label, line, values=True)
        tag(curve.label, area)
        at_the_edge(ax, t, curve.band.value, look, curve.label)
        ends.append((curve.label, curve.band.value[shown][-1] if shown.any() else 0.0, look))
    for t_marked in marked:
        ax.axvline(t_marked, color="#888888", lw=0.8, ls=":", zorder=0)
    log_axis(ax, "y")
    if labelled:
        label_ends(ax, ends)
    ax.set_title("\n".join(filter(None, (metric_name(panel.metric), panel.condition))))
    ax.set_xlabel("time t [steps]")
    ax.set_ylabel("lower is better")


def collect(
    evidence: Evidence, *, metrics: list[str], cells: Selector, by: str | None = None, marked: list[int] | None = None
) -> ErrorsOverTime:
    """Mean over cases and plans of each metric at each t, for the methods that `cells` asks for.

    Args:
        by: an axis with panels of its own for each value.
        marked: times to mark.
    """
    methods = evidence.methods(cells)
    alive, shown = [method for method in methods if method.finished], varying(methods)
    values = list(dict.fromkeys(method.axes.get(by) for method in alive)) if by else [None]

    def panel(metric: str, value: Any) -> Panel:
        here = [m for m in alive if (by is None or m.axes.get(by) == value) and has_metric(m.finished, metric)]
        condition = axis_value(by, value) if by and value is not None and len(values) > 1 else ""
        curves = [_curve(method, metric, [name for name in shown if name != by]) for method in here]
        return Panel(metric, condition, _merged(curves))

    panels = [made for value in values for metric in metrics if (made := panel(metric, value)).curves]
    notes = [f"{method_name(method.axes, shown)}: {method.outcome}" for method in methods if method.lost]
    return ErrorsOverTime(panels, marked or [], [key for m in alive for key in m.keys] if panels else [], notes)


def _merged(curves: list[Curve]) -> list[Curve]:
    """Curves that no eye can tell apart as one, named after all of them."""
    distinct: list[Curve] = []
    for curve in curves:
        for index, other in enumerate(distinct):
            if np.allclose(curve.band.value, other.band.value, rtol=COINCIDE, atol=ROUNDING, equal_nan=True):
                distinct[index] = replace(other, label=joint(other.label, curve.label))
                break
        else:
            distinct.append(curve)
    return distinct


COINCIDE = 2e-3
"""Relative difference below which curves are one."""


def _curve(method: Method, metric: str, shown: list[str]) -> Curve:
    return Curve(method_name(method.axes, shown), method.axes, band(method.runs.curves(metric)))

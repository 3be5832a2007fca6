"""Errors against time with simultaneous bands: Fig. 2 and Fig. 3 (c, d) of the paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.figures.style import legend_below, letter, log_axis, looks_of, panels
from dadiff.reporting.labels import axis_value, method_name, metric_name
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
        figure, axes = panels(len(self.panels), columns)
        for ax, panel in zip(axes, self.panels, strict=True):
            _draw_panel(ax, panel, self.marked)
        letter(axes)
        legend_below(figure, axes)
        return figure


def _draw_panel(ax: Axes, panel: Panel, marked: list[int]) -> None:
    for curve, look in zip(panel.curves, looks_of([curve.axes for curve in panel.curves]), strict=True):
        t = np.arange(len(curve.band.value))
        shown = curve.band.value > 0  # False for nan, too: inputs have no entry at T
        ax.fill_between(t[shown], curve.band.low[shown], curve.band.high[shown], color=look.colour, alpha=0.22, lw=0)
        every = max(1, len(t) // 6)
        ax.plot(
            t[shown], curve.band.value[shown], ls=look.line, label=curve.label, markevery=every, ms=4, **look.points
        )
    for t_marked in marked:
        ax.axvline(t_marked, color="#888888", lw=0.8, ls=":", zorder=0)
    log_axis(ax, "y")
    ax.set_title("\n".join(filter(None, (metric_name(panel.metric), panel.condition))))
    ax.set_xlabel("time t [steps]")


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
        here = [method for method in alive if by is None or method.axes.get(by) == value]
        condition = axis_value(by, value) if by and len(values) > 1 else ""
        return Panel(
            metric, condition, [_curve(method, metric, [name for name in shown if name != by]) for method in here]
        )

    panels = [panel(metric, value) for value in values for metric in metrics]
    notes = [f"{method_name(method.axes, shown)}: {method.outcome}" for method in methods if method.lost]
    return ErrorsOverTime(panels if alive else [], marked or [], [key for m in alive for key in m.keys], notes)


def _curve(method: Method, metric: str, shown: list[str]) -> Curve:
    return Curve(method_name(method.axes, shown), method.axes, band(method.runs.curves(metric)))

"""Two metrics of every method against each other: time against error, plan against replay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, has_metric, varying
from dadiff.reporting.figures.style import PANEL_WIDTH, legend_below, log_axis, looks_of, panels, tag
from dadiff.reporting.labels import FLOORS, ROUNDING, method_name, metric_name
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean


@dataclass(frozen=True)
class Point:
    """One method."""

    label: str
    axes: dict[str, Any]
    x: Estimate
    y: Estimate


@dataclass(frozen=True)
class Scatter:
    """What the figure shows; `diagonal`: a line on which both metrics agree."""

    x: str
    y: str
    points: list[Point]
    diagonal: bool
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel with both axes logarithmic."""
        width = 6.6 if columns > 1 else PANEL_WIDTH
        figure, (ax,) = panels(1, columns, width=width, height=3.1 + 0.18 * len(self.points) / min(columns, 2))
        for point, look in zip(self.points, looks_of([point.axes for point in self.points], lines=False), strict=True):
            bars = [[[e.value - e.low], [e.high - e.value]] for e in (point.x, point.y)]
            x, y = (max(e.value, ROUNDING) for e in (point.x, point.y))
            whiskers = ax.errorbar(x, y, bars[1], bars[0], fmt="none", color=look.colour, capsize=2, lw=1)
            (mark,) = ax.plot(x, y, ls="", ms=7, label=point.label, **look.points)
            tag(point.label, mark, values=True)
            tag(point.label, *whiskers.get_children())
        if self.diagonal:
            ends = [end([e.value for p in self.points for e in (p.x, p.y)]) for end in (min, max)]
            ax.plot(ends, ends, color="#888888", lw=0.8, ls=":", zorder=0)
        log_axis(ax, "x")
        log_axis(ax, "y")
        ax.set_xlabel(metric_name(self.x))
        ax.set_ylabel(metric_name(self.y))
        legend_below(figure, [ax])
        return figure


def collect(evidence: Evidence, *, x: str, y: str, cells: Selector, diagonal: bool = False) -> Scatter:
    """Means of two metrics over replicates, cases and plans."""
    methods = evidence.methods(cells)
    alive = [m for m in methods if m.finished and has_metric(m.finished, x) and has_metric(m.finished, y)]
    shown = varying(methods)
    points = [Point(method_name(m.axes, shown), m.axes, _mean(m, x), _mean(m, y)) for m in alive]
    notes = [f"{method_name(m.axes, shown)}: {m.outcome}" for m in methods if m.lost]
    return Scatter(x, y, points, diagonal, [key for m in alive for key in m.keys], notes)


def _mean(method: Method, metric: str) -> Estimate:
    return mean(method.runs.scalars(metric), FLOORS.get(metric, 0))

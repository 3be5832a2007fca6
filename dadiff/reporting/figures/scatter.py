"""Two metrics of every method against each other: time against error, plan against replay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, has_metric, varying
from dadiff.reporting.figures.style import SIDE, Look, label_points, legend_below, log_axis, looks_of, panels, tag
from dadiff.reporting.labels import FLOORS, ROUNDING, column_name
from dadiff.reporting.naming import short_names
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
    usual: str = ""

    def draw(self, columns: int) -> Figure:
        """One panel with both axes logarithmic."""
        size = {"width": WIDTH, "height": HEIGHT} if columns > 1 else {"height": 3.1 + 0.18 * len(self.named)}
        figure, (ax,) = panels(1, columns, **size)
        looks = looks_of([point.axes for point in self.points], lines=False)
        for point, own in zip(self.points, looks, strict=True):
            look = own if point in self.named else OTHERS
            bars = [[[e.value - e.low], [e.high - e.value]] for e in (point.x, point.y)]
            x, y = _place(point)
            whiskers = ax.errorbar(x, y, bars[1], bars[0], fmt="none", color=look.colour, capsize=2, lw=1)
            label = point.label if point in self.named else "_"
            (mark,) = ax.plot(x, y, ls="", ms=7, label=label, zorder=2 + (point in self.named), **look.points)
            tag(point.label, mark, values=True)
            tag(point.label, *whiskers.get_children())
        if self.diagonal:
            ends = [end([e.value for p in self.points for e in (p.x, p.y)]) for end in (min, max)]
            line = np.geomspace(max(ends[0], ROUNDING), max(ends[1], ROUNDING))
            ax.plot(line, line, color="#888888", lw=0.8, ls=":", zorder=0)
        log_axis(ax, "x")
        log_axis(ax, "y")
        ax.set_xlabel(column_name(self.x))
        ax.set_ylabel(column_name(self.y))
        if columns > 1:
            found = [(p, look) for p, look in zip(self.points, looks, strict=True) if p in self.named]
            beside = len(found) < len(self.points)
            label_points(ax, [(p.label, *_place(p), look) for p, look in found], beside=beside)
            if beside:
                figure.set_layout_engine("constrained", w_pad=SIDE)
        else:
            legend_below(figure, [ax])
        return figure

    @property
    def named(self) -> list[Point]:
        """All points, or of many the best; the others are grey."""
        if len(self.points) <= MOST_NAMED:
            return self.points
        return sorted(self.points, key=lambda point: point.y.value)[:BEST]


WIDTH, HEIGHT = 9.6, 3.4
MOST_NAMED, BEST = 12, 5
OTHERS = Look("#8c8c8c", "o", "-", "full")


def _place(point: Point) -> tuple[float, float]:
    return max(point.x.value, ROUNDING), max(point.y.value, ROUNDING)


def collect(evidence: Evidence, *, x: str, y: str, cells: Selector, diagonal: bool = False) -> Scatter:
    """Means of two metrics above what they cannot go below, over replicates, cases and plans."""
    methods = evidence.methods(cells)
    names, usual = short_names(methods, varying(methods))
    alive = [
        (name, m)
        for name, m in zip(names, methods, strict=True)
        if m.finished and has_metric(m.finished, x) and has_metric(m.finished, y)
    ]
    points = [Point(name, m.axes, _mean(m, x), _mean(m, y)) for name, m in alive]
    notes = [f"{name}: {m.outcome}" for name, m in zip(names, methods, strict=True) if m.lost]
    return Scatter(x, y, points, diagonal, [key for _, m in alive for key in m.keys], notes, usual)


def _mean(method: Method, metric: str) -> Estimate:
    floor = FLOORS.get(metric, 0.0)
    found = mean(method.runs.scalars(metric), floor)
    return Estimate(found.value - floor, found.low - floor, found.high - floor)

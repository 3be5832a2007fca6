"""A metric of every robot of a fleet against how far the robot lies outside the ranges of the training set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.figures.style import drawn, legend_below, letter, log_axis, looks_of, panels, tag
from dadiff.reporting.labels import method_name, metric_name
from dadiff.reporting.selection import Selector


@dataclass(frozen=True)
class Points:
    """One method; for each metric the robots' means over seeds and cases, (metrics, robots)."""

    label: str
    axes: dict[str, Any]
    distance: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Robots:
    """What the figure shows."""

    metrics: list[str]
    points: list[Points]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a metric, every marker a robot."""
        figure, axes = panels(len(self.metrics), columns)
        for index, (ax, metric) in enumerate(zip(axes, self.metrics, strict=True)):
            for points, look in zip(self.points, looks_of([p.axes for p in self.points], lines=False), strict=True):
                (dots,) = ax.plot(
                    points.distance, drawn(points.values[index]), ls="", ms=3.5, label=points.label, **look.points
                )
                tag(points.label, dots, values=True)
            log_axis(ax, "y")
            ax.set_title(metric_name(metric))
            ax.set_xlabel("distance from the training ranges, in their widths")
        letter(axes)
        legend_below(figure, axes)
        return figure


def collect(evidence: Evidence, *, metrics: list[str], cells: Selector) -> Robots:
    """The methods of `cells` that were run on a fleet."""
    methods = evidence.methods(cells)
    used, shown = [m for m in methods if m.finished and m.finished[0].has("robots")], varying(methods)
    points = [_points(method, metrics, method_name(method.axes, shown)) for method in used]
    notes = [f"{method_name(m.axes, shown)}: {m.outcome}" for m in methods if m.lost]
    return Robots(metrics, points, [key for m in used for key in m.keys], notes)


def _points(method: Method, metrics: list[str], label: str) -> Points:
    distance = method.finished[0].table("robots")["distance"].to_numpy()
    values = [method.runs.scalars(metric).values for metric in metrics]
    robots = [draws.mean(axis=(*range(draws.ndim - 2), -1)) for draws in values]
    return Points(label, method.axes, distance, np.stack(robots))

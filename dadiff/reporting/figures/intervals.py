"""Closed loop: cost against the number of steps between two plans, a panel a controller, a line a method.

The cost is relative to the expert that plans anew at each step under the same disturbances; the expert at the same
interval is drawn beside. How far a method may let the robot go on without looking is what this shows.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.figures.style import legend_below, letter, log_axis, looks_of, panels
from dadiff.reporting.labels import method_name
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean

METRIC = re.compile(r"closed_loop_(?P<controller>[a-z]+)_(?P<every>\d+)")
TITLES = {"receding": "the plan is followed open loop", "tracking": "the plan is followed with LQR gains"}


@dataclass(frozen=True)
class Line:
    """One method with one controller."""

    label: str
    axes: dict[str, Any]
    every: list[int]
    cost: list[Estimate]


@dataclass(frozen=True)
class Intervals:
    """What the figure shows: lines by controller, and the expert's."""

    lines: dict[str, list[Line]]
    expert: Line | None
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a controller."""
        figure, axes = panels(len(self.lines), columns)
        for ax, (controller, lines) in zip(axes, self.lines.items(), strict=True):
            _draw(ax, lines, self.expert)
            ax.set_title(TITLES.get(controller, controller), wrap=True)
        letter(axes)
        legend_below(figure, axes)
        return figure


def _draw(ax: Axes, lines: list[Line], expert: Line | None) -> None:
    for line, look in zip(lines, looks_of([line.axes for line in lines]), strict=True):
        y = [estimate.value for estimate in line.cost]
        bars = [[e.value - e.low for e in line.cost], [e.high - e.value for e in line.cost]]
        ax.errorbar(line.every, y, bars, fmt="none", color=look.colour, capsize=2, lw=1)
        ax.plot(line.every, y, ls=look.line, lw=1.4, label=line.label, **look.points)
    if expert:
        ax.plot(
            expert.every, [e.value for e in expert.cost], color="#888888", ls=(0, (2, 2)), lw=1.2, label=expert.label
        )
    ax.set_xlabel("steps between two plans")
    ax.set_ylabel("cost over that of the expert\nplanning at each step")
    log_axis(ax, "x")
    log_axis(ax, "y")


def collect(evidence: Evidence, *, cells: Selector | None = None) -> Intervals:
    """Methods of `cells` that were run in closed loop."""
    methods = [m for m in evidence.methods(cells or {}) if m.finished and _costs(m)]
    shown = varying(methods)
    lines: dict[str, list[Line]] = {}
    for method in methods:
        for controller, found in _costs(method).items():
            if controller != "optimal":
                line = _line(method, controller, found, method_name(method.axes, shown))
                lines.setdefault(controller, []).append(line)
    first = methods[0] if methods else None
    known = _costs(first).get("optimal") if first else None
    expert = _line(first, "optimal", known, "the expert at the same interval") if first and known else None
    return Intervals(lines, expert, [key for m in methods for key in m.keys], [])


def _costs(method: Method) -> dict[str, list[int]]:
    """Controller -> the intervals that all replicates were run with, ascending."""
    names = set.intersection(*(set(cell.metrics) for cell in method.finished))
    found: dict[str, list[int]] = {}
    for match in filter(None, map(METRIC.fullmatch, names)):
        found.setdefault(match["controller"], []).append(int(match["every"]))
    return {controller: sorted(found[controller]) for controller in sorted(found)}


def _line(method: Method, controller: str, every: list[int], label: str) -> Line:
    costs = [mean(method.runs.scalars(f"closed_loop_{controller}_{k}"), 0) for k in every]
    return Line(label, method.axes, every, costs)

"""Closed loop: cost against the number of steps between two plans, a panel a controller, a line a method.

The cost is relative to the expert that plans at the shortest interval under the same disturbances, and the expert at
the same interval is drawn beside; or it is relative to that one. How far a method may let the robot go on without
looking is what this shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import EPISODES, Evidence, Method, varying
from dadiff.reporting.figures.style import label_ends, legend_below, letter, log_axis, looks_of, panels
from dadiff.reporting.labels import ROUNDING, method_name
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean

Against = Literal["shortest", "same"]
TITLES = {
    "receding": "the plan is followed open loop",
    "tracking": "the plan is followed with LQR gains",
    "modelled": "the expert on the planner's model",
}


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
    against: Against
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a controller."""
        figure, axes = panels(len(self.lines), columns)
        for ax, (controller, lines) in zip(axes, self.lines.items(), strict=True):
            _draw(ax, lines, self.expert, self.against, labelled=columns > 1)
            ax.set_title(TITLES.get(controller, controller), wrap=True)
        letter(axes)
        legend_below(figure, axes)
        return figure


def _draw(ax: Axes, lines: list[Line], expert: Line | None, against: Against, *, labelled: bool) -> None:
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
    ax.set_ylabel(f"cost over that of the expert\nplanning at the {against} interval")
    log_axis(ax, "x")
    log_axis(ax, "y")
    if labelled:
        looks = looks_of([line.axes for line in lines])
        ends = [(line.label, line.cost[-1].value, look) for line, look in zip(lines, looks, strict=True)]
        label_ends(ax, [end for end in ends if end[1] > ROUNDING])


def collect(
    evidence: Evidence, *, cells: Selector | None = None, against: Against = "shortest", group: str | None = None
) -> Intervals:
    """Methods of `cells` that were run in closed loop.

    Args:
        against: the expert at the shortest of the intervals, or at the same one.
        group: of a fleet, the robots of this group alone.
    """
    prefix = "closed_loop_" + {"shortest": "", "same": "same_"}[against]
    methods = [m for m in evidence.methods(cells or {}) if m.finished and _costs(m)]
    shown = varying(methods)
    lines: dict[str, list[Line]] = {}
    for method in methods:
        for controller, found in _costs(method).items():
            if controller not in ("optimal", "realtime"):
                line = _line(method, prefix + controller, found, method_name(method.axes, shown), group)
                lines.setdefault(controller, []).append(line)
    first = methods[0] if methods else None
    known = _costs(first).get("optimal") if first else None
    same = "the expert at the same interval"
    expert = _line(first, f"{prefix}optimal", known, same, group) if first and known else None
    return Intervals(lines, expert, against, [key for m in methods for key in m.keys], [])


def _costs(method: Method) -> dict[str, list[int]]:
    """Controller -> the intervals that all replicates were run with, ascending."""
    names = set.intersection(*(set(cell.metrics) for cell in method.finished))
    found: dict[str, list[int]] = {}
    for match in filter(None, map(EPISODES.fullmatch, names)):
        if match["same"]:
            continue
        found.setdefault(match["controller"], []).append(int(match["every"]))
    return {controller: sorted(found[controller]) for controller in sorted(found)}


def _line(method: Method, metric: str, every: list[int], label: str, group: str | None) -> Line:
    costs = [mean(method.runs.scalars(f"{metric}_{k}", group), 0) for k in every]
    return Line(label, method.axes, every, costs)

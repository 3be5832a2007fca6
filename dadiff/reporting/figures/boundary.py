"""Where a method stops helping: its error relative to a baseline over two numeric axes, and the line at 1.

For recordings: noise by length. Violet is better than the baseline, orange worse; a cell says the ratio, in brackets
where its interval holds 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dadiff.reporting.aggregation import Evidence, Method, has_metric, pair, varying
from dadiff.reporting.figures.style import INK, headline, letter, panels
from dadiff.reporting.labels import FLOORS, axis_name, method_name, metric_name, number
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, ratio

DECADES = 2.0
"""Ratios of 100 and 1/100 have the strongest colours."""


@dataclass(frozen=True)
class Panel:
    """One method: ratios (rows, columns), None where there is no run or no comparison."""

    label: str
    axes: dict[str, Any]
    ratios: list[list[Estimate | None]]


@dataclass(frozen=True)
class Boundary:
    """What the figure shows: values of the two axes, rows from the top."""

    metric: str
    baseline: str
    names: tuple[str, str]
    rows: list[float]
    columns: list[float]
    panels: list[Panel]
    runs: list[str]
    notes: list[str]

    @property
    def found(self) -> str:
        """In how many cells the methods are clearly better than the baseline, and which is most and least often."""
        if not self.panels:
            return ""
        told = [f"{panel.label} in {_better(panel)} of {_count(panel)}" for panel in sorted(self.panels, key=_share)]
        if len(told) < 3:
            return f"Clearly better than {self.baseline}: {'; '.join(told)}"
        better, cells = (sum(map(count, self.panels)) for count in (_better, _count))
        return f"Clearly better than {self.baseline} in {better} of {cells}; most: {told[-1]}; least: {told[0]}"

    def draw(self, columns: int) -> Figure:
        """A panel a method; a thick line runs between cells on either side of 1."""
        size = {"width": 1.1 + 0.72 * len(self.columns), "height": 1.0 + 0.42 * len(self.rows)}
        figure, axes = panels(len(self.panels), columns, **size)
        for ax, panel in zip(axes, self.panels, strict=True):
            self._draw_panel(ax, panel)
        letter(axes)
        headline(figure, self.found)
        return figure

    def _draw_panel(self, ax: Axes, panel: Panel) -> None:
        for y, row in enumerate(panel.ratios):
            for x, estimate in enumerate(row):
                _draw_cell(ax, x, y, estimate)
        _draw_line(ax, np.array([[e.value if e else np.nan for e in row] for row in panel.ratios]))
        ax.set_xlim(-0.5, len(self.columns) - 0.5)
        ax.set_ylim(len(self.rows) - 0.5, -0.5)
        ax.set_xticks(range(len(self.columns)), [f"{value:g}" for value in self.columns])
        ax.set_yticks(range(len(self.rows)), [f"{value:g}" for value in self.rows])
        ax.set_ylabel(axis_name(self.names[0]))
        ax.set_xlabel(axis_name(self.names[1]))
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set_title(f"{panel.label}\n{metric_name(self.metric).split(' ‖')[0]} × {self.baseline}")


def _count(panel: Panel) -> int:
    return sum(estimate is not None for row in panel.ratios for estimate in row)


def _better(panel: Panel) -> int:
    return sum(estimate is not None and estimate.high < 1 for row in panel.ratios for estimate in row)


def _share(panel: Panel) -> float:
    return _better(panel) / _count(panel)


def _draw_cell(ax: Axes, x: int, y: int, estimate: Estimate | None) -> None:
    place = (x - 0.48, y - 0.46), 0.96, 0.92
    if estimate is None or not estimate.value > 0:
        ax.add_patch(Rectangle(*place, fill=False, ls=":", ec="#888888"))
        return
    share = np.clip(np.log10(estimate.value) / DECADES, -1, 1)
    face = colormaps["PuOr_r"](0.5 + 0.5 * float(share))
    dark = np.dot(face[:3], (0.299, 0.587, 0.114)) < 0.55
    ax.add_patch(Rectangle(*place, fc=face, lw=0))
    clear = estimate.high < 1 or estimate.low > 1
    words = number(estimate.value, 2)
    ax.annotate(
        words if clear else f"({words})", (x, y), ha="center", va="center", fontsize=6.5,
        color="#ffffff" if dark else "#101010",
    )  # fmt: skip


def _draw_line(ax: Axes, ratios: np.ndarray) -> None:
    """Along the edges between cells below and above 1."""
    below = np.where(np.isnan(ratios), np.nan, ratios < 1)
    for y, x in np.argwhere(np.abs(np.diff(below, axis=1)) == 1):
        ax.plot([x + 0.5, x + 0.5], [y - 0.5, y + 0.5], color=INK, lw=2.2, solid_capstyle="round")
    for y, x in np.argwhere(np.abs(np.diff(below, axis=0)) == 1):
        ax.plot([x - 0.5, x + 0.5], [y + 0.5, y + 0.5], color=INK, lw=2.2, solid_capstyle="round")


def collect(
    evidence: Evidence, *, rows: str, columns: str, metric: str, cells: Selector, relative_to: Selector
) -> Boundary:
    """Ratios to `relative_to` of the methods that have both axes; where other axes differ, each has a panel."""
    methods = [m for m in evidence.methods(cells) if rows in m.axes and columns in m.axes]
    values = [sorted({m.axes[axis] for m in methods}) for axis in (rows, columns)]
    shown = [name for name in varying(methods) if name not in (rows, columns)]
    groups: dict[str, list[Method]] = {}
    for method in methods:
        groups.setdefault(method_name(method.axes, shown), []).append(method)

    def estimate(group: list[Method], row: float, column: float) -> Estimate | None:
        here = [m for m in group if (m.axes[rows], m.axes[columns]) == (row, column) and not m.identity]
        other = evidence.partner(here[0], relative_to) if here and here[0].finished else None
        if other is None or not has_metric(here[0].finished, metric) or not has_metric(other.finished, metric):
            return None
        own, theirs = pair(here[0], other)
        return ratio(own.scalars(metric), theirs.scalars(metric), FLOORS.get(metric, 0))

    found = [
        Panel(label, group[0].axes, [[estimate(group, row, column) for column in values[1]] for row in values[0]])
        for label, group in groups.items()
    ]
    compared = [panel for panel in found if _count(panel)]
    runs = [key for m in methods for key in m.keys] if compared else []
    notes = [f"{label}: {m.outcome}" for label, group in groups.items() for m in group if m.lost]
    baseline, (down, across) = method_name(dict(relative_to)), values
    return Boundary(metric, baseline, (rows, columns), down, across, compared, runs, notes)

"""One metric by method: means with intervals and every replicate as a dot. Logarithmic axis.

Serves cost ratios, collisions, and gains; on the fleet every dot is a robot.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, has_metric, varying
from dadiff.reporting.figures.style import INK, drawn, headline, letter, log_axis, look_of, panels
from dadiff.reporting.labels import FLOORS, PROJECTORS, column_name, method_name, metric_name, number, rounding
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean

MANY_DOTS = 6000
"""In a panel; more are drawn as one picture in svg and pdf, which keeps the files small."""

TITLE = 46
"""Letters of a panel's title in a line."""


@dataclass(frozen=True)
class Row:
    """One method: its estimate, and a dot for each robot, or for each case where there is one robot."""

    label: str
    axes: dict[str, Any]
    estimate: Estimate | None
    dots: np.ndarray
    outcome: str


@dataclass(frozen=True)
class Methods:
    """What the figure shows: for each metric its rows, the first one on top.

    Args:
        above: whether metrics are shown above what they cannot go below, such as a cost above the optimal one.
    """

    metrics: list[str]
    rows: list[list[Row]]
    dot: str
    log: bool
    above: bool
    best: dict[str, float]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """One panel a metric."""
        longest = max((len(row.label) for row in self.rows[0]), default=0)
        width = 4.1 + 0.08 * max(longest - 40, 0) / min(columns, len(self.metrics))
        figure, axes = panels(len(self.metrics), columns, width=width, height=0.9 + 0.32 * len(self.rows[0]))
        for index, (ax, metric, rows) in enumerate(zip(axes, self.metrics, self.rows, strict=True)):
            _draw_rows(ax, rows, log=self.log, below=rounding(metric))
            title = column_name(metric) if self.above else metric_name(metric)
            ax.set_title("\n".join(textwrap.wrap(title, TITLE)))
            ax.tick_params(labelleft=index % columns == 0)
            if self.above:
                _say_values(ax, rows)
                ax.set_xlabel("lower is better")
            elif metric in self.best:
                ax.axvline(self.best[metric], color="#888888", lw=0.8, ls=":", zorder=0)
        letter(axes)
        headline(figure, self.found)
        return figure

    @property
    def found(self) -> str:
        """Of a metric above its floor: which method has the lowest mean, and what vanilla diffusion has."""
        means = (
            {row.label: row.estimate.value for row in self.rows[0] if row.estimate} if self.above and self.rows else {}
        )
        vanilla = means.get(PROJECTORS["none"])
        if vanilla is None or len(means) < 2:
            return ""
        best = min(means, key=means.__getitem__)
        name, beside = column_name(self.metrics[0]), number(vanilla, 2)
        return f"Lowest {name}: {number(means[best], 2)} with {best}; vanilla: {beside}"


def _draw_rows(ax: Axes, rows: list[Row], *, log: bool, below: float) -> None:
    many = sum(len(row.dots) for row in rows) > MANY_DOTS
    for y, row in enumerate(rows):
        look = look_of(row.axes)
        if row.estimate is None:
            ax.annotate(
                shortened(row.outcome),
                (0.02, y),
                xycoords=("axes fraction", "data"),
                va="center",
                style="italic",
                fontsize=7.5,
            )
            continue
        offsets = y + 0.32 * (np.arange(len(row.dots)) / max(1, len(row.dots) - 1) - 0.5)
        shown = drawn(row.dots, below) if log else row.dots
        ax.plot(shown, offsets, ".", color=look.colour, alpha=0.6, ms=5.5, mew=0, rasterized=many)
        if log and row.estimate.value <= below:
            ax.annotate("exact", (0.02, y), xycoords=("axes fraction", "data"), va="center", fontsize=7.5)
            continue
        bars = [[row.estimate.value - row.estimate.low], [row.estimate.high - row.estimate.value]]
        ax.errorbar(row.estimate.value, y, xerr=bars, fmt="none", color=look.colour, capsize=4, lw=1.6)
        edge = INK if look.fill == "full" else look.colour  # which makes it stand out from dots of its colour
        ax.plot(row.estimate.value, y, ls="", ms=5.5, mec=edge, **look.points)
    ax.set_yticks(range(len(rows)), [row.label for row in rows])
    ax.set_ylim(len(rows) - 0.4, -0.6)
    if log and any(row.estimate for row in rows):
        log_axis(ax, "x")


def _say_values(ax: Axes, rows: list[Row]) -> None:
    """Means as numbers at the right edge."""
    for y, row in enumerate(rows):
        if row.estimate:
            place: dict[str, Any] = {
                "xycoords": ("axes fraction", "data"),
                "textcoords": "offset points",
                "va": "center",
            }
            ax.annotate(number(row.estimate.value, 2), (1, y), (4, 0), fontsize=8, annotation_clip=False, **place)


def shortened(text: str, most: int = 30) -> str:
    """A text that fits into a panel; the whole of it stands in the notes."""
    return text if len(text) <= most else text[: most - 1] + "…"


def collect(
    evidence: Evidence,
    *,
    metrics: list[str],
    cells: Selector,
    log: bool = True,
    best: dict[str, float] | None = None,
    group: str | None = None,
    above: bool = False,
) -> Methods:
    """The methods that `cells` asks for, diverged ones named in their place; metrics that none has are left out.

    Args:
        group: of a fleet, the robots of this group alone.
        best: metric -> where a dotted line marks what cannot be bettered.
        above: show metrics above what they cannot go below.
    """
    methods = evidence.methods(cells)
    shown, alive = varying(methods), [method for method in methods if method.finished]
    kept = [name for name in metrics if any(has_metric(method.finished, name) for method in alive)]
    rows = [
        [_row(method, metric, shown, group, FLOORS.get(metric, 0) if above else 0) for method in methods]
        for metric in kept
    ]
    robots = any("robots" in method.counts() for method in alive)
    notes = [f"{method_name(m.axes, shown)}: {m.outcome}" for m in methods if m.lost]
    return Methods(kept, rows, "robot" if robots else "case", log, above, best or {},
                   [key for m in alive for key in m.keys] if kept else [], notes)  # fmt: skip


def _row(method: Method, metric: str, shown: list[str], group: str | None, floor: float) -> Row:
    label = method_name(method.axes, shown)
    if not method.finished:
        return Row(label, method.axes, None, np.empty(0), method.outcome)
    if not has_metric(method.finished, metric):
        return Row(label, method.axes, None, np.empty(0), "not scored")
    draws = method.runs.scalars(metric, group)
    dots = np.nanmean(draws.values, axis=-1) if "robot" in draws.levels else draws.values
    found = mean(draws, FLOORS.get(metric, 0))
    shown_above = Estimate(found.value - floor, found.low - floor, found.high - floor)
    return Row(label, method.axes, shown_above, dots.ravel() - floor, "")

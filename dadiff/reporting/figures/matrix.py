"""A matrix of one metric, two axes of choices: projector by enforcement. Diverged and lost cells say so."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dadiff.reporting.aggregation import Evidence, Method
from dadiff.reporting.figures.style import panels
from dadiff.reporting.labels import FLOORS, axis_value, metric_name, number
from dadiff.reporting.selection import Selector
from dadiff.reporting.statistics import Estimate, mean


@dataclass(frozen=True)
class Entry:
    """One cell: its estimate, or what became of it."""

    row: str
    column: str
    estimate: Estimate | None
    outcome: str


@dataclass(frozen=True)
class Matrix:
    """What the figure shows."""

    metric: str
    rows: list[str]
    columns: list[str]
    entries: list[Entry]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """Dark is a large error; every cell states its mean and its interval."""
        figure, (ax,) = panels(1, columns, width=1.8 + 1.02 * len(self.columns), height=1.1 + 0.5 * len(self.rows))
        values = [e.estimate.value for e in self.entries if e.estimate and e.estimate.value > 0]
        norm = LogNorm(min(values, default=1), max(values, default=1) * 1.0001, clip=True)
        for entry in self.entries:
            self._draw_entry(ax, entry, norm)
        ax.set_xlim(-0.5, len(self.columns) - 0.5)
        ax.set_ylim(len(self.rows) - 0.5, -0.5)
        ax.set_xticks(range(len(self.columns)), [name.replace(" ", "\n", 1) for name in self.columns])
        ax.set_yticks(range(len(self.rows)), self.rows)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set_title(metric_name(self.metric))
        return figure

    def _draw_entry(self, ax: Axes, entry: Entry, norm: LogNorm) -> None:
        x, y = self.columns.index(entry.column), self.rows.index(entry.row)
        if entry.estimate is None:
            ax.add_patch(_square(x, y, fill=False, ls=":", ec="#888888"))
            ax.annotate(_wrapped(entry.outcome), (x, y), ha="center", va="center", fontsize=6.5, style="italic")
            return
        face = colormaps["cividis_r"](float(norm(entry.estimate.value)))
        dark = np.dot(face[:3], (0.299, 0.587, 0.114)) < 0.55
        ax.add_patch(_square(x, y, fc=face, lw=0))
        text = f"{number(entry.estimate.value)}\n[{number(entry.estimate.low, 2)}, {number(entry.estimate.high, 2)}]"
        ax.annotate(text, (x, y), ha="center", va="center", fontsize=6.5, color="#ffffff" if dark else "#101010")


def _square(x: float, y: float, **look: Any) -> Rectangle:
    return Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, **look)


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, 14)[:3])


def collect(evidence: Evidence, *, rows: str, columns: str, metric: str, cells: Selector) -> Matrix:
    """Values of `metric` over the axes `rows` and `columns`; where other axes differ, the first method counts."""
    methods = [m for m in evidence.methods(cells) if rows in m.axes]
    names = [list(dict.fromkeys(axis_value(a, m.axes[a]) for m in methods if a in m.axes)) for a in (rows, columns)]
    found: dict[tuple[str, str], Entry] = {}
    for method in methods:
        place = axis_value(rows, method.axes[rows]), axis_value(columns, method.axes.get(columns, "none"))
        found.setdefault(place, _entry(*place, method, metric))
    every = list(dict.fromkeys([*names[1], *(column for _, column in found)]))
    lost = [f"{entry.row}, {entry.column}: {entry.outcome}" for entry in found.values() if entry.outcome]
    return Matrix(metric, names[0], every, list(found.values()), [k for m in methods for k in m.keys], lost)


def _entry(row: str, column: str, method: Method, metric: str) -> Entry:
    if not method.finished:
        return Entry(row, column, None, method.outcome)
    return Entry(row, column, mean(method.runs.scalars(metric), FLOORS.get(metric, 0)), "")

"""Theorem 1 along the chain: the Mahalanobis distance on the support of the law, and what lies off the support."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, varying
from dadiff.reporting.figures.style import (
    NAMED_HEIGHT,
    NAMED_WIDTH,
    Look,
    at_the_edge,
    drawn,
    label_ends,
    legend_below,
    letter,
    log_axis,
    looks_of,
    panels,
    tag,
)
from dadiff.reporting.labels import ROUNDING, joint, method_name
from dadiff.reporting.selection import Selector
from dadiff.reporting.sources import ReportedRun

PANELS = {
    "on_support": "squared distance on the support",
    "off_support": "squared distance off it",
    "grew_predict": "share that grew, prediction",
    "grew_project": "share that grew, projection",
}


@dataclass(frozen=True)
class Trace:
    """One run: step i of the chain, from noise to plan, and a value after its projection (shares: a half-step)."""

    label: str
    axes: dict[str, Any]
    steps: np.ndarray
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Chain:
    """What the figure shows."""

    traces: list[Trace]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """Sampling runs from left to right; distances are logarithmic, shares are from 0 to 1."""
        size = {"width": NAMED_WIDTH, "height": NAMED_HEIGHT} if columns > 1 else {}
        figure, axes = panels(len(PANELS), columns, **size)
        for ax, (name, title) in zip(axes, PANELS.items(), strict=True):
            self._draw_panel(ax, name, named=columns > 1)
            ax.set_title(title)
        letter(axes)
        legend_below(figure, axes)
        return figure

    def _draw_panel(self, ax: Axes, name: str, *, named: bool) -> None:
        looks = looks_of([trace.axes for trace in self.traces])
        distance, ends = name.endswith("support"), []
        for trace, look in _distinct(self.traces, looks, name):
            values = drawn(trace.values[name]) if distance else trace.values[name]
            (line,) = ax.plot(
                trace.steps, values, lw=1.2, ls=look.line, label=trace.label, markevery=0.12, ms=4, **look.points
            )
            tag(trace.label, line)
            if distance:
                at_the_edge(ax, trace.steps, trace.values[name], look, trace.label)
            ends.append((trace.label, float(np.nan_to_num(trace.values[name][-1])), look))
        ax.set_xscale("symlog", linthresh=10)  # most happens in the last steps
        ax.set_xticks([0, 5, 10, 100, 1000], ["0", "5", "10", "100", "1000"])
        ax.set_xlim(max(trace.steps.max() for trace in self.traces), -0.5)
        ax.set_xlabel("diffusion step i")
        if distance:
            log_axis(ax, "y")
        else:
            ax.set_ylim(-0.03, 1.03)
        if named:
            label_ends(ax, ends)


def _distinct(traces: list[Trace], looks: list[Look], name: str) -> list[tuple[Trace, Look]]:
    """Traces that no eye can tell apart in this panel as one, named after all of them."""
    found: list[tuple[Trace, Look]] = []
    for trace, look in zip(traces, looks, strict=True):
        for index, (other, first) in enumerate(found):
            if _coincide(trace.values[name], other.values[name]):
                found[index] = replace(other, label=joint(other.label, trace.label)), first
                break
        else:
            found.append((trace, look))
    return found


def _coincide(values: np.ndarray, others: np.ndarray) -> bool:
    return values.shape == others.shape and np.allclose(values, others, rtol=0.02, atol=ROUNDING, equal_nan=True)


def collect(evidence: Evidence, *, cells: Selector) -> Chain:
    """The first replicate of each method whose chain was followed, diverged ones as far as they came."""
    methods = evidence.methods(cells)
    followed = [(m, c) for m in methods for c in m.cells[:1] if c.has("chain")]
    shown = varying([m for m, _ in followed])
    traces = [_trace(cell, method_name(method.axes, shown), method.axes) for method, cell in followed]
    notes = [f"{method_name(m.axes, shown)}: {m.outcome}" for m in methods if m.lost]
    return Chain(traces, [cell.key for _, cell in followed], notes)


def _trace(cell: ReportedRun, label: str, axes: dict[str, Any]) -> Trace:
    table = cell.table("chain")
    stages = {name: table[table["stage"] == name].set_index("i") for name in ("predict", "project")}
    last = stages["project"] if len(stages["project"]) else stages["predict"]
    steps = _seen(stages["predict"].index.to_numpy())
    values = {name: last[name].reindex(steps).to_numpy() for name in ("on_support", "off_support")}
    grew = {f"grew_{name}": part["grew"].reindex(steps).to_numpy() for name, part in stages.items()}
    return Trace(label, axes, steps, values | grew)


def _seen(steps: np.ndarray) -> np.ndarray:
    """Of steps from noise to plan, those that the axis tells apart: all late ones, one in `APART` early."""
    place = np.floor(np.log(np.maximum(steps, EVERY) / EVERY) / APART)
    return steps[(np.diff(place, append=-1) != 0) | (steps < EVERY)]


EVERY, APART = 50, 0.02
"""Steps below the first are all drawn; above it, one in two percent."""

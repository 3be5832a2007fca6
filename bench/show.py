"""The table and the figure of what was measured."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.rows import Row


def slope(row: Row) -> float | None:
    """The exponent of cost over size, by least squares on logarithms; None for a single figure."""
    if len(row.points) < 2:
        return None
    size, cost = np.log(np.array(row.points)).T
    return float(np.polyfit(size, cost, 1)[0])


def table(rows: Sequence[Row]) -> str:
    """One line a row: ours, the other's, and how many times faster; or the exponent of a cost over sizes."""
    wide = max([46, *(len(row.name) + 1 for row in rows)])
    lines = [f"{'':<{wide}}{'ours':>12}{'other':>12}{'ratio':>9}  against"]
    for row in rows:
        other = "" if row.other is None else f"{row.other:.4g} {row.unit}"
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        lines.append(f"{row.name:<{wide}}{row.value:>9.4g} {row.unit:<2}{other:>12}{ratio:>9}  {told(row)}")
    return "\n".join(lines)


def markdown(rows: Sequence[Row], machine: str) -> str:
    """The table for the documentation."""
    lines = ["# Speed, measured", "", f"Measured by `python -m bench` on {machine}. Written by it; not edited.", ""]
    lines += ["| what | ours | other | ratio | against |", "|---|---|---|---|---|"]
    for row in rows:
        other = "" if row.other is None else f"{row.other:.4g} {row.unit}"
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        lines.append(f"| {row.name} | {row.value:.4g} {row.unit} | {other} | {ratio} | {told(row)} |")
    return "\n".join([*lines, ""])


def told(row: Row) -> str:
    """What it is compared with, or how it grows."""
    if (exponent := slope(row)) is None:
        return row.against
    last = slope(replace(row, points=row.points[-2:]))
    ends = f"{row.points[0][0]:g} to {row.points[-1][0]:g}"
    at_the_end = f", {last:.2f} at the end" if len(row.points) > 2 else ""
    return f"grows with exponent {exponent:.2f} over sizes {ends}{at_the_end}"


def draw(rows: Sequence[Row], file: Path) -> None:
    """Ratios as bars on a logarithmic scale, and the growing costs beside them, on a white panel of its own."""
    import matplotlib
    from matplotlib.figure import Figure

    from dadiff.reporting.figures.style import RC, legend_below, log_axis
    from dadiff.reporting.render import with_panel

    compared, growing = [row for row in rows if row.ratio], [row for row in rows if len(row.points) > 1]
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(10.5, 1.2 + 0.34 * max(len(compared), 8)), layout="constrained")
        bars, lines = figure.subplots(1, 2)
        _draw_ratios(bars, compared)
        _draw_growth(lines, growing)
        log_axis(bars, "x")
        for which in ("x", "y") if growing else ():
            log_axis(lines, which)
        legend_below(figure, [lines])
        text = io.BytesIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    file.write_bytes(with_panel(text.getvalue()))


def _draw_ratios(ax: Any, rows: Sequence[Row]) -> None:
    """One bar a row from 1, with its number."""
    places = range(len(rows))
    ratios = np.array([row.ratio for row in rows], dtype=np.float64)
    ax.barh(places, ratios - 1, left=1, color=np.where(ratios >= 1, "#00a68a", "#e57300"), height=0.6)
    look: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 7}
    for place, ratio in zip(places, ratios, strict=True):
        text = f"{ratio:.3g}" if ratio < 100 else f"{ratio:,.0f}"
        ax.annotate(text, (max(ratio, 1), place), (4, 0), **look)
    ax.set_yticks(places, [f"{row.name}\nagainst {row.against}" for row in rows], fontsize=7)
    ax.axvline(1, color="0.2", linewidth=0.8)
    ax.set(xlabel="times faster than the other, below 1 slower")
    ax.set_xlim(min([0.5, *(ratios / 2)]), 3 * max([1.0, *ratios]))
    ax.invert_yaxis()


def _draw_growth(ax: Any, rows: Sequence[Row]) -> None:
    """One line a row, named by what grows and how fast."""
    for row, marker in zip(rows, itertools.cycle("os^Dv"), strict=False):
        size, cost = np.array(row.points).T
        ax.plot(size, cost, marker=marker, label=f"{row.name} [{row.unit}]: exponent {slope(row):.2f}")
    ax.set(xlabel="size: horizon, state dimension, cells, runs", ylabel="cost")

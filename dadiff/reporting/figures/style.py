"""One look for all figures: the same colour and marker for the same projector everywhere.

The colours are those of Okabe and Ito, told apart by colour-blind readers, and of middling brightness so that
they stand out from a white page and from a dark one. `INK` is what text and axes are drawn with; the
HTML puts the page's own text colour in its place.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from dadiff.reporting.labels import SUPERSCRIPT, number

INK = "#2b2b2a"
COLOURS = {
    "none": "#888888",
    "known": "#0080c8",
    "hankel": "#dd5f00",
    "hankel_lowrank": "#009e73",
    "identified": "#cc6ba8",
    "rollout": "#c99700",
}
MARKERS = {"none": "o", "known": "s", "hankel": "^", "hankel_lowrank": "D", "identified": "v", "rollout": "P"}
LINES = {
    "post_hoc": (0, (5, 2)),
    "convex": (0, (1, 1.2)),
    "clean_estimate": (0, (4, 1.5, 1, 1.5)),
    "literal": (0, (8, 2)),
}
FILLS = ("full", "none")
VARIANTS = (((0, (2, 1.5)), "left"), ((0, (6, 1.5)), "bottom"), ((0, (3, 1, 1, 1)), "right"), ((0, (1, 3)), "top"))
OTHER = ("#5b5bd6", "X")
PANEL_WIDTH, PANEL_HEIGHT = 3.7, 2.75
CHARACTER = 0.072  # inches that a character of a legend takes, about
LEGEND_LINE = 0.17  # inches of height that a line of a legend takes
RC: dict[Any, Any] = {
    "svg.hashsalt": "dadiff",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "text.parse_math": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
}


@dataclass(frozen=True)
class Look:
    """How one method is drawn; `fill` is matplotlib's fillstyle of its markers."""

    colour: str
    marker: str
    line: Any
    fill: Any

    @property
    def points(self) -> dict[str, Any]:
        """Keywords for its markers."""
        return {"color": self.colour, "marker": self.marker, "fillstyle": self.fill, "markerfacecoloralt": "none"}


def look_of(axes: Mapping[str, Any]) -> Look:
    """Colour and marker say the projector, the line where it acts, a hollow marker that x(0) is held."""
    projector = axes.get("projector", "")
    colour, marker = COLOURS.get(projector, OTHER[0]), MARKERS.get(projector, OTHER[1])
    return Look(
        colour, marker, LINES.get(axes.get("enforcement", ""), "-"), FILLS[axes.get("initial_state") == "fixed"]
    )


def looks_of(methods: Sequence[Mapping[str, Any]], *, lines: bool = True) -> list[Look]:
    """As `look_of`; methods that would look alike get other lines and half filled markers, in their order.

    Args:
        lines: False where only markers are drawn, so that lines tell nothing apart.
    """
    plain = [look_of(axes) if lines else replace(look_of(axes), line="-") for axes in methods]
    looks: list[Look] = []
    for index, look in enumerate(plain):
        variant = plain[:index].count(look)
        line, fill = VARIANTS[(variant - 1) % len(VARIANTS)] if variant else (look.line, look.fill)
        looks.append(replace(look, line=line, fill=fill))
    return looks


def panels(
    count: int, columns: int, *, width: float = PANEL_WIDTH, height: float = PANEL_HEIGHT
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels in at most `columns` columns; they fill rows from the left."""
    columns = min(count, columns)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in grid[count:]:
        unused.remove()
    return figure, list(grid[:count])


def letter(axes: list[Axes]) -> None:
    """(a), (b), ... before the titles of several panels."""
    if len(axes) > 1:
        for index, ax in enumerate(axes):
            title = ax.get_title()
            ax.set_title("")
            ax.set_title(f"({chr(97 + index)}) {title}", loc="left")


def legend_below(figure: Figure, axes: list[Axes]) -> None:
    """One legend for all panels, under them, each label once, in as many columns as fit."""
    entries = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if entries:
        widest = CHARACTER * max(map(len, entries)) + 0.55
        columns = min(max(1, int(figure.get_figwidth() / widest)), len(entries))
        rows = -(-len(entries) // columns)
        figure.set_figheight(figure.get_figheight() + LEGEND_LINE * max(0, rows - 3))  # few fit into what is there
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns)


def log_axis(ax: Axes, which: Literal["x", "y"]) -> None:
    """A logarithmic axis whose labels are plain text; over little more than a decade, 2 and 5 are labelled, too."""
    ax.set(**{f"{which}scale": "log"})
    axis = ax.xaxis if which == "x" else ax.yaxis
    low, high = sorted(axis.get_view_interval())
    axis.set_major_formatter(FuncFormatter(lambda value, _: decade(value)))
    axis.set_minor_formatter(NullFormatter())
    if high / low < 1.5:
        axis.set_major_locator(MaxNLocator(4))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if value > 1e-3 else number(value, 3)))
        axis.set_minor_locator(NullLocator())
    elif high / low < 25:
        fine = high / low < 3
        axis.set_minor_locator(LogLocator(subs=(1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 4, 5, 6, 8) if fine else (2, 5)))
        axis.set_minor_formatter(
            FuncFormatter(lambda value, _: f"{value:g}" if 1e-3 < value < 1e4 else number(value, 2 if fine else 1))
        )


def decade(value: float) -> str:
    """A power of ten as a tick's label.

    Example:
        >>> decade(1e-5), decade(0.1)
        ('10⁻⁵', '0.1')
    """
    exponent = round(math.log10(value))
    return f"{value:g}" if -2 <= exponent <= 3 else f"10{str(exponent).translate(SUPERSCRIPT)}"


class Drawable(Protocol):
    """What every kind of figure collects."""

    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """The figure with panels in at most so many columns."""
        ...


METADATA: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
    "svg": {"Date": None, "Creator": None, "Format": None, "Type": None},
    "png": {"Software": None},
}
"""None keeps dates and versions out."""


def render(plotted: Drawable, columns: int, forms: Sequence[str]) -> dict[str, bytes]:
    """The figure as pdf, svg or png; the same numbers give the same bytes. The layout is found once for all forms."""
    rendered = {}
    with matplotlib.rc_context(RC):
        figure = plotted.draw(columns)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for form in forms:
            buffer = io.BytesIO()
            figure.savefig(buffer, format=form, dpi=160, transparent=form == "svg", metadata=METADATA[form])
            rendered[form] = buffer.getvalue()
    return rendered

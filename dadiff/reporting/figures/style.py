"""One look for all figures: the same colour and marker for the same projector everywhere.

The colours are told apart by colour-blind readers (a CIE difference of 25 or more under deuteranopia and protanopia)
and of middling brightness, so that they stand out from a white page and from a dark one, 3 : 1 or more. `INK` is what
text, axes and vanilla diffusion are drawn with; the HTML puts the page's own text colour in its place.

What is drawn of a method is tagged with its name, and its values where they are points, so that the page can hide it
and say what it is.
"""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol
from weakref import WeakKeyDictionary

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import CARETDOWN
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator, ScalarFormatter

from dadiff.reporting.labels import ROUNDING, SUPERSCRIPT, number

INK = "#2b2b2a"
COLOURS = {
    "none": INK,
    "known": "#4d4dff",
    "hankel": "#e57300",
    "hankel_lowrank": "#00a68a",
    "identified": "#9785f2",
    "rollout": "#99522e",
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
OTHER = ("#2a6c8c", "X")
SPARE = ("*", "h", "p", "<", ">", "8", "d", "H")
PANEL_WIDTH, PANEL_HEIGHT = 3.7, 2.75
NAMED_WIDTH, NAMED_HEIGHT = 5.2, 2.3  # of a panel with names at its curves
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
    """As `look_of`; methods that would look alike get other lines, half filled markers, then other markers.

    Args:
        lines: False where only markers are drawn, so that lines tell nothing apart.
    """
    looks: list[Look] = []
    for axes in methods:
        plain = look_of(axes) if lines else replace(look_of(axes), line="-")
        looks.append(next(look for look in _variants(plain, lines=lines) if look not in looks))
    return looks


def _variants(plain: Look, *, lines: bool) -> Iterator[Look]:
    """The look itself, then others of its colour, no two alike."""
    if not lines:
        yield from (replace(plain, marker=marker) for marker in (plain.marker, *SPARE))
    for marker in (plain.marker, *SPARE):
        yield replace(plain, marker=marker)
        for line, fill in VARIANTS:
            yield replace(plain, marker=marker, line=line if lines else plain.line, fill=fill)
    yield from (replace(plain, marker=f"${number}$") for number in itertools.count(1))


def tag(label: str, *artists: Artist, values: bool = False) -> None:
    """Says whose artists these are; of a line, its points if they are to be read off."""
    for artist in artists:
        told = ""
        if values and isinstance(artist, Line2D):
            told = "|" + ";".join(f"{x:.4g},{y:.4g}" for x, y in np.asarray(artist.get_xydata()))
        artist.set_gid(f"{TAG}{label.replace('|', '/')}{told}")


TAG = "method:"


def drawn(values: np.ndarray, below: float = ROUNDING) -> np.ndarray:
    """Values that a logarithmic axis can show; nan where they are 0, rounding (`below`) or undefined."""
    shown: np.ndarray = np.where(np.nan_to_num(values) > below, values, np.nan)
    return shown


def at_the_edge(ax: Axes, x: np.ndarray, values: np.ndarray, look: Look, label: str, below: float = ROUNDING) -> None:
    """Values at rounding level (`below`) as marks on the lower edge of an axis whose limits they leave alone."""
    rounding = (values <= below) & ~np.isnan(values)
    if rounding.any():
        low = np.zeros(int(rounding.sum()))
        (marks,) = ax.plot(
            x[rounding], low, ls="", marker=CARETDOWN, ms=5, color=look.colour, clip_on=False,
            transform=ax.get_xaxis_transform(), scalex=False, scaley=False,
        )  # fmt: skip
        tag(label, marks)


def label_ends(ax: Axes, ends: Sequence[tuple[str, float, Look]]) -> None:
    """Names at the right ends of curves: (label, y, look), moved apart where they would overlap.

    Curves that end below the axis are named at its lower edge. More names than fit are left to the legend.
    """
    names = ["\n".join(textwrap.wrap(label, WRAPPED)) for label, _, _ in ends]
    if 0 < sum(1 + name.count("\n") for name in names) <= MOST_LINES:
        _name(ax, [label for label, _, _ in ends], lambda ax: _place_ends(ax, ends))


def _place_ends(ax: Axes, ends: Sequence[tuple[str, float, Look]]) -> None:
    tagged = {label for handle, label in zip(*ax.get_legend_handles_labels(), strict=True) if _tagged(handle)}
    ordered = sorted(((_place(ax, y), label, look) for label, y, look in ends), key=lambda end: end[0])
    names = ["\n".join(textwrap.wrap(label, WRAPPED)) for _, label, _ in ordered]
    places = _apart([place for place, _, _ in ordered], [LABEL_GAP * (1 + name.count("\n")) for name in names])
    style: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "fontsize": 7, "va": "center"}
    for (_, label, look), name, place in zip(ordered, names, places, strict=True):
        square = "□" if look.fill == "none" else "■"
        tag(label, ax.annotate(square, (1, place), (3, 0), color=look.colour, **style))
        text = ax.annotate(name, (1, place), (12, 0), **style)
        text.set_gid(f"{CHOICE if label in tagged else TAG}{label}")


def _place(ax: Axes, y: float) -> float:
    """Where a value lies on an axis, from 0 at its lower to 1 at its upper edge."""
    low, high = ax.get_ylim()
    if ax.get_yscale() == "log":
        low, high, y = math.log10(low), math.log10(high), math.log10(max(y, low))
    return min(max((y - low) / (high - low), 0.0), 1.0)


def label_points(ax: Axes, points: Sequence[tuple[str, float, float, Look]], *, beside: bool = False) -> None:
    """Names to the right of points (label, x, y, look), moved apart where they would overlap; room is made for them.

    Args:
        beside: the names stand beside the panel, since there are other points.
    """
    low, high = ax.get_xlim()
    if not beside:
        ax.set_xlim(low, high * (high / low) ** POINT_ROOM)
    _name(ax, [label for label, *_ in points], lambda ax: _place_points(ax, points, beside=beside))


def _place_points(ax: Axes, points: Sequence[tuple[str, float, float, Look]], *, beside: bool) -> None:
    low, high = map(math.log10, ax.get_xlim())
    ordered = sorted(points, key=lambda point: point[2])
    places = _apart([_place(ax, y) for _, _, y, _ in ordered], [POINT_GAP] * len(ordered))
    for (label, x, y, look), place in zip(ordered, places, strict=True):
        line = {"arrowstyle": "-", "color": look.colour, "lw": 0.6, "shrinkA": 0, "relpos": (0, 0.5)}
        near = [other for _, other, level, _ in points if 1 <= other / x < CLUSTER and 1 / 10 < level / y < 10]
        right = 1.02 if beside else (math.log10(max(near)) - low) / (high - low) + 0.03
        text = ax.annotate(
            label, (x, y), (right, place), textcoords="axes fraction", fontsize=7.5, va="center", arrowprops=line
        )
        text.set_gid(f"{CHOICE}{label}")


def _name(ax: Axes, labels: Sequence[str], place: Callable[[Axes], None]) -> None:
    _NAMED[ax] = set(labels), place
    place(ax)


_NAMED: WeakKeyDictionary[Axes, tuple[set[str], Callable[[Axes], None]]] = WeakKeyDictionary()
"""What is named in a panel, and how it is placed, which is done anew when an axis becomes linear."""

POINT_GAP, POINT_ROOM, CLUSTER = 0.062, 0.3, 1.8
SIDE = 0.15
"""Inches at the sides of a panel with names beside it, which are a little wider at other resolutions."""
MOST_LINES, LABEL_GAP, WRAPPED = 12, 0.075, 46


def _apart(places: list[float], heights: list[float]) -> list[float]:
    """Ascending places moved up and then, from the top, down, until what has these heights does not overlap."""
    gaps = [(one + other) / 2 for one, other in itertools.pairwise(heights)]
    places[:1] = [max(place, (height - LABEL_GAP) / 2) for place, height in zip(places[:1], heights, strict=False)]
    for index, gap in enumerate(gaps):
        places[index + 1] = max(places[index + 1], places[index] + gap)
    top = 1.0
    for index in reversed(range(len(places))):
        places[index] = min(places[index], top)
        top = places[index] - (gaps[index - 1] if index else 0)
    return places


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
    """One legend for all panels, under them, each label once, in as many columns as fit; not what stands at curves."""
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
        if label not in _NAMED.get(ax, (set(), None))[0]
    }
    tagged = {label for label, handle in entries.items() if _tagged(handle)}
    if entries:
        widest = CHARACTER * max(map(len, entries)) + 0.55
        columns = min(max(1, int(figure.get_figwidth() / widest)), len(entries))
        rows = -(-len(entries) // columns)
        figure.set_figheight(figure.get_figheight() + LEGEND_LINE * max(0, rows - 3))  # few fit into what is there
        legend = figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns)
        for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True):
            if handle is not None and text.get_text() in tagged:
                tag(text.get_text(), handle)
                text.set_gid(f"{CHOICE}{text.get_text()}")


CHOICE = "choice:"
"""A legend's entry, which the page makes a switch."""


def _tagged(artist: Any) -> bool:
    return isinstance(artist, Artist) and str(artist.get_gid() or "").startswith(TAG)


def headline(figure: Figure, found: str) -> None:
    """What a figure found, above it, wrapped to its width."""
    if found:
        width = int(figure.get_figwidth() / (1.15 * CHARACTER))
        text = "\n".join(textwrap.wrap(found, width))
        figure.set_figheight(figure.get_figheight() + LEGEND_LINE * (1 + text.count("\n")))
        figure.suptitle(text, x=0.01, ha="left", fontsize=9.5, fontweight="bold")


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


def render(plotted: Drawable, columns: int, forms: Sequence[str], *, linear: bool = False) -> dict[str, bytes]:
    """The figure as pdf, svg or png; the same numbers give the same bytes. The layout is found once for all forms.

    Args:
        linear: with linear axes in place of logarithmic ones; nothing if there is none.
    """
    rendered = {}
    with matplotlib.rc_context(RC):
        figure = plotted.draw(columns)
        if linear and not _to_linear(figure):
            return {}
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        for form in forms:
            buffer = io.BytesIO()
            figure.savefig(buffer, format=form, dpi=160, transparent=form == "svg", metadata=METADATA[form])
            rendered[form] = buffer.getvalue()
    return rendered


def _to_linear(figure: Figure) -> bool:
    """Whether there was an axis to change."""
    found = [ax for ax in figure.axes if ax.get_yscale() == "log"]
    for ax in found:
        ax.set_yscale("linear")
        ax.yaxis.set_major_formatter(ScalarFormatter())
        ax.relim()
        ax.autoscale(axis="y")
        ax.set_ylim(bottom=0)
        if ax in _NAMED:
            for text in [text for text in ax.texts if str(text.get_gid() or "").startswith((TAG, CHOICE))]:
                text.remove()
            _NAMED[ax][1](ax)
    return bool(found)

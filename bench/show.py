"""The table and the figure of what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
    lines = [f"{'':<46}{'ours':>12}{'other':>12}{'ratio':>9}  against"]
    for row in rows:
        other = "" if row.other is None else f"{row.other:.3g} {row.unit}"
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        told = row.against
        if (exponent := slope(row)) is not None:
            told = f"grows with exponent {exponent:.2f} over sizes {row.points[0][0]:g} to {row.points[-1][0]:g}"
        lines.append(f"{row.name:<46}{row.value:>9.3g} {row.unit:<2}{other:>12}{ratio:>9}  {told}")
    return "\n".join(lines)


def draw(rows: Sequence[Row], file: Path) -> None:
    """Ratios as bars on a logarithmic scale, and the growing costs beside them."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "dadiff"
    from matplotlib import pyplot

    compared, growing = [row for row in rows if row.ratio], [row for row in rows if len(row.points) > 1]
    figure, (bars, lines) = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    names = [f"{row.name}\nagainst {row.against}" for row in compared]
    bars.barh(names, [row.ratio for row in compared], color="0.45")
    bars.axvline(1, color="black", linewidth=0.8)
    bars.set(xscale="log", xlabel="times faster (a floor's ratio is below 1)")
    bars.tick_params(axis="y", labelsize=7)
    bars.invert_yaxis()
    for row in growing:
        size, cost = np.array(row.points).T
        lines.loglog(size, cost, "o-", label=f"{row.name} [{row.unit}], exponent {slope(row):.2f}")
    lines.set(xlabel="size", ylabel="cost")
    if growing:
        lines.legend(fontsize=7)
    figure.savefig(file, metadata={"Date": None})
    pyplot.close(figure)

"""A picture of plans: every channel against time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dadiff.errors import DataError
from dadiff.planning.plans import Plans

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, HEIGHT = 8.0, 3.0  # inches; the height is that of a panel


def draw(plans: Plans, path: Path) -> Path:
    """Write a picture with a panel for the states and one for the inputs; the suffix chooses the format.

    Raises:
        DataError: if the suffix is no format, or the place cannot be written to.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 2 * HEIGHT), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    step = plans.time_step or 1.0
    _lines(above, plans, "x", step)
    _lines(below, plans, "u", step)
    below.set_xlabel("time (s)" if plans.time_step else "step t")
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: the picture cannot be written ({error}); name a file ending in .png or .svg"
        ) from error
    return path


def _lines(axes: Axes, plans: Plans, name: str, step: float) -> None:
    """One colour for each entry of a channel, one line for each plan; inputs are held between steps."""
    values = plans.layout.get(plans.tau, name).reshape(-1, *plans.layout.channel(name).shape)
    seconds = step * np.arange(values.shape[1])
    for k, label in enumerate(plans.columns(name)):
        for sample, line in enumerate(values[..., k]):
            axes.plot(
                seconds,
                line,
                color=f"C{k}",
                alpha=max(0.15, 1 / len(values)),
                label=label if sample == 0 else None,
                drawstyle="steps-post" if name == "u" else "default",
            )
    axes.set_ylabel({"x": "states", "u": "inputs"}[name])
    legend = axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1)

"""The two processes of diffusion on one trajectory: Fig. 1 of the paper.

Clean, half noised, noised, half denoised, generated: positions only, start and end marked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence
from dadiff.reporting.figures.style import legend_below, panels
from dadiff.reporting.selection import Selector


@dataclass(frozen=True)
class Stage:
    """Positions (T+1, 2) at one step of a process."""

    title: str
    positions: np.ndarray


@dataclass(frozen=True)
class Diffusion:
    """What the figure shows, in the order of the two processes."""

    stages: list[Stage]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """Five small panels in a row, or two a row; each with its own window, equal axes."""
        figure, axes = panels(len(self.stages), 5 if columns > 1 else 2, width=1.75, height=2.05)
        for ax, stage in zip(axes, self.stages, strict=True):
            _draw_stage(ax, stage)
        legend_below(figure, axes)
        return figure


def _draw_stage(ax: Axes, stage: Stage) -> None:
    path = stage.positions
    ax.plot(*path.T, "-", color="#8a8a8a", lw=0.6)
    ax.plot(*path[1:-1].T, "o", color="#0080c8", ms=2.6, mew=0, label="between")
    ax.plot(*path[0], "o", color="#d03a2b", ms=5.5, mew=0, label="x(0)")
    ax.plot(*path[-1], "s", color="#009e73", ms=5.5, mew=0, label="x(T)")
    middle, half = (path.max(0) + path.min(0)) / 2, 0.56 * max(np.ptp(path, axis=0).max(), 1e-3)
    ax.set_xlim(middle[0] - half, middle[0] + half)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal")
    ax.set_title(stage.title)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(True)


def collect(evidence: Evidence, *, cells: Selector) -> Diffusion:
    """The first finished cell whose chain was kept; none of systems that have no plane."""
    finished = [c for m in evidence.methods(cells) for c in m.finished if "chain_states" in c.examples]
    kept = [c for c in finished if c.examples["chain_states"].shape[-1] >= 2]
    if not kept:
        return Diffusion([], [], [])
    stored = kept[0].examples
    order = np.argsort(stored["chain_steps"])
    steps = stored["chain_steps"][order]
    noised, denoised = stored["noised_states"][order][..., :2], stored["chain_states"][order][..., :2]
    half = len(steps) // 2
    stages = [
        Stage("clean", stored["reference_states"].reshape(-1, *stored["reference_states"].shape[-2:])[0, :, :2]),
        Stage(f"noised, i = {steps[half]}", noised[half]),
        Stage(f"noise, i = {steps[-1]}", noised[-1]),
        Stage(f"denoised, i = {steps[half]}", denoised[half]),
        Stage("generated", denoised[0]),
    ]
    return Diffusion(stages, [kept[0].key], [])

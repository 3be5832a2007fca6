"""A run's plans as a picture for MLflow's pages, drawn from its examples: every state against time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dadiff.store import StoredRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_PANELS, MOST_PLANS = 6, 20
PANEL = (2.6, 1.7)  # inches
PLAN, REFERENCE = "#4d4dff", "#2b2b2a"


def plans(run: StoredRun) -> np.ndarray | None:
    """An RGB picture of the plans of the first case beside its reference; None where the run keeps no examples."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    examples = run.arrays()
    if "states" not in examples:
        return None
    states = examples["states"]
    drawn = states.reshape(-1, *states.shape[-3:])[0]  # (samples, T + 1, n) of the first case
    reference = examples.get("reference_states")
    names = [str(name) for name in examples.get("state_names", [f"x{k}" for k in range(drawn.shape[-1])])]
    panels = min(MOST_PANELS, drawn.shape[-1])
    columns = min(panels, 2)
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * -(-panels // columns)), layout="constrained", dpi=100)
    canvas = FigureCanvasAgg(figure)
    for k, ax in enumerate(figure.subplots(-(-panels // columns), columns, squeeze=False).ravel()[:panels]):
        wanted = None if reference is None else reference.reshape(-1, *reference.shape[-2:])[0][:, k]
        _panel(ax, drawn[:MOST_PLANS, :, k], wanted, names[k])
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _panel(ax: Axes, values: np.ndarray, reference: np.ndarray | None, name: str) -> None:
    """Plans as thin lines, the reference dashed over them."""
    ax.plot(values.T, color=PLAN, lw=0.8, alpha=max(0.25, 1 / len(values)))
    if reference is not None:
        ax.plot(reference, color=REFERENCE, lw=1.2, ls="--")
    ax.set_title(name, fontsize=8, loc="left")
    ax.tick_params(labelsize=7)

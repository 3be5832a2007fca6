"""A run's plans as a picture for MLflow's pages, drawn from its examples: every state against time.

Drawn by hand: one a run, it would take matplotlib longer than everything else that is mirrored of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dadiff.store import StoredRun

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

MOST_PANELS, MOST_PLANS, DASHES = 6, 20, 12
WIDTH, HEIGHT, LABEL = 260, 170, 11  # of a panel and of letters, in pixels
LEFT, TOP, RIGHT, BOTTOM = 44, 22, 250, 148  # of a panel's frame
FINER = 3  # lines are drawn at three times the size, so that they come out smooth
PLAN, REFERENCE, FRAME = (77, 77, 255), (43, 43, 42), (140, 140, 140)


def plans(run: StoredRun) -> np.ndarray | None:
    """An RGB picture of the plans of the first case beside its reference; None where the run keeps no examples."""
    from PIL import Image, ImageDraw

    examples = run.arrays()
    if "states" not in examples:
        return None
    states = examples["states"]
    drawn = states.reshape(-1, *states.shape[-3:])[0, :MOST_PLANS]  # (samples, T + 1, n) of the first case
    reference = examples.get("reference_states", drawn[:0])
    wanted = reference.reshape(-1, *reference.shape[-2:])[:1]
    names = [str(name) for name in examples.get("state_names", [f"x{k}" for k in range(drawn.shape[-1])])]
    panels = min(MOST_PANELS, drawn.shape[-1])
    columns = min(panels, 2)
    picture = Image.new("RGB", (FINER * WIDTH * columns, FINER * HEIGHT * -(-panels // columns)), "white")
    for k in range(panels):
        corner = np.array([WIDTH * (k % columns), HEIGHT * (k // columns)])
        _panel(ImageDraw.Draw(picture, "RGBA"), corner, drawn[..., k], wanted[..., k], names[k])
    return np.asarray(picture.reduce(FINER))


def _panel(draw: ImageDraw, corner: np.ndarray, values: np.ndarray, wanted: np.ndarray, name: str) -> None:
    """Plans (samples, T+1) as thin lines, the reference (0 or 1, T+1) dashed over them, and the range of each axis."""
    from PIL import ImageFont

    font, last = ImageFont.load_default(FINER * LABEL), values.shape[-1] - 1
    shown = np.nan_to_num(np.concatenate([values, wanted]))
    low, high = shown.min(), shown.max()
    x = np.linspace(LEFT, RIGHT, last + 1)
    y = BOTTOM - 4 - (BOTTOM - TOP - 8) * (shown - low) / (high - low or 1.0)
    lines = FINER * (corner + np.stack(np.broadcast_arrays(x, y), axis=-1))
    colour = (*PLAN, int(255 * max(0.25, 1 / len(values))))
    for line in lines[: len(values)]:
        draw.line(line.ravel().tolist(), fill=colour, width=FINER)
    dash = max(1, last // DASHES)
    for line in lines[len(values) :]:
        for first in range(0, last, 2 * dash):
            draw.line(line[first : first + dash + 1].ravel().tolist(), fill=REFERENCE, width=FINER + 1)
    frame = FINER * (np.tile(corner, 2) + np.array([LEFT, TOP, RIGHT, BOTTOM]))
    draw.rectangle(frame.tolist(), outline=FRAME, width=2)
    texts = [(name, (LEFT, TOP - 3), "ls"), ("0", (LEFT, BOTTOM + 3), "mt"), (str(last), (RIGHT, BOTTOM + 3), "mt")]
    texts += [(f"{low:.3g}", (LEFT - 4, BOTTOM), "rs"), (f"{high:.3g}", (LEFT - 4, TOP), "rt")]
    for text, place, anchor in texts:
        draw.text(tuple(FINER * (corner + place)), text, fill=REFERENCE, font=font, anchor=anchor)

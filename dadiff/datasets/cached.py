"""A part of a data set on disk: plain arrays and notes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dadiff.outside import json_of, npz
from dadiff.tasks import Cases, Demonstrations


def save_data(folder: Path, draw: Callable[[], Demonstrations | Cases]) -> None:
    """Draw, and write the arrays into `data.npz` and the notes into `notes.json`."""
    data = draw()
    (folder / "notes.json").write_text(json.dumps(data.notes, indent=1) + "\n")
    arrays = {name: value for name, value in vars(data).items() if isinstance(value, np.ndarray)}
    np.savez(folder / "data.npz", **arrays)  # type: ignore[arg-type]


def load_data(folder: Path) -> dict[str, Any]:
    """The fields that `save_data` wrote: all but the layout of E, which is the task's to say."""
    with npz(folder / "data.npz") as data:
        return {**data, "notes": json_of(folder / "notes.json")}

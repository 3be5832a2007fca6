"""A data set on disk: demonstrations and cases in one folder, as plain arrays and notes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dadiff.tasks import Cases, Demonstrations


def save_data(folder: Path, train: Demonstrations, test: Cases) -> None:
    """Write both into `data.npz` and `notes.json`."""
    np.savez(
        folder / "data.npz",
        trajectories=train.trajectories,
        environment=train.environment,
        test_environment=test.environment,
        test_x_init=test.x_init,
        test_reference=test.reference,
    )
    (folder / "notes.json").write_text(json.dumps({"train": train.notes, "test": test.notes}, indent=1) + "\n")


def load_data(folder: Path) -> tuple[Demonstrations, Cases]:
    """What `save_data` wrote."""
    notes = json.loads((folder / "notes.json").read_text())
    with np.load(folder / "data.npz", allow_pickle=False) as data:
        train = Demonstrations(data["trajectories"], data["environment"], notes["train"])
        test = Cases(data["test_environment"], data["test_x_init"], data["test_reference"], notes["test"])
    return train, test

"""Sweeps on disk: `sweeps/<name>/sweep.json` says which cells a sweep has, and how each ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dadiff.store.files import make_folder, read_json, write_json


@dataclass(frozen=True)
class Cell:
    """One cell of a sweep.

    Args:
        status: "waiting" until it ended, then the status of its run, or "interrupted".
        reason: why it failed.
    """

    key: str
    name: str
    axes: dict[str, Any] = field(default_factory=dict)
    status: str = "waiting"
    reason: str | None = None


@dataclass(frozen=True)
class Sweep:
    """A sweep's definition and its cells, each key once.

    Args:
        command: what a person types to run or resume it.
        definition: parameter -> what it ranges over, as given.
    """

    name: str
    command: str
    definition: dict[str, str]
    cells: Sequence[Cell]


class Sweeps:
    """The sweeps below an output folder."""

    def __init__(self, output_dir: Path | str) -> None:
        self.root = Path(output_dir).absolute() / "sweeps"

    def folder(self, name: str) -> Path:
        """Where a sweep's record and logs lie."""
        return self.root / name

    def names(self) -> list[str]:
        """The names of all stored sweeps."""
        return sorted(path.parent.name for path in self.root.glob("*/sweep.json"))

    def write(self, sweep: Sweep) -> Path:
        """Store a sweep in place of an older one of its name."""
        folder = make_folder(self.folder(sweep.name))
        write_json(folder / "sweep.json", asdict(sweep))
        return folder

    def read(self, name: str) -> Sweep:
        """One stored sweep.

        Raises:
            DataError: if there is none of this name, or its record is damaged.
            StoreError: if its format is newer than this version reads.
        """
        stored = read_json(self.folder(name) / "sweep.json")
        cells = [Cell(**cell) for cell in stored["cells"]]
        return Sweep(stored["name"], stored["command"], stored["definition"], cells)

"""`tracking.json` beside what was logged: which MLflow run mirrors it in which store, and whether wholly.

A marker that is not complete names a run whose logging was cut short. Logging it again writes the same
numbers with the same times into the same run, which MLflow keeps once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dadiff.store.files import read_json, write_json

MARKER = "tracking.json"


@dataclass(frozen=True)
class Marker:
    """The MLflow run that mirrors a folder in one store."""

    run_id: str
    experiment_id: str
    complete: bool


def read_marker(folder: Path, uri: str) -> Marker | None:
    """The marker of a folder for one store; None if nothing was logged to that store."""
    stored = _read(folder).get(uri)
    return Marker(**stored) if stored else None


def stores(folder: Path) -> list[str]:
    """The uris of the stores that a folder was logged to."""
    return list(_read(folder))


def write_marker(folder: Path, uri: str, marker: Marker) -> None:
    """Set the marker of a folder for one store, leaving those for other stores alone."""
    write_json(folder / MARKER, {"stores": {**_read(folder), uri: vars(marker)}})


def _read(folder: Path) -> dict[str, dict[str, Any]]:
    return read_json(folder / MARKER)["stores"] if (folder / MARKER).is_file() else {}

"""`tracking.json` beside what was logged: which MLflow run mirrors it in which store, and whether wholly.

A marker that is not complete names a run whose logging was cut short. Logging it again writes the same
numbers with the same times into the same run, which MLflow keeps once.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from dadiff.errors import DataError
from dadiff.store.files import write_json
from dadiff.store.typed import read_typed

MARKER = "tracking.json"
IDENTIFIER = re.compile(r"[\w-]{1,64}")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Marker:
    """The MLflow run that mirrors a folder in one store."""

    run_id: str
    experiment_id: str
    complete: bool

    def __post_init__(self) -> None:
        for identifier in (self.run_id, self.experiment_id):
            if not IDENTIFIER.fullmatch(identifier):
                raise ValueError(f"{identifier[:80]!r} is no id of MLflow's")


@dataclass(frozen=True)
class Markers:
    """`tracking.json`: a marker for each store, by its uri."""

    stores: Mapping[str, Marker]


def read_marker(folder: Path, uri: str) -> Marker | None:
    """The marker of a folder for one store; None if nothing was logged to that store."""
    return read_markers(folder).get(uri)


def stores(folder: Path) -> list[str]:
    """The uris of the stores that a folder was logged to."""
    return list(read_markers(folder))


def write_marker(folder: Path, uri: str, marker: Marker) -> None:
    """Set the marker of a folder for one store, leaving those for other stores alone."""
    markers = {**read_markers(folder), uri: marker}
    write_json(folder / MARKER, {"stores": {name: asdict(one) for name, one in markers.items()}})


def read_markers(folder: Path) -> Mapping[str, Marker]:
    """uri -> marker; none where the file is absent, or so damaged that what it says is logged again."""
    path = folder / MARKER
    if not path.exists():
        return {}
    try:
        return read_typed(path, Markers).stores
    except DataError as error:
        log.warning("%s", error)
        return {}

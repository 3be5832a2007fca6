"""What a store that is a file holds, read from the database itself: nothing is asked or changed, MLflow not loaded."""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dadiff.tracking.content import Piece
from dadiff.tracking.views import STATE, run_page, table_page

LOCAL_UI = "http://127.0.0.1:5000"
"""Where `mlflow ui` answers."""
PARENT = "mlflow.parentRunId"
IDENTITY = ("store", "kind", "key")
"""Tags that say what a run mirrors."""

EXPERIMENT = "SELECT experiment_id FROM experiments WHERE name = ? AND lifecycle_stage = 'active'"
VIEWS = "SELECT key FROM experiment_tags WHERE experiment_id = ?"
TAGS = """
SELECT runs.run_uuid, tags.key, tags.value FROM runs JOIN tags ON tags.run_uuid = runs.run_uuid
WHERE runs.lifecycle_stage = 'active' AND runs.experiment_id = ?
"""
RUNS = """
SELECT tags.value, runs.experiment_id, runs.run_uuid FROM runs JOIN tags ON tags.run_uuid = runs.run_uuid
WHERE tags.key = 'key' AND runs.lifecycle_stage = 'active'
"""
TABLES = "SELECT experiment_id FROM experiment_tags WHERE key = ?"


@dataclass(frozen=True)
class Held:
    """What an experiment of a store holds.

    Args:
        tags: id of an MLflow run -> its tags.
        mirrored: (output folder's id, kind, key) -> the ids of the runs that mirror this piece.
        views: names of states of the pages.
    """

    experiment_id: str
    tags: Mapping[str, Mapping[str, str]]
    mirrored: Mapping[tuple[str | None, ...], Sequence[str]]
    views: frozenset[str]

    def whole(self, store: str, piece: Piece, parent: str | None = None) -> str | None:
        """The id of the one run that mirrors a piece as it lies on disk; None if that, or its parent, is another."""
        found = self.mirrored.get((store, piece.kind, piece.key), [])
        if len(found) != 1 or self.tags[found[0]].get("stamp") != piece.stamp:
            return None
        return found[0] if parent is None or self.tags[found[0]].get(PARENT) == parent else None


def held(path: Path, experiment: str) -> Held | None:
    """What the database says of an experiment; None if there is none of this name, or it cannot be read."""
    found = asked(path, EXPERIMENT, experiment)
    if not found:
        return None
    (experiment_id,) = found[0]
    tags, mirrored = defaultdict[str, dict[str, str]](dict), defaultdict[tuple[str | None, ...], list[str]](list)
    for run_id, name, value in asked(path, TAGS, experiment_id):
        tags[run_id][name] = value
    for run_id, its in tags.items():
        mirrored[tuple(map(its.get, IDENTITY))].append(run_id)
    views = frozenset(name for (name,) in asked(path, VIEWS, experiment_id))
    return Held(str(experiment_id), tags, mirrored, views)


def pages(output_dir: Path) -> dict[str, str]:
    """Key of a run -> its page in the UI that is opened on the folder's own database; empty if there is none."""
    found = asked(output_dir.absolute() / "mlflow.db", RUNS)
    return {key: LOCAL_UI + run_page(str(experiment), run) for key, experiment, run in found}


def table(output_dir: Path, sweep: str) -> str | None:
    """The page of a sweep's table of runs in that UI; None where the database shows no such sweep."""
    found = asked(output_dir.absolute() / "mlflow.db", TABLES, STATE + sweep)
    return LOCAL_UI + table_page(str(found[0][0]), sweep) if found else None


def asked(path: Path, question: str, *values: Any) -> list[Any]:
    """The answer's rows; none of a database that is not there or damaged, which is told of when it is written to."""
    if not path.is_file():
        return []
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as connection:
            return connection.execute(question, values).fetchall()
    except sqlite3.Error:
        return []

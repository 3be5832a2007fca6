"""Brings a sweep back from MLflow into the format of the results folder, for reports where only the store is at hand.

Weights and arrays are not in MLflow: what needs example trajectories cannot be drawn from a download.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.errors import StoreError
from dadiff.store import Results, Sweep, Sweeps, SweptRun
from dadiff.store.files import make_folder
from dadiff.store.names import file_name, key_of
from dadiff.store.record import read_record
from dadiff.store.results import RECORD
from dadiff.tracking.client import open_client, refused
from dadiff.tracking.mirror import search

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run


def download(uri: str, name: str, folder: Path) -> Sweep:
    """Write the runs under the parent run `name`, or those of the experiment `name`, as a results folder.

    Raises:
        StoreError: if there is neither, or the store is away.
    """
    if "'" in name:
        raise StoreError(f"MLflow: {json.dumps(name)} holds a quote; give the name of a sweep or of an experiment")
    with refused(uri):
        client = open_client(uri)
        runs, definition, command = _find(client, name)
        cells = [_fetch(client, run, folder) for run in runs]
    if not cells:
        raise StoreError(f"MLflow at {uri}: no sweep and no experiment {name!r} with runs; see the names in its UI")
    sweep = Sweep(name, command, definition, cells)
    Sweeps(folder).write(sweep)
    return sweep


def _find(client: MlflowClient, name: str) -> tuple[list[Run], dict[str, str], str]:
    """The runs, oldest first, what the sweep ranges over, and the command that runs it; an experiment has none."""
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    parents = client.search_runs(experiments, f"tags.kind = 'sweep' and tags.key = '{name}'")
    if parents:
        children = f"tags.mlflow.parentRunId = '{parents[0].info.run_id}' and tags.kind = 'run'"
        tags = parents[0].data.tags
        return _all(client, experiments, children), json.loads(tags.get("definition", "{}")), tags.get("command", "")
    experiment = client.get_experiment_by_name(name)
    return _all(client, [experiment.experiment_id], "tags.kind = 'run'") if experiment else [], {}, ""


def _all(client: MlflowClient, experiments: list[str], condition: str) -> list[Run]:
    found = search(client, experiments, condition, ["attributes.start_time ASC"])
    return list({run.data.tags["key"]: run for run in found}.values())


def _fetch(client: MlflowClient, run: Run, folder: Path) -> SweptRun:
    """Download one run; one that failed before it had a record keeps its status."""
    key = key_of(run.data.tags["key"])
    name = run.info.run_name or key
    files = [file_name(item.path) for item in client.list_artifacts(run.info.run_id) if not item.is_dir]
    if RECORD not in files:
        return SweptRun(key, name, status=run.info.status.lower())
    target = make_folder(Results(folder).folder(key))
    for path in files:
        client.download_artifacts(run.info.run_id, path, str(target))
    record = read_record(target / RECORD)
    return SweptRun(key, record.name, dict(record.axes), record.status, record.reason)

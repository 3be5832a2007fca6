"""Trained denoisers as models in MLflow, each with the file of a planner that plans with it."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.errors import CheckpointError
from dadiff.store import StoredRun
from dadiff.store.planners import pack

if TYPE_CHECKING:
    from mlflow import MlflowClient

FILE = "planner.zip"
KEY = "denoiser"

log = logging.getLogger(__name__)


def log_models(client: MlflowClient, experiment: str, runs: Iterable[StoredRun], ids: Mapping[str, str]) -> None:
    """A model for each training that the runs were made with, where there is none yet.

    Args:
        ids: key of a run -> the MLflow run that mirrors it.
    """
    for key, run in representatives(runs).items():
        if not client.search_logged_models([experiment], f"tags.{KEY} = '{key}'", max_results=1):
            _log_model(client, experiment, run, ids[run.key])


def representatives(runs: Iterable[StoredRun]) -> dict[str, StoredRun]:
    """Key of a training -> the run with the lowest cost among those that were made with it."""
    chosen: dict[str, StoredRun] = {}
    for run in runs:
        key = run.record.links.get(KEY)
        if key and run.status == "finished" and _cost(run) < (_cost(chosen[key]) if key in chosen else float("inf")):
            chosen[key] = run
    return chosen


def _cost(run: StoredRun) -> float:
    return run.metrics.get("cost_ratio", run.metrics.get("planned_state_error", float("inf")))


def _log_model(client: MlflowClient, experiment: str, run: StoredRun, run_id: str) -> None:
    """The planner of a run, packed for `dadiff.Planner.load`; a run without one makes no model."""
    key = run.record.links[KEY]
    with tempfile.TemporaryDirectory() as folder:
        try:
            packed = pack(run.folder, Path(folder) / FILE)
        except CheckpointError as error:
            log.warning("MLflow gets no model of the training %s: %s", key, error)
            return
        if packed is None:
            return
        tags = {KEY: key, "run": run.key, "load": f"dadiff.Planner.load('{FILE}')"}
        model = client.create_logged_model(
            experiment, f"denoiser-{key[:8]}", run_id, tags, params={"run": run.name}, model_type="planner"
        )
        client.log_model_artifact(model.model_id, str(packed))
        client.finalize_logged_model(model.model_id, "READY")

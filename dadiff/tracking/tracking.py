"""The component that a run tracks itself with: runs, trainings and sweeps in an MLflow store."""

from __future__ import annotations

import getpass
import logging
import os
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.errors import ConfigError
from dadiff.store import Cache, Results, StoredRun, Sweep, Sweeps, store_id
from dadiff.store.files import locked, read_json
from dadiff.tracking.client import SQLITE, open_client, prepare_store, process_start, spared
from dadiff.tracking.content import (
    Content,
    chunks,
    results_table,
    run_content,
    sweep_content,
    sweep_view,
    training_content,
)
from dadiff.tracking.markers import Marker, read_marker, stores, write_marker

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

MLFLOW_BATCH = 1000  # metrics that MLflow takes at once; 100 for parameters and tags
MLFLOW_STATUS = {"killed": "KILLED", "interrupted": "KILLED"}

log = logging.getLogger(__name__)


def is_tracked(folder: Path, uri: str) -> bool:
    """Whether a folder is wholly in the store; needs no MLflow."""
    marker = read_marker(folder, uri)
    return marker is not None and marker.complete


def attach(folder: Path, files: Sequence[Path], artifact_path: str) -> None:
    """Add files (a report) to the MLflow runs that mirror a folder, in whichever stores they are."""
    for uri in stores(folder):
        Tracking(uri).attach(folder, files, artifact_path)


@dataclass(frozen=True)
class Tracking:
    """Mirrors what lies on disk into MLflow. With `enabled=False` every method does nothing.

    Args:
        uri: the store: sqlite:///path, postgresql://..., or a server http://....
        experiment: the MLflow experiment that everything goes into.
        artifacts: folder of the artifacts; a server has its own.
        parent: id of the MLflow run of the sweep that runs belong to; set by the launcher.

    Raises:
        ConfigError: if the uri is of no known kind.
    """

    uri: str
    experiment: str = "dadiff"
    artifacts: str | None = None
    enabled: bool = True
    parent: str | None = None

    def __post_init__(self) -> None:
        if not self.uri.startswith((SQLITE, "postgresql", "mysql", "http://", "https://")):
            raise ConfigError(f"tracking: uri is {self.uri!r}; expected sqlite:///path, postgresql://... or http://...")
        if self.uri.startswith(SQLITE):
            object.__setattr__(self, "uri", SQLITE + str(Path(self.uri.removeprefix(SQLITE)).absolute()))
        if self.artifacts is not None:
            object.__setattr__(self, "artifacts", str(Path(self.artifacts).absolute()))

    def prepare(self) -> None:
        """Make the store and the experiment before anything runs.

        Raises:
            StoreError: if a server is away or a database cannot be opened.
        """
        if self.enabled:
            _ = self._experiment_id

    def start(
        self, key: str, name: str, output_dir: Path | str, kind: str = "run", started: int | None = None
    ) -> str | None:
        """Show in MLflow that work has begun. Returns the MLflow run's id; None if the store is away.

        Args:
            kind: "run", "training" or "sweep".
            started: in ms since 1970, if not now.
        """
        if not self.enabled:
            return None
        with spared(name):
            tags = {"key": key, "kind": kind, **_owner(output_dir)}
            if self.parent and kind == "run":
                tags["mlflow.parentRunId"] = self.parent
            run = self._client.create_run(self._experiment_id, start_time=started, run_name=name, tags=tags)
            return run.info.run_id
        return None

    def stop(self, run_id: str | None, status: str, reason: str) -> None:
        """Close the MLflow run of work that failed."""
        if run_id is not None:
            with spared(f"the end of {run_id}"):
                self._client.set_tag(run_id, "status", status)
                self._client.set_tag(run_id, "mlflow.note.content", f"{status}: {reason}")
                self._client.set_terminated(run_id, MLFLOW_STATUS.get(status, "FAILED"))

    def log_run(self, run: StoredRun, run_id: str | None = None) -> None:
        """Mirror a stored run, once: its marker `tracking.json` says that it is done.

        Args:
            run_id: what `start` returned; without it a new MLflow run is made.
        """
        self._mirror(run.folder, run.key, run.name, "run", run_content(run), run_id)

    def log_training(self, folder: Path, run_id: str | None = None) -> None:
        """Mirror a cached training (`cache/denoiser/<key>`), once, as an MLflow run of its own."""
        manifest = read_json(folder / "manifest.json")
        name = f"training/{manifest['key']}"
        self._mirror(folder, manifest["key"], name, "training", training_content(manifest, folder), run_id)

    def open_sweep(self, sweep: Sweep, output_dir: Path | str) -> str | None:
        """The MLflow run that the sweep's runs are nested under; the same one each time the sweep is run."""
        if not self.enabled:
            return None
        folder = Sweeps(output_dir).folder(sweep.name)
        with spared(sweep.name):
            marker = read_marker(folder, self.uri)
            if marker is None or self._is_gone(marker.run_id):
                run_id = self.start(sweep.name, sweep.name, output_dir, "sweep")
            else:
                run_id = marker.run_id
                self._client.update_run(run_id, status="RUNNING")
                self._set_tags(run_id, _owner(output_dir))
            if run_id is not None:
                write_marker(folder, self.uri, Marker(run_id, self._experiment_id, complete=False))
            return run_id
        return None

    def close_sweep(self, run_id: str | None, sweep: Sweep, output_dir: Path | str, status: str) -> None:
        """Give the sweep's MLflow run its table of results and its end.

        Args:
            status: "finished", "failed" or "interrupted".
        """
        if run_id is None:
            return
        folder = Sweeps(output_dir).folder(sweep.name)
        table_file = folder / "results.csv"
        results_table(sweep, Results(output_dir)).to_csv(table_file, index=False)
        with spared(sweep.name):
            self._log(run_id, sweep_content(sweep, table_file))
            view = sweep_view(sweep, run_id)
            self._client.set_experiment_tag(self._experiment_id, f"mlflow.sharedViewState.{sweep.name}", view)
            ended = "FINISHED" if status == "finished" else MLFLOW_STATUS.get(status, "FAILED")
            self._client.set_terminated(run_id, ended)
            write_marker(folder, self.uri, Marker(run_id, self._experiment_id, complete=status == "finished"))

    def how_to_look(self, sweep_name: str) -> str:
        """What a person types and opens to see a sweep in MLflow's pages, with its axes and metrics as columns."""
        if not self.enabled:
            return "tracking is off"
        page = f"/#/experiments/{self._experiment_id}/runs?viewStateShareKey={sweep_name}"
        if self.uri.startswith("http"):
            return f"open {self.uri}{page}"
        return f"mlflow ui --backend-store-uri {self.uri}   then open http://127.0.0.1:5000{page}"

    def attach(self, folder: Path, files: Iterable[Path], artifact_path: str) -> None:
        """Add files (a report) to the MLflow run that mirrors a folder, if there is one."""
        marker = read_marker(folder, self.uri)
        if self.enabled and marker is not None:
            with spared(artifact_path):
                for path in files:
                    self._client.log_artifact(marker.run_id, str(path), artifact_path)

    def close_dead(self, output_dir: Path | str) -> int:
        """Close as KILLED what still counts as RUNNING though its process is gone, on any host. Returns how many."""
        dead: list[Run] = []
        if self.enabled:
            with spared("the end of dead runs"):
                running = self._search(f"attributes.status = 'RUNNING' and tags.store = '{store_id(output_dir)}'")
                dead = [run for run in running if _is_dead(run, output_dir)]
                for run in dead:
                    self.stop(run.info.run_id, "killed", "its process is gone")
        return len(dead)

    @cached_property
    def _experiment_id(self) -> str:
        return prepare_store(self.uri, self.experiment, self.artifacts)

    @cached_property
    def _client(self) -> MlflowClient:
        return open_client(self.uri)

    def _mirror(self, folder: Path, key: str, name: str, kind: str, content: Content, run_id: str | None) -> None:
        if not self.enabled or (run_id is None and is_tracked(folder, self.uri)):
            return
        output_dir = folder.parent.parent if kind == "run" else folder.parent.parent.parent
        with spared(name), locked(folder.parent / ".locks" / f"{key}.tracking.lock", f"logging {name}"):
            if is_tracked(folder, self.uri):
                self._drop(run_id)
                return
            marker = read_marker(folder, self.uri)
            if marker is not None and not self._is_gone(marker.run_id):
                self._drop(run_id)
                run_id = marker.run_id
            live = run_id is not None
            run_id = run_id or self.start(key, name, output_dir, kind, content.started)
            if run_id is None:
                return
            write_marker(folder, self.uri, Marker(run_id, self._experiment_id, complete=False))
            self._log(run_id, content)
            self._client.set_terminated(run_id, "FINISHED", end_time=None if live else content.time or None)
            self._remove_older(run_id, key, kind, output_dir)
            write_marker(folder, self.uri, Marker(run_id, self._experiment_id, complete=True))

    def _log(self, run_id: str, content: Content) -> None:
        from mlflow.entities import Metric, Param

        metrics = [Metric(name, value, content.time, step) for name, value, step in content.metrics]
        params = [Param(name, value) for name, value in content.params.items()]
        for batch in chunks(metrics, MLFLOW_BATCH):
            self._client.log_batch(run_id, metrics=batch)
        for batch in chunks(params, 100):
            self._client.log_batch(run_id, params=batch)
        self._set_tags(run_id, content.tags)
        for path in content.files:
            self._client.log_artifact(run_id, str(path))

    def _set_tags(self, run_id: str, tags: dict[str, str]) -> None:
        from mlflow.entities import RunTag

        self._client.log_batch(run_id, tags=[RunTag(name, value) for name, value in tags.items()])

    def _search(self, condition: str) -> list[Run]:
        page = self._client.search_runs([self._experiment_id], condition)
        found: list[Run] = list(page)
        while page.token:
            page = self._client.search_runs([self._experiment_id], condition, page_token=page.token)
            found.extend(page)
        return found

    def _is_gone(self, run_id: str) -> bool:
        from mlflow.exceptions import MlflowException

        try:
            return self._client.get_run(run_id).info.lifecycle_stage != "active"
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return True

    def _drop(self, run_id: str | None) -> None:
        """Delete an MLflow run that turned out to be needless: another process was first."""
        if run_id is not None:
            self._client.delete_run(run_id)

    def _remove_older(self, run_id: str, key: str, kind: str, output_dir: Path) -> None:
        """Delete (MLflow can restore it) the mirror of a result that was done again in its place."""
        same = f"tags.key = '{key}' and tags.kind = '{kind}' and tags.store = '{store_id(output_dir)}'"
        for run in self._search(f"attributes.status = 'FINISHED' and {same}"):
            if run.info.run_id != run_id:
                self._client.delete_run(run.info.run_id)


def _owner(output_dir: Path | str) -> dict[str, str]:
    pid = os.getpid()
    return {
        "host": platform.node(),
        "pid": str(pid),
        "process_start": process_start(pid) or "",
        "output_dir": str(Path(output_dir).absolute()),
        "store": store_id(output_dir),
        "mlflow.user": getpass.getuser(),
        "mlflow.source.name": "dadiff",
    }


def _is_dead(run: Run, output_dir: Path | str) -> bool:
    """Whether its process is gone: as this host knows, or, of another host, because nobody holds the work's lock."""
    tags = run.data.tags
    if tags["host"] == platform.node():
        return process_start(int(tags["pid"])) != tags["process_start"]
    key = tags["key"]
    if tags["kind"] == "run":
        return not Results(output_dir).is_working(key)
    if tags["kind"] == "training":
        return not Cache(output_dir).is_building("denoiser", key)
    return not Sweeps(output_dir).is_running(key)

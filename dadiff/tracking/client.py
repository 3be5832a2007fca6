"""The doorway to MLflow: its settings, its store made once, and who of its running runs is dead.

Several processes that open an SQL store which does not exist yet break it for good, so it is made under a lock.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sqlite3
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.errors import StoreError
from dadiff.store.files import locked, make_folder

if TYPE_CHECKING:
    from mlflow import MlflowClient

SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
}
EXPERIMENT_TAGS = {"mlflow.experimentKind": "custom_model_development"}  # the pages for training, not for chats
SQLITE = "sqlite:///"
PROBE_SECONDS = 5

log = logging.getLogger(__name__)


def open_client(uri: str) -> MlflowClient:
    """A client of the store. The first one in a process imports MLflow, which takes seconds."""
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    from mlflow import MlflowClient

    for name in ("mlflow.store.db.utils", "alembic", "alembic.runtime.migration"):
        logging.getLogger(name).setLevel(logging.WARNING)
    return MlflowClient(tracking_uri=uri)


def prepare_store(uri: str, experiment: str, artifacts: str | None) -> str:
    """Make the store and the experiment, by one process at a time. Returns the experiment's id.

    Raises:
        StoreError: if a server is away or a database cannot be opened.
    """
    if uri.startswith(("http://", "https://")):
        _probe(uri)
    with locked(_lock_file(uri), f"the MLflow store {uri}"):
        if uri.startswith(SQLITE):
            _write_ahead(Path(uri.removeprefix(SQLITE)))
        with refused(uri):
            return _experiment_id(open_client(uri), experiment, None if uri.startswith("http") else artifacts)


def _experiment_id(client: MlflowClient, name: str, artifacts: str | None) -> str:
    found = client.get_experiment_by_name(name)
    if found is None:
        return client.create_experiment(name, artifact_location=artifacts, tags=EXPERIMENT_TAGS)
    if found.lifecycle_stage != "active":
        client.restore_experiment(found.experiment_id)
    return found.experiment_id


def _probe(uri: str) -> None:
    """Ask the server for its health.

    Raises:
        StoreError: if it does not answer within seconds.
    """
    try:
        with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=PROBE_SECONDS):
            return
    except urllib.error.HTTPError as error:
        answer = f"it answered {error.code}"
    except OSError as error:
        answer = str(getattr(error, "reason", error))
    raise StoreError(
        f"tracking: the MLflow server {uri} does not answer ({answer}); "
        "start it, mend tracking.uri, or take tracking=sqlite"
    )


def _write_ahead(path: Path) -> None:
    """Switch the database to its write-ahead log, in which readers and writers do not block each other.

    Raises:
        StoreError: if the file cannot be opened as a database.
    """
    make_folder(path.parent)
    try:
        with closing(sqlite3.connect(path, timeout=60)) as connection:
            connection.execute("PRAGMA journal_mode=WAL")
    except sqlite3.DatabaseError as error:
        raise StoreError(f"tracking: {path} cannot be opened as a database ({error}); move it away") from error


def _lock_file(uri: str) -> Path:
    if uri.startswith(SQLITE):
        return Path(uri.removeprefix(SQLITE) + ".lock")
    digest = hashlib.sha256(uri.encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"dadiff-{os.getuid()}" / f"mlflow-{digest}.lock"


def failures() -> tuple[type[Exception], ...]:
    """What comes up when MLflow's store is away or refuses."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    return (MlflowException, SQLAlchemyError, OSError, StoreError)


@contextmanager
def refused(uri: str) -> Iterator[None]:
    """Turn what MLflow raises into one line.

    Raises:
        StoreError: in place of MLflow's errors.
    """
    try:
        yield
    except failures() as error:
        raise StoreError(
            f"tracking: the MLflow store {uri} refuses ({first_line(error)}); mend tracking.uri"
        ) from error


@contextmanager
def spared(what: str) -> Iterator[None]:
    """Turn what MLflow raises into a warning: what was computed is on disk and is uploaded later."""
    try:
        yield
    except failures() as error:
        log.warning(
            "MLflow did not take %s (%s); it is on disk, dadiff-sync or the same command uploads it",
            what,
            first_line(error),
        )


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its type's name."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def process_start(pid: int) -> str | None:
    """When a living process started (clock ticks since boot), so that a reused pid is seen; None if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None if Path("/proc/self").exists() else _start_without_proc(pid)
    return None if fields[0] == "Z" else fields[19]


def _start_without_proc(pid: int) -> str | None:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        return "unknown"
    return "unknown"

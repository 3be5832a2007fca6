"""The doorway to MLflow: its settings, its store made by one process at a time, and its errors in one line."""

from __future__ import annotations

import hashlib
import logging
import os
import sqlite3
import tempfile
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.errors import MissingExtraError, StoreError
from dadiff.outside import without_passwords
from dadiff.store.files import locked
from dadiff.tracking.database import prepare_database
from dadiff.tracking.places import SQLITE, address_of, artifacts_of

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
PROBE_SECONDS, MOST_READ = 4, 2**20
MISSING = ("it answered 400", "it answered 404")
"""What the interface says of an experiment that is not there yet."""

log = logging.getLogger(__name__)


def open_client(uri: str) -> MlflowClient:
    """A client of the store. The first one in a process imports MLflow, which takes seconds."""
    _set_up()
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=address_of(uri))


def _set_up() -> None:
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    for name in ("mlflow.store.db.utils", "alembic", "alembic.runtime.migration"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what they would log with a traceback is raised as well


def prepare_store(uri: str, experiment: str, artifacts: str | None) -> str:
    """Make the store and the experiment, by one process at a time. Returns the experiment's id.

    Raises:
        StoreError: if a server is away or a database cannot be opened.
    """
    if uri.startswith(("http://", "https://")):
        _probe(uri)
    with locked(_lock_file(uri), f"the MLflow store {without_passwords(uri)}"), refused(uri):
        if uri.startswith(SQLITE):
            _set_up()
            prepare_database(Path(uri.removeprefix(SQLITE)), experiment, artifacts)
        return _experiment_id(open_client(uri), experiment, None if uri.startswith("http") else artifacts)


def _experiment_id(client: MlflowClient, name: str, artifacts: str | None) -> str:
    found = client.get_experiment_by_name(name)
    if found is None:
        place = None if artifacts is None else artifacts_of(artifacts)
        return client.create_experiment(name, artifact_location=place, tags=EXPERIMENT_TAGS)
    if found.lifecycle_stage != "active":
        client.restore_experiment(found.experiment_id)
    return found.experiment_id


def _probe(uri: str) -> None:
    """Ask the server for its health, and whether its interface answers.

    Raises:
        StoreError: if it does not answer within seconds, however it keeps one waiting.
    """
    for page in ("health", "api/2.0/mlflow/experiments/get-by-name?experiment_name=dadiff"):
        answer = _answer(f"{uri.rstrip('/')}/{page}")
        if answer and not (page.startswith("api") and answer in MISSING):
            raise StoreError(
                f"tracking: the MLflow server {without_passwords(uri)} does not answer ({answer}); "
                "start it, mend tracking.uri, or take tracking=sqlite"
            )


def _answer(url: str) -> str:
    """What went wrong as a page was asked for; empty if it came whole within PROBE_SECONDS.

    In a thread of its own, since the time-outs of sockets begin anew with every byte.
    """
    found: list[str] = []

    def ask() -> None:
        try:
            with urllib.request.urlopen(url, timeout=PROBE_SECONDS) as reply:
                reply.read(MOST_READ)
            found.append("")
        except urllib.error.HTTPError as error:
            found.append(f"it answered {error.code}")
        except (OSError, HTTPException, ValueError) as error:
            found.append(" ".join(str(getattr(error, "reason", error)).split()) or type(error).__name__)

    asked = threading.Thread(target=ask, daemon=True)
    asked.start()
    asked.join(PROBE_SECONDS)
    return found[0] if found else f"nothing whole within {PROBE_SECONDS} s"


def _lock_file(uri: str) -> Path:
    if uri.startswith(SQLITE):
        return Path(uri.removeprefix(SQLITE) + ".lock")
    digest = hashlib.sha256(uri.encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"dadiff-{os.getuid()}" / f"mlflow-{digest}.lock"


def failures() -> tuple[type[Exception], ...]:
    """What comes up when MLflow's store is away or refuses."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    return (MlflowException, SQLAlchemyError, sqlite3.Error, OSError, ImportError, StoreError)


@contextmanager
def refused(uri: str) -> Iterator[None]:
    """Turn what MLflow raises into one line.

    Raises:
        StoreError: in place of MLflow's errors.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        extra = "postgresql" if uri.startswith("postgresql") else "mysql"
        raise MissingExtraError(
            f"tracking: {error.name} is not installed, which {without_passwords(uri)} needs; install it with: "
            f"pip install 'dadiff[{extra}]'"
        ) from error
    except failures() as error:
        remedy = "make room" if "disk is full" in str(error) or "No space left" in str(error) else "mend tracking.uri"
        raise StoreError(
            f"tracking: the MLflow store {without_passwords(uri)} refuses ({first_line(error)}); {remedy}"
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

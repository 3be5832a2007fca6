"""Brings an MLflow store up to what lies in an output folder. What the store itself holds is asked, and nothing else.

Every MLflow run that mirrors something carries tags: `store` (the output folder's id), `kind`, `key`, and as the last
that is written of it `stamp`. One without its stamp was cut short, and one whose stamp differs mirrors what has changed
since; both are made again. One process at a time writes for an output folder.
"""

from __future__ import annotations

import getpass
import platform
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from dadiff.store import store_id
from dadiff.store.files import locked
from dadiff.tracking.content import Content, Data, Piece, chunks
from dadiff.tracking.links import PARENT

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import DatasetInput, Run

CONTEXT = "mlflow.data.context"
METRICS_AT_ONCE, PARAMS_AT_ONCE, TAGS_AT_ONCE = 800, 100, 100  # that MLflow takes, of all together 1000


class Mirror:
    """What a store holds of an output folder; made by `opened`.

    Args:
        runs: of the store, that mirror something of the output folder.
    """

    def __init__(self, client: MlflowClient, experiment_id: str, store: str, runs: Iterable[Run]) -> None:
        self._client, self._experiment_id, self._store = client, experiment_id, store
        self._held: defaultdict[tuple[str, str], list[Run]] = defaultdict(list)
        for run in runs:
            self._held[run.data.tags["kind"], run.data.tags["key"]].append(run)

    def bring(self, piece: Piece, parent: str | None = None) -> tuple[str, bool]:
        """Make sure that one whole run mirrors the piece. Returns its id, and whether anything was missing.

        Args:
            parent: id of the run of its sweep; a run that has a living one keeps it.
        """
        held = self._held.pop((piece.kind, piece.key), [])
        whole = [run for run in held if run.data.tags.get("stamp") == piece.stamp]
        kept = whole or (held if piece.kind == "sweep" else [])  # runs are nested under a sweep's, which stays
        run_id = kept[0].info.run_id if kept else None
        if run_id is None or not whole:
            run_id = self._write(piece, piece.read(), run_id)
        for run in held:
            if run.info.run_id != run_id:
                self._client.delete_run(run.info.run_id)
        if kept and kept[0].info.run_name != piece.name:
            self._client.update_run(run_id, name=piece.name)
        if parent is not None and not (kept and kept[0].data.tags.get(PARENT) == parent):
            self._client.set_tag(run_id, PARENT, parent)
        return run_id, not whole

    def tidy(self) -> None:
        """Remove what was cut short and mirrors nothing that was brought."""
        for run in [run for runs in self._held.values() for run in runs if "stamp" not in run.data.tags]:
            self._client.delete_run(run.info.run_id)

    def _write(self, piece: Piece, content: Content, run_id: str | None) -> str:
        if run_id is None:
            run_id = self._create(piece, content.started)
        log_content(self._client, run_id, content)
        self._client.set_terminated(run_id, piece.status, end_time=content.time or None)
        self._client.set_tag(run_id, "stamp", piece.stamp)
        return run_id

    def _create(self, piece: Piece, started: int | None) -> str:
        tags = {
            "kind": piece.kind,
            "key": piece.key,
            "store": self._store,
            "host": platform.node(),
            "mlflow.user": _user(),
            "mlflow.source.name": "dadiff",
        }
        run = self._client.create_run(self._experiment_id, start_time=started, run_name=piece.name, tags=tags)
        return run.info.run_id


@contextmanager
def opened(
    client: MlflowClient, experiment_id: str, output_dir: Path | str, only: Piece | None = None
) -> Iterator[Mirror]:
    """The mirror of an output folder, while no other process changes it.

    Args:
        only: the piece to look for; None for all that the store holds.
    """
    store = store_id(output_dir)
    condition = f"tags.store = '{store}'"
    if only is not None:
        condition += f" and tags.kind = '{only.kind}' and tags.key = '{only.key}'"
    with locked(Path(output_dir) / ".mlflow.lock", f"MLflow's mirror of {output_dir}"):
        yield Mirror(client, experiment_id, store, search(client, [experiment_id], condition))


def search(client: MlflowClient, experiments: list[str], condition: str, order: list[str] | None = None) -> list[Run]:
    """All runs that meet a condition."""
    page = client.search_runs(experiments, condition, order_by=order)
    found: list[Run] = list(page)
    while page.token:
        page = client.search_runs(experiments, condition, order_by=order, page_token=page.token)
        found.extend(page)
    return found


def log_content(client: MlflowClient, run_id: str, content: Content) -> None:
    """Parameters, metrics, tags and files."""
    from mlflow.entities import Metric, Param, RunTag

    metrics = [Metric(name, value, content.time, step) for name, value, step in content.metrics]
    params = [Param(name, value) for name, value in content.params.items()]
    tags = [RunTag(name, value) for name, value in content.tags.items()]
    parts = chunks(metrics, METRICS_AT_ONCE), chunks(params, PARAMS_AT_ONCE), chunks(tags, TAGS_AT_ONCE)
    for batch in zip_longest(*parts, fillvalue=()):
        client.log_batch(run_id, *batch)
    if content.inputs:
        client.log_inputs(run_id, [_dataset(data) for data in content.inputs])
    for key, picture in content.images.items():
        client.log_image(run_id, picture, key=key, step=0)
    for folder, files in content.files.items():
        for path in files:
            client.log_artifact(run_id, str(path), folder or None)


def _dataset(data: Data) -> DatasetInput:
    from mlflow.entities import Dataset, DatasetInput, InputTag

    dataset = Dataset(name=data.name, digest=data.digest, source_type="local", source=data.source)
    return DatasetInput(dataset=dataset, tags=[InputTag(CONTEXT, data.context)])


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        return "unknown"

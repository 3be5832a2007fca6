"""What of a stored run, training or sweep goes into MLflow, as plain values. Nothing here talks to MLflow."""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dadiff.outside import json_of, spreadsheet_safe
from dadiff.store import DONE, Cache, Results, StoredRun, Sweep, Sweeps
from dadiff.store.cache import MANIFEST
from dadiff.store.files import checksum, read_json
from dadiff.store.results import RECORD
from dadiff.tracking import pictures
from dadiff.tracking.views import PLANS

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

INDICES = ("robot", "case", "sample", "t", "step")
OVER_TIME = "t/"
ARTIFACTS = (".json", ".yaml", ".parquet", ".csv", ".png", ".svg", ".pdf")


MLFLOW_STATUS = {"killed": "KILLED", "interrupted": "KILLED"}


@dataclass(frozen=True)
class Data:
    """A data set in the cache: its name and key, what it is used for, and where it lies."""

    name: str
    digest: str
    context: str
    source: str


@dataclass(frozen=True)
class Content:
    """What is logged of one run.

    Args:
        metrics: (name, value, step), finite values only.
        files: folder among the artifacts ("" is their top) -> files.
        inputs: the data sets that it was made with.
        images: key -> picture (height, width, 3).
        started, time: of the work and of all metrics, in ms since 1970; from the record, so that logging again
            changes nothing; None and 0 where that is not recorded.
    """

    params: dict[str, str] = field(default_factory=dict)
    metrics: list[tuple[str, float, int]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    files: dict[str, list[Path]] = field(default_factory=dict)
    inputs: list[Data] = field(default_factory=list)
    images: dict[str, np.ndarray] = field(default_factory=dict)
    started: int | None = None
    time: int = 0


@dataclass(frozen=True)
class Piece:
    """Something on disk that one MLflow run mirrors.

    Args:
        kind: "sweep", "training" or "run".
        key: names it among its kind.
        stamp: changes whenever what lies on disk changes.
        status: as MLflow has it.
        read: reads what is logged of it.
    """

    kind: str
    key: str
    name: str
    stamp: str
    status: str
    read: Callable[[], Content] = field(repr=False, compare=False)


def run_piece(run: StoredRun, name: str | None = None) -> Piece:
    """A stored run, whether it is a result or failed, under its own name or that which its sweep gives it."""
    status = "FINISHED" if run.record.is_done else MLFLOW_STATUS.get(run.status, "FAILED")
    return Piece("run", run.key, name or run.name, _stamp(run.folder / RECORD), status, partial(run_content, run))


def training_piece(output_dir: Path | str, key: str) -> Piece | None:
    """A training in the cache; None if there is none of this key."""
    folder = Cache(output_dir).folder("denoiser", key)
    if not (folder / MANIFEST).is_file():
        return None
    read = partial(training_content, folder)
    return Piece("training", key, f"training/{key}", _stamp(folder / MANIFEST), "FINISHED", read)


def sweep_piece(output_dir: Path | str, name: str) -> Piece:
    """A stored sweep, with its table and its report if there is one."""
    folder = Sweeps(output_dir).folder(name)
    files = [folder / "sweep.json", *_report(output_dir, name)]
    statuses = {cell.status for cell in Sweeps(output_dir).read(name).cells}
    return Piece("sweep", name, name, _stamp(*files), _sweep_status(statuses), partial(sweep_content, output_dir, name))


def _sweep_status(statuses: set[str]) -> str:
    if statuses <= set(DONE):
        return "FINISHED"
    if "waiting" in statuses:
        return "SCHEDULED"
    return "KILLED" if "interrupted" in statuses else "FAILED"


def _report(output_dir: Path | str, name: str) -> list[Path]:
    files = [Path(output_dir) / "reports" / name / part for part in ("index.html", "report.json")]
    return [file for file in files if file.is_file()]


def _stamp(*files: Path) -> str:
    return hashlib.sha256("".join(map(checksum, files)).encode()).hexdigest()[:16]


def run_content(run: StoredRun) -> Content:
    """Axes as parameters, headline scalars, error curves with step = t, and what identifies the run."""
    made = run.record.provenance
    commit = {"commit": made.commit, "mlflow.source.git.commit": made.commit}
    tags = {
        "status": run.status,
        **{f"version.{name}": version for name, version in made.versions.items()},
        **{f"link.{kind}": key for kind, key in run.record.links.items()},
        **{name: value for name, value in {"device": made.device, **commit}.items() if value},
        "mlflow.note.content": run_note(run),
    }
    params = {name: _text(value) for name, value in run.axes.items()}
    picture = pictures.plans(run)
    return Content(
        params, scalars(run) + curves(run), tags, {"": artifacts(run.folder)}, data(run),
        {} if picture is None else {PLANS: picture}, *times(made.started, made.seconds),
    )  # fmt: skip


CONTEXTS = {"demonstrations": "training", "cases": "testing"}
"""Kinds of data sets, and what MLflow calls their use."""


def data(run: StoredRun) -> list[Data]:
    """The data sets that a run was made with."""
    cache = Cache(run.folder.parent.parent)
    return [
        Data(f"{kind}/{key[:8]}", key, CONTEXTS[kind], str(cache.folder(kind, key)))
        for kind, key in run.record.links.items()
        if kind in CONTEXTS
    ]


def scalars(run: StoredRun) -> list[tuple[str, float, int]]:
    """The headline scalars, and the step at which a run diverged."""
    values = dict(run.metrics)
    if run.record.diverged_step is not None:
        values["diverged_step"] = float(run.record.diverged_step)
    return [(name, value, 0) for name, value in values.items() if math.isfinite(value)]


def curves(run: StoredRun) -> list[tuple[str, float, int]]:
    """Means over robots, cases and samples at each t."""
    return _columns(run.table("per_step"), "t", OVER_TIME) if run.has("per_step") else []


def _columns(table: pd.DataFrame, index: str, prefix: str = "") -> list[tuple[str, float, int]]:
    quantities = [name for name in table.columns if name not in INDICES]
    means = table.groupby(index)[quantities].mean()
    return [
        (f"{prefix}{name}", value, step)
        for name in quantities
        for step, value in zip(means.index.tolist(), means[name].tolist(), strict=True)
        if math.isfinite(value)
    ]


def run_note(run: StoredRun) -> str:
    """The run in a few sentences of markdown."""
    counts = ", ".join(f"{count} {what}" for what, count in run.record.counts.items() if count)
    lines = [f"**{run.name}**: {run.status}" + (f" ({run.record.reason})" if run.record.reason else "") + "."]
    if counts:
        lines.append(f"Headline metrics are means over {counts} and over time; `{OVER_TIME}…` are means at each t.")
    if run.axes:
        lines.append("\n".join(["| parameter | value |", "|---|---|", *_rows(run.axes)]))
    lines.append(f"Tables and the resolved configuration are among the artifacts and in `{run.folder}`.")
    return "\n\n".join(lines)


def training_content(folder: Path) -> Content:
    """A cached training: its identity as parameters, its curve (`training.csv`: step, loss, ...) as metrics."""
    import pandas as pd

    manifest = read_json(folder / MANIFEST)
    identity = flat(manifest.get("identity", {}))
    path = folder / "training.csv"
    metrics = []
    if path.is_file():
        metrics = _columns(pd.read_csv(path), "step")
    note = f"Training of the denoiser `{manifest['key']}`, shared by every run whose tag `link.denoiser` names it."
    tags = {"status": "finished", "mlflow.note.content": f"{note}\n\nThe weights lie in `{folder}`."}
    params = {name: _text(value) for name, value in identity.items()}
    began, ended = times(manifest.get("created"))
    return Content(params, metrics, tags, {"": artifacts(folder)}, started=began, time=ended)


def sweep_content(output_dir: Path | str, name: str) -> Content:
    """A sweep: what it ranges over, how many cells ended how, its table of results.

    All in tags, which may change: parameters and metrics of MLflow keep what the first of several starts said.
    """
    sweep = Sweeps(output_dir).read(name)
    counts = Counter(cell.status for cell in sweep.cells)
    failed = [f"- {cell.name}: {cell.status}, {cell.reason}" for cell in sweep.cells if cell.reason]
    note = [
        *(f"- {sentence}" for sentence in _found(output_dir, name)),
        f"**{sweep.name}**: {len(sweep.cells)} runs. Run or resume it with",
        f"```\n{sweep.command}\n```",
        *(["\n".join(["| over | values |", "|---|---|", *_rows(sweep.definition)])] if sweep.definition else []),
        "`results.csv` among the artifacts has one row a run; the report is among them once it was logged.",
        *(["Not finished:\n" + "\n".join(failed)] if failed else []),
    ]
    tags = {
        "mlflow.note.content": "\n\n".join(note),
        "kind": "sweep",
        "command": sweep.command,
        "definition": json.dumps({name: _text(value) for name, value in sweep.definition.items()}),
        "cells": ", ".join(f"{count} {status}" for status, count in sorted(counts.items())),
    }
    table = Sweeps(output_dir).folder(name) / "results.csv"
    files = {"": [table] if table.is_file() else [], "report": _report(output_dir, name)}
    return Content(tags=tags, files=files)


def _found(output_dir: Path | str, name: str) -> list[str]:
    """The sentences of the sweep's report, if there is one."""
    path = Path(output_dir) / "reports" / name / "report.json"
    return [str(sentence) for sentence in json_of(path).get("sentences", [])] if path.is_file() else []


def results_table(sweep: Sweep, results: Results) -> pd.DataFrame:
    """One row a run: name, status, axes, headline metrics, key."""
    import pandas as pd

    rows = []
    for cell in sweep.cells:
        metrics = results.read(cell.key).metrics if results.is_done(cell.key) else {}
        row = {"name": cell.name, "status": cell.status, **cell.axes, **metrics, "key": cell.key}
        rows.append({spreadsheet_safe(name): spreadsheet_safe(value) for name, value in row.items()})
    return pd.DataFrame(rows)


def artifacts(folder: Path) -> list[Path]:
    """The files worth having in MLflow: tables, figures and descriptions, not weights and arrays."""
    return sorted(p for p in folder.iterdir() if p.suffix in ARTIFACTS)


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping with dotted names."""
    parts: dict[str, Any] = {}
    for name, value in values.items():
        parts |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return parts


def times(started: str | None, seconds: float = 0.0) -> tuple[int | None, int]:
    """When the work began and ended, in ms since 1970; None and 0 where that is not recorded."""
    if started is None:
        return None, 0
    began = datetime.fromisoformat(started).timestamp()
    return int(1000 * began), int(1000 * (began + seconds))


def chunks(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    """Pieces of at most `size` items."""
    return [items[first : first + size] for first in range(0, len(items), size)]


def _rows(values: Mapping[str, Any]) -> list[str]:
    return [f"| {name} | {_text(value)} |" for name, value in values.items()]


def _text(value: Any) -> str:
    return str(value)[:500]

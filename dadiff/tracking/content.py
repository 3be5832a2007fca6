"""What of a stored run, training or sweep goes into MLflow, as plain values. Nothing here talks to MLflow."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dadiff.outside import spreadsheet_safe
from dadiff.store import Results, StoredRun, Sweep

if TYPE_CHECKING:
    import pandas as pd

HEADLINE = (
    "rollout_state_error",
    "planned_state_error",
    "planned_input_error",
    "cost_ratio",
    "dynamics_residual",
    "sampling_seconds",
)
INDICES = ("robot", "case", "sample", "t", "step")
OVER_TIME = "t/"
ARTIFACTS = (".json", ".yaml", ".parquet", ".csv", ".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Content:
    """What is logged of one run.

    Args:
        metrics: (name, value, step), finite values only.
        started, time: of the work and of all metrics, in ms since 1970; from the record, so that logging again
            changes nothing; None and 0 where that is not recorded.
    """

    params: dict[str, str] = field(default_factory=dict)
    metrics: list[tuple[str, float, int]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    started: int | None = None
    time: int = 0


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
    return Content(params, scalars(run) + curves(run), tags, artifacts(run.folder), *times(made.started, made.seconds))


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


def training_content(manifest: dict[str, Any], folder: Path) -> Content:
    """A cached training: its identity as parameters, its curve (`training.csv`: step, loss, ...) as metrics."""
    import pandas as pd

    identity = flat(manifest.get("identity", {}))
    path = folder / "training.csv"
    metrics = []
    if path.is_file():
        metrics = _columns(pd.read_csv(path), "step")
    note = f"Training of the denoiser `{manifest['key']}`, shared by every run whose tag `link.denoiser` names it."
    tags = {"status": "finished", "mlflow.note.content": f"{note}\n\nThe weights lie in `{folder}`."}
    params = {name: _text(value) for name, value in identity.items()}
    return Content(params, metrics, tags, artifacts(folder), *times(manifest.get("created")))


def sweep_content(sweep: Sweep, table_file: Path) -> Content:
    """A sweep: what it ranges over, how many cells ended how, its table of results.

    All in tags, which may change: parameters and metrics of MLflow keep what the first of several starts said.
    """
    counts = Counter(cell.status for cell in sweep.cells)
    failed = [f"- {cell.name}: {cell.status}, {cell.reason}" for cell in sweep.cells if cell.reason]
    note = [
        f"**{sweep.name}**: {len(sweep.cells)} cells. Run or resume it with",
        f"```\n{sweep.command}\n```",
        *(["\n".join(["| over | values |", "|---|---|", *_rows(sweep.definition)])] if sweep.definition else []),
        "`results.csv` among the artifacts has one row a cell.",
        *(["Not finished:\n" + "\n".join(failed)] if failed else []),
    ]
    tags = {
        "mlflow.note.content": "\n\n".join(note),
        "kind": "sweep",
        "command": sweep.command,
        "definition": json.dumps({name: _text(value) for name, value in sweep.definition.items()}),
        "cells": ", ".join(f"{count} {status}" for status, count in sorted(counts.items())),
    }
    return Content(tags=tags, files=[table_file])


def sweep_view(sweep: Sweep, parent: str) -> str:
    """State of MLflow's runs page that shows a sweep: its runs, with what varies and the headline metrics as columns.

    MLflow keeps such states as tags of the experiment, and opens one with `?viewStateShareKey=` in the address.
    """
    columns = [f"params.`{name}`" for name in varying(sweep)] + [f"metrics.`{name}`" for name in HEADLINE]
    return json.dumps(
        {
            "searchFilter": f"tags.`mlflow.parentRunId` = '{parent}'",
            "orderByKey": f"metrics.`{HEADLINE[0]}`",
            "orderByAsc": True,
            "selectedColumns": columns,
        }
    )


def varying(sweep: Sweep) -> list[str]:
    """The axes that differ between cells; of several that always move together (the seeds) the first."""
    values: dict[tuple[str, ...], str] = {}
    for name in dict.fromkeys(name for cell in sweep.cells for name in cell.axes):
        column = tuple(_text(cell.axes.get(name)) for cell in sweep.cells)
        if len(set(column)) > 1:
            values.setdefault(column, name)
    return list(values.values())


def results_table(sweep: Sweep, results: Results) -> pd.DataFrame:
    """One row a cell: name, status, axes, headline metrics, key."""
    import pandas as pd

    rows = []
    for cell in sweep.cells:
        metrics = results.read(cell.key).metrics if results.is_done(cell.key) else {}
        row = {"name": cell.name, "status": cell.status, **cell.axes, **metrics, "key": cell.key}
        rows.append({spreadsheet_safe(name): spreadsheet_safe(value) for name, value in row.items()})
    return pd.DataFrame(rows)


def artifacts(folder: Path) -> list[Path]:
    """The files worth having in MLflow: tables, figures and descriptions, not weights and arrays."""
    return sorted(p for p in folder.iterdir() if p.suffix in ARTIFACTS and p.name != "tracking.json")


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

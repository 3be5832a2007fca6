"""Reads a sweep back: its cells, and for each what became of it.

A cell is `finished`, `diverged`, `failed`, ... as its run says, or `missing` when no run was stored.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dadiff.errors import StoreError
from dadiff.store import Record, Results, StoredRun, Sweeps
from dadiff.store.results import columns_of, read_table
from dadiff.tracking.links import pages, table


@lru_cache(maxsize=64)
def _table(folder: Path, name: str) -> pd.DataFrame:
    return read_table(folder, name)


@lru_cache(maxsize=65536)
def _columns(folder: Path, name: str) -> tuple[str, ...]:
    return columns_of(folder, name)


LOG = re.compile(r"; log: \S+$")
"""Where a sweep's cell says more: a place on one machine, which no report names."""


@dataclass(frozen=True)
class ReportedRun:
    """One run of a sweep, with what is stored of it, if anything.

    Args:
        key: hash of what determines the result.
        name: for people.
        axes: flat parameters; those that are null do not apply.
        run: None if nothing was stored.
        waiting: what the sweep's record says of a cell without a run.
        mlflow: its page in MLflow.
        means: over the plans of each case, of the tables and metrics that were asked for.
    """

    key: str
    name: str
    axes: dict[str, Any]
    run: StoredRun | None = field(repr=False)
    waiting: str | None = None
    mlflow: str | None = None
    means: dict[tuple[str, str], np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    @property
    def record(self) -> Record | None:
        """Of the stored run."""
        return self.run.record if self.run else None

    @property
    def config(self) -> Mapping[str, Any]:
        """The resolved configuration; empty if nothing was stored."""
        return self.record.config if self.record else {}

    @property
    def counts(self) -> Mapping[str, int]:
        """Of cases, samples and robots."""
        return self.record.counts if self.record else {}

    def link(self, kind: str) -> str | None:
        """The key of what the run was made with: "cases", "denoiser", "recording"."""
        return self.record.links.get(kind) if self.record else None

    @property
    def status(self) -> str:
        """What became of it; `missing` if nothing was stored."""
        return self.run.status if self.run else "missing"

    @property
    def outcome(self) -> str:
        """The status in words, with step or reason."""
        told = (self.record.reason if self.record else None) or self.waiting
        reason = told and LOG.sub("", told)
        if self.record and self.status == "diverged" and self.record.diverged_step is not None:
            return f"diverged at step {self.record.diverged_step}"
        return f"{self.status}: {reason}" if reason else self.status

    @property
    def metrics(self) -> Mapping[str, float]:
        """Headline scalars."""
        return self.run.metrics if self.run else {}

    @property
    def identity(self) -> bool:
        """Whether its projector leaves everything as it is: its rank is that of all trajectories (from x(0))."""
        if "rank" not in self.metrics or "inputs" not in self.examples:
            return False
        (horizon, m), n = self.examples["inputs"].shape[-2:], self.examples["states"].shape[-1]
        free = n * (horizon + (self.axes.get("initial_state") != "fixed")) + m * horizon
        return bool(self.metrics["rank"] >= free)

    def has(self, table: str) -> bool:
        """Whether the run holds this table."""
        return self.run is not None and self.run.has(table)

    def has_column(self, table: str, column: str) -> bool:
        """Whether the run holds this table, and that this column."""
        return self.run is not None and self.run.has(table) and column in _columns(self.run.folder, table)

    def columns(self, table: str) -> tuple[str, ...]:
        """Of a stored table; empty if the run does not hold it."""
        return _columns(self.run.folder, table) if self.run is not None and self.run.has(table) else ()

    def table(self, name: str) -> pd.DataFrame:
        """The stored table `per_step`, `per_plan` or `chain`.

        Raises:
            StoreError: if it is absent or damaged.
        """
        if self.run is None:
            raise StoreError(f"run {self.key} ({self.name}): was not stored; run the sweep again")
        return _table(self.run.folder, name)

    @cached_property
    def examples(self) -> dict[str, np.ndarray]:
        """Trajectories of the first cases, by name; empty if none were stored."""
        return self.run.arrays() if self.run else {}


@dataclass(frozen=True)
class Sweep:
    """Cells that were asked for together, and the command that asks for them again.

    Args:
        tables: name of a sweep -> its table of runs in MLflow's pages.
    """

    name: str
    command: str
    cells: list[ReportedRun]
    tables: Mapping[str, str] = field(default_factory=dict)

    @property
    def finished(self) -> list[ReportedRun]:
        """Cells with results."""
        return [cell for cell in self.cells if cell.status == "finished"]

    @cached_property
    def duplicates(self) -> list[list[ReportedRun]]:
        """Groups of cells that resolved to the same configuration."""
        groups: dict[str, list[ReportedRun]] = {}
        for cell in self.cells:
            same = json.dumps(cell.config, sort_keys=True) if cell.record else cell.key
            groups.setdefault(same, []).append(cell)
        return [group for group in groups.values() if len(group) > 1]


def read_sweeps(output_dir: Path, names: list[str]) -> Sweep:
    """One sweep, or several as one, from the results folder.

    Raises:
        StoreError: if a sweep is not there, or a file is damaged or too new.
    """
    sweeps = [_read(output_dir, name) for name in names]
    commands = dict.fromkeys(sweep.command for sweep in sweeps if sweep.command)
    cells = [cell for sweep in sweeps for cell in sweep.cells]
    tables = {name: page for name in names if (page := table(output_dir, name))}
    return Sweep("+".join(names), " && ".join(commands), cells, tables)


def _read(output_dir: Path, name: str) -> Sweep:
    sweeps, results = Sweeps(output_dir), Results(output_dir)
    if name not in sweeps.names():
        raise StoreError(
            f"{sweeps.root}: holds no sweep {name!r}; found {', '.join(sweeps.names()) or 'none'}; "
            f"run `dadiff +sweeps={name}` or give another --output-dir"
        )
    stored, cells, links = sweeps.read(name), [], pages(output_dir)
    for cell in stored.cells:
        run = results.read(cell.key) if results.status(cell.key) else None
        waiting = None if run else cell.reason or (cell.status if cell.status != "waiting" else None)
        cells.append(
            ReportedRun(
                cell.key, cell.name, {**cell.axes, **(run.axes if run else {})}, run, waiting, links.get(cell.key)
            )
        )
    return Sweep(stored.name, stored.command, cells)

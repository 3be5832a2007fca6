"""`dadiff-sync`: make MLflow again from what lies on disk, or bring it up to that."""

from __future__ import annotations

import argparse
import logging
from collections import defaultdict
from pathlib import Path

from dadiff.commands import reported
from dadiff.store import Results, StoredRun, Sweeps
from dadiff.tracking import Tracking


def sync(output_dir: Path, uri: str | None = None) -> int:
    """Mirror all stored runs, their trainings and their sweeps, where the store lacks them. Returns how many it lacked.

    Args:
        uri: the store; None takes for each run the one that it was configured with.

    Raises:
        StoreError: if a store is away.
    """
    sweeps, brought = Sweeps(output_dir), 0
    cells = {name: {cell.key for cell in sweeps.read(name).cells} for name in sweeps.names()}
    for tracking, runs in _by_store(output_dir, uri).items():
        tracking.prepare()
        keys = {run.key for run in runs}
        brought += tracking.catch_up(output_dir, runs, [name for name, its in cells.items() if its & keys])
    return brought


def _by_store(output_dir: Path, uri: str | None) -> dict[Tracking, list[StoredRun]]:
    stores = defaultdict(list)
    for run in Results(output_dir):
        tracking = Tracking.of(run.record.config, output_dir, uri)
        if tracking.enabled:
            stores[tracking].append(run)
    return stores


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns its exit code."""
    parser = argparse.ArgumentParser("dadiff-sync", description="Bring MLflow up to the results on disk.")
    parser.add_argument("--output-dir", type=Path, default=Path("outputs"), help="where results lie (outputs)")
    parser.add_argument("--uri", help="the MLflow store (that of each run's configuration)")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    return reported("dadiff-sync", lambda: print(_told(sync(given.output_dir, given.uri))))


def _told(brought: int) -> str:
    return f"{brought} were missing in MLflow and are there now"

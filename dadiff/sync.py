"""`dadiff-sync`: upload to MLflow what is on disk and not there yet, for example because its server was away."""

from __future__ import annotations

import argparse
import logging
import sys
from dataclasses import replace
from pathlib import Path

from dadiff.errors import DadiffError
from dadiff.launching.jobs import tracking_of
from dadiff.store import Cache, Results, StoredRun
from dadiff.tracking import Tracking, is_tracked


def sync(output_dir: Path, uri: str | None = None) -> tuple[int, int]:
    """Upload stored runs and the trainings that they were made with, and close what was killed.

    Returns (uploaded, still missing).

    Args:
        uri: the store; None takes for each run the one that it was configured with.

    Raises:
        StoreError: if a store is away.
    """
    before = after = 0
    stores: dict[str, Tracking] = {}
    runs = [run for run in Results(output_dir) if run.record.is_done and run.record.config["tracking"]["enabled"]]
    for run in runs:
        tracking = tracking_of(run.record.config)
        if uri is not None:
            tracking = replace(tracking, uri=uri, parent=None)
        tracking = replace(stores.setdefault(tracking.uri, tracking), parent=tracking.parent)
        before += is_tracked(run.folder, tracking.uri)
        _upload(output_dir, run, tracking)
        after += is_tracked(run.folder, tracking.uri)
    for tracking in stores.values():
        tracking.prepare()
        tracking.close_dead(output_dir)
    return after - before, len(runs) - after


def _upload(output_dir: Path, run: StoredRun, tracking: Tracking) -> None:
    if is_tracked(run.folder, tracking.uri):
        return
    tracking.prepare()
    denoiser = run.record.links.get("denoiser")
    if denoiser and Cache(output_dir).contains("denoiser", denoiser):
        tracking.log_training(Cache(output_dir).folder("denoiser", denoiser))
    tracking.log_run(run)


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns its exit code, 1 if something could not be uploaded."""
    parser = argparse.ArgumentParser("dadiff-sync", description="Upload stored results that MLflow does not have yet.")
    parser.add_argument("--output-dir", type=Path, default=Path("outputs"), help="where results lie (outputs)")
    parser.add_argument("--uri", help="the MLflow store (that of each run's configuration)")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        uploaded, missing = sync(given.output_dir, given.uri)
    except DadiffError as error:
        print(f"dadiff-sync: {error}", file=sys.stderr)
        return 1
    print(f"{uploaded} runs uploaded, {missing} still missing")
    return int(missing > 0)

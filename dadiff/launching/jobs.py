"""What a job does: train, or run one cell, and mirror it into MLflow. Every launcher and the single run use these."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from dadiff.config import build
from dadiff.errors import DadiffError
from dadiff.launching.outcome import why
from dadiff.running.assembly import Experiment
from dadiff.running.identity import Identity
from dadiff.running.provenance import record_of
from dadiff.store import DONE, Results, Status, StoredRun
from dadiff.tracking import Tracking


def tracking_of(config: Mapping[str, Any]) -> Tracking:
    """The tracking component of a resolved configuration.

    Raises:
        ConfigError: if it is not valid.
    """
    return build(config["tracking"], "tracking")


def run(config: Mapping[str, Any]) -> StoredRun:
    """Run one resolved configuration and mirror it into MLflow; what is done already is only mirrored."""
    return run_experiment(Experiment.of(config))


def run_experiment(experiment: Experiment) -> StoredRun:
    """Run what is assembled, and mirror it into MLflow; what is done already is only mirrored."""
    from dadiff.running.experiment import execute

    tracking, identity = experiment.parts.tracking, experiment.identity
    if identity.denoiser is not None:
        train_for(experiment)
    if experiment.results.is_done(identity.key) and not experiment.parts.settings.force:
        stored, run_id = execute(experiment), None
    else:
        run_id = tracking.start(identity.key, identity.name, experiment.output_dir)
        with _closing(tracking, run_id, experiment):
            stored = execute(experiment)
    tracking.log_run(stored, run_id)
    return stored


def record_end(identity: Identity, config: Mapping[str, Any], status: Status, reason: str) -> None:
    """Store how a run ended that gave no result of its own, unless a result with its key is already there."""
    record = record_of(identity, config, status, time.time(), reason=reason)
    Results(config["output_dir"]).write_failure(record)


def train(config: Mapping[str, Any]) -> None:
    """Build the trained denoiser, unless it is cached, and mirror its training into MLflow."""
    train_for(Experiment.of(config))


def train_for(experiment: Experiment) -> None:
    """Train what an experiment needs, as `train`."""
    tracking, cache, artefact = experiment.parts.tracking, experiment.cache, experiment.identity.denoiser
    if artefact is None:
        raise DadiffError("denoiser: this one is exact, there is nothing to train")
    run_id = None
    if not cache.contains("denoiser", artefact.key) and not cache.is_building("denoiser", artefact.key):
        run_id = tracking.start(artefact.key, f"training/{artefact.key}", experiment.output_dir, "training")
    with _closing(tracking, run_id):
        experiment.prepare()
    tracking.log_training(cache.folder("denoiser", artefact.key), run_id)


def build_demonstrations(config: Mapping[str, Any]) -> None:
    """Build the demonstrations, unless they are cached."""
    _ = Experiment.of(config).demonstrations


def build_cases(config: Mapping[str, Any]) -> None:
    """Build the test cases, unless they are cached."""
    _ = Experiment.of(config).cases


@contextmanager
def _closing(tracking: Tracking, run_id: str | None, experiment: Experiment | None = None) -> Iterator[None]:
    """Close the MLflow run if the work raises; if its process is killed, the next start closes it.

    Args:
        experiment: of a run, which is stored where its failure is itself a result.
    """
    try:
        yield
    except BaseException as error:
        status, reason = why(error)
        if experiment is not None and status in DONE:
            record_end(experiment.identity, experiment.config, status, reason)
            tracking.log_run(experiment.results.read(experiment.identity.key), run_id)
        else:
            tracking.stop(run_id, status, reason)
        raise

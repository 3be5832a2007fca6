"""What a job does: train, or run one cell, and mirror it into MLflow. Every launcher and the single run use these."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from dadiff.config import build
from dadiff.errors import DadiffError
from dadiff.launching.outcome import why
from dadiff.running.identity import identify
from dadiff.running.provenance import record_of
from dadiff.store import DONE, Cache, Results, Status, StoredRun
from dadiff.tracking import Tracking

if TYPE_CHECKING:
    from dadiff.running.identity import Artefact


def tracking_of(config: Mapping[str, Any]) -> Tracking:
    """The tracking component of a resolved configuration.

    Raises:
        ConfigError: if it is not valid.
    """
    return build(config["tracking"], "tracking")


def run(config: Mapping[str, Any]) -> StoredRun:
    """Run one resolved configuration and mirror it into MLflow; what is done already is only mirrored."""
    from dadiff.running.experiment import execute

    tracking, identity = tracking_of(config), identify(config)
    if identity.denoiser is not None:
        train(config)
    if Results(config["output_dir"]).is_done(identity.key) and not config.get("force"):
        stored, run_id = execute(config), None
    else:
        run_id = tracking.start(identity.key, identity.name, config["output_dir"])
        with _closing(tracking, run_id, config):
            stored = execute(config)
    tracking.log_run(stored, run_id)
    return stored


def record_end(config: Mapping[str, Any], status: Status, reason: str) -> None:
    """Store how a run ended that gave no result of its own, unless a result with its key is already there."""
    record = record_of(identify(config), config, status, time.time(), reason=reason)
    Results(config["output_dir"]).write_failure(record)


def train(config: Mapping[str, Any]) -> None:
    """Build the trained denoiser, unless it is cached, and mirror its training into MLflow."""
    from dadiff.running.experiment import prepare

    tracking, artefact = tracking_of(config), _denoiser(config)
    cache = Cache(config["output_dir"])
    run_id = None
    if not cache.contains("denoiser", artefact.key) and not cache.is_building("denoiser", artefact.key):
        run_id = tracking.start(artefact.key, f"training/{artefact.key}", config["output_dir"], "training")
    with _closing(tracking, run_id):
        prepare(config)
    tracking.log_training(cache.folder("denoiser", artefact.key), run_id)


def build_demonstrations(config: Mapping[str, Any]) -> None:
    """Build the demonstrations, unless they are cached."""
    from dadiff.running.assembly import Experiment

    _ = Experiment.of(config).demonstrations


def build_cases(config: Mapping[str, Any]) -> None:
    """Build the test cases, unless they are cached."""
    from dadiff.running.assembly import Experiment

    _ = Experiment.of(config).cases


def _denoiser(config: Mapping[str, Any]) -> Artefact:
    artefact = identify(config).denoiser
    if artefact is None:
        raise DadiffError("denoiser: this one is exact, there is nothing to train")
    return artefact


@contextmanager
def _closing(tracking: Tracking, run_id: str | None, config: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Close the MLflow run if the work raises; if its process is killed, the next start closes it.

    Args:
        config: of a run, which is stored where its failure is itself a result.
    """
    try:
        yield
    except BaseException as error:
        status, reason = why(error)
        if config is not None and status in DONE:
            record_end(config, status, reason)
            tracking.log_run(Results(config["output_dir"]).read(identify(config).key), run_id)
        else:
            tracking.stop(run_id, status, reason)
        raise

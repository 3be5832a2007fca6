"""What a job does: build what runs share, or run one. Every launcher and the single run use these."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dadiff.launching.outcome import why
from dadiff.running.identity import Identity, Shared
from dadiff.running.provenance import record_of
from dadiff.store import Results, Status, StoredRun, is_read_only

if TYPE_CHECKING:
    from dadiff.running.assembly import Experiment


def run(config: Mapping[str, Any]) -> StoredRun:
    """Run one resolved configuration of a sweep, which has made what its runs share; what is done already is read."""
    from dadiff.running.assembly import Experiment
    from dadiff.running.experiment import execute

    return execute(Experiment.of(config, anew=()))


def run_tracked(experiment: Experiment) -> StoredRun:
    """Run what is assembled, and mirror whatever became of it, and its training, into MLflow.

    What is done, in a folder that cannot be written to, is read.
    """
    from dadiff.running.experiment import execute

    tracking, identity = experiment.parts.tracking, experiment.identity
    if experiment.is_done and is_read_only(experiment.output_dir):
        return experiment.results.read(identity.key)
    tracking.prepare()
    try:
        return execute(experiment)
    except BaseException as error:
        record_end(identity, experiment.config, *why(error))
        raise
    finally:
        if identity.denoiser is not None:
            tracking.log_training(experiment.output_dir, identity.denoiser.key)
        if experiment.results.status(identity.key) is not None:
            tracking.log_run(experiment.results.read(identity.key))


def build(config: Mapping[str, Any], kind: Shared) -> None:
    """Build what runs of a configuration share, unless it is cached."""
    from dadiff.running.assembly import Experiment

    Experiment.of(config, anew=(kind,)).build(kind)


def record_end(identity: Identity, config: Mapping[str, Any], status: Status, reason: str) -> None:
    """Store how a run ended that gave no result of its own, unless a result with its key is already there."""
    record = record_of(identity, config, status, time.time(), reason=reason)
    Results(config["output_dir"]).write_failure(record)

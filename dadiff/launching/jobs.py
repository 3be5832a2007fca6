"""What a job does: build what runs share, or run one. Every launcher and the single run use these."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dadiff.errors import DadiffError
from dadiff.launching.outcome import why
from dadiff.running.identity import Identity, Shared, identity_of
from dadiff.running.parts import Parts
from dadiff.running.provenance import record_of
from dadiff.store import Results, Status, StoredRun, is_read_only

if TYPE_CHECKING:
    from dadiff.running.assembly import Experiment


def run(config: Mapping[str, Any]) -> StoredRun:
    """Run one resolved configuration of a sweep, which has made what its runs share; what is done already is read."""
    from dadiff.running.assembly import Experiment
    from dadiff.running.experiment import execute

    return execute(Experiment.of(config, anew=()))


def stored_before(config: Mapping[str, Any]) -> StoredRun | None:
    """The result of a configuration that is done and mirrored, or lies where nothing can be written; None of others.

    Loads neither torch nor MLflow, so that a repeated command answers at once.

    Raises:
        ConfigError: if the configuration is not valid.
    """
    parts = Parts.of(config)
    key, output_dir = identity_of(parts).key, parts.settings.output_dir
    results = Results(output_dir)
    if parts.settings.force or not results.is_done(key):
        return None
    run = results.read(key)
    return run if is_read_only(output_dir) or parts.tracking.mirrors(output_dir, [run]) else None


def run_tracked(experiment: Experiment) -> StoredRun:
    """Run what is assembled, and mirror whatever became of it, and its training, into MLflow."""
    from dadiff.running.experiment import execute

    tracking, identity = experiment.parts.tracking, experiment.identity
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


def build(configs: Sequence[Mapping[str, Any]], kind: Shared) -> None:
    """Build what runs of these configurations share, unless it is cached; so that one that is refused harms no other.

    Raises:
        DadiffError: that of the first, if all of them are refused.
    """
    from dadiff.running.assembly import Experiment

    refusals: list[DadiffError] = []
    for config in configs:
        try:
            return Experiment.of(config, anew=(kind,)).build(kind)
        except DadiffError as refusal:
            refusals.append(refusal)
    raise refusals[0]


def record_end(identity: Identity, config: Mapping[str, Any], status: Status, reason: str) -> None:
    """Store how a run ended that gave no result of its own, unless a result with its key is already there."""
    record = record_of(identity, config, status, time.time(), reason=reason)
    Results(config["output_dir"]).write_failure(record)

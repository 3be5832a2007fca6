"""What the command line does, from plain Python: `dadiff.run` and `dadiff.results`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from dadiff import threads
from dadiff.commands import have_home
from dadiff.config.composed import plain
from dadiff.config.trust import trust
from dadiff.errors import ConfigError, StoreError
from dadiff.folders import shipped
from dadiff.launching import register
from dadiff.store import Results, StoredRun

if TYPE_CHECKING:
    import pandas as pd


def run(overrides: Sequence[str] = (), config_dir: Path | str | None = None) -> StoredRun:
    """Do one run, or read it if it was done before; the same as `dadiff override override ...`.

    Args:
        overrides: "task=lqr", "projector.initial_state=fixed", "output_dir=mine", ...
        config_dir: a folder of own presets, as `--config-dir`.

    Raises:
        DadiffError: where the command line would print its line.
    """
    from dadiff.launching.jobs import run_tracked, stored_before

    settle()
    config = configuration(overrides, config_dir)
    if config.get("dry_run"):
        raise ConfigError("dry_run: a dry run has no result; use the command line")
    if before := stored_before(config):
        return before
    from dadiff.running.assembly import Experiment

    return run_tracked(Experiment.of(config))


def results(output_dir: Path | str = "outputs") -> pd.DataFrame:
    """All stored runs, one row each: key, name, status, reason, axes, metrics, counts, seconds and folder.

    Raises:
        StoreError: if there is no such folder.
    """
    import pandas as pd

    if not Path(output_dir).is_dir():
        raise StoreError(f"{output_dir}: there is no such folder; expected the output_dir of runs")
    return pd.DataFrame([_row(run) for run in Results(output_dir)])


def _row(run: StoredRun) -> dict[str, Any]:
    record = run.record
    ends = {"key": record.key, "name": record.name, "status": record.status, "reason": record.reason}
    where = {"seconds": record.provenance.seconds, "folder": str(run.folder)}
    return {**ends, **record.axes, **record.metrics, **record.counts, **where}


def configuration(overrides: Sequence[str], config_dir: Path | str | None = None) -> dict[str, Any]:
    """The resolved configuration that overrides choose.

    Raises:
        ConfigError: if they do not make one.
    """
    trust(components_named(overrides))
    extra = [f"hydra.searchpath=[file://{Path(config_dir).absolute()}]"] if config_dir else []
    with initialize_config_dir(str(shipped("conf").absolute()), version_base="1.3"):
        config = compose("config", [*overrides, *extra], return_hydra_config=True)
    return plain(config, config.hydra.runtime.choices)


def components_named(overrides: Sequence[str]) -> list[str]:
    """The packages that overrides trust with `components=[...]`."""
    try:
        given = OverridesParser.create().parse_overrides([text for text in overrides if "components=" in text])
    except HydraException:
        return []  # Hydra will parse it again, and say what is wrong
    named = [override.value() for override in given if override.key_or_group == "components"]
    return [str(package) for value in named if isinstance(value, list) for package in value]


def settle() -> None:
    """Make this process ready for runs: threads, before torch is loaded, and what Hydra may do."""
    have_home()
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    if "torch" not in sys.modules:
        threads.settle()
    register()

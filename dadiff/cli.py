"""The command line `dadiff`: a Hydra application whose jobs are runs.

Heavy packages are imported when a run begins, so that help and configuration errors answer at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig

from dadiff import threads
from dadiff.config.composed import plain
from dadiff.config.trust import trust
from dadiff.errors import DadiffError
from dadiff.folders import shipped


def one_run(config: dict[str, Any]) -> None:
    """Execute one resolved configuration, track it, and print its table."""
    from dadiff.running.assembly import Experiment

    experiment = Experiment.of(config)
    if experiment.parts.settings.dry_run:
        print(f"{experiment.identity.key}  {experiment.identity.name}")
        return
    from dadiff.launching.jobs import run_tracked
    from dadiff.running.summary import summary

    before = experiment.is_done
    stored = run_tracked(experiment)
    print(summary([stored]))
    print(f"stored {'before, nothing was run: ' if before else 'in '}{stored.folder}")


@hydra.main(version_base="1.3", config_path=str(shipped("conf").absolute()), config_name="config")
def _application(config: DictConfig) -> None:
    reported(lambda: one_run(plain(config, HydraConfig.get().runtime.choices)))


def reported(work: Callable[[], None]) -> None:
    """Do the work; an error that the user can mend becomes one line and exit code 1."""
    try:
        work()
    except DadiffError as error:
        print(f"dadiff: error: {error}", file=sys.stderr)
        raise SystemExit(1) from error


def check_what_is_printed(arguments: list[str]) -> None:
    """For `dadiff --cfg ...`, which Hydra answers without running anything: check the configuration first."""
    given = get_args_parser().parse_args(arguments)
    if given.cfg is None:
        return
    from dadiff.config import assemble

    extra = [f"hydra.searchpath=[file://{Path(given.config_dir).absolute()}]"] if given.config_dir else []
    try:
        with initialize_config_dir(str(shipped("conf").absolute()), version_base="1.3"):
            config = compose("config", [*given.overrides, *extra], return_hydra_config=True)
    except HydraException:
        return  # Hydra will compose it again, and say it in its own words
    resolved = plain(config, config.hydra.runtime.choices)
    assemble(resolved)


def components_named(arguments: list[str]) -> list[str]:
    """The packages that the command line itself trusts with `components=[...]`."""
    overrides = get_args_parser().parse_args(arguments).overrides
    try:
        given = OverridesParser.create().parse_overrides([text for text in overrides if "components=" in text])
    except HydraException:
        return []  # Hydra will parse it again, and say what is wrong
    named = [override.value() for override in given if override.key_or_group == "components"]
    return [str(package) for value in named if isinstance(value, list) for package in value]


def main() -> None:
    """Entry point."""
    from dadiff.launching import register

    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    threads.settle()
    register()
    trust(components_named(sys.argv[1:]))
    reported(lambda: check_what_is_printed(sys.argv[1:]))
    reported(_application)


if __name__ == "__main__":
    main()

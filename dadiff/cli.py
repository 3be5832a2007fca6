"""The command line `dadiff`: a Hydra application whose jobs are runs.

Heavy packages are imported when a run begins, so that help and configuration errors answer at once.
"""

from __future__ import annotations

import sys
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dadiff import manual
from dadiff.commands import reported
from dadiff.config.composed import plain
from dadiff.config.trust import trust
from dadiff.errors import ConfigError
from dadiff.folders import shipped
from dadiff.interface import components_named, configuration, settle


def one_run(config: dict[str, Any]) -> None:
    """Execute one resolved configuration, track it, and print its table."""
    from dadiff.launching.jobs import run_tracked, stored_before
    from dadiff.running import summary
    from dadiff.running.identity import identify

    if config.get("dry_run"):
        identity = identify(config)
        print(f"{identity.key}  {identity.name}")
        return
    if before := stored_before(config):
        print(f"{summary.one_run(before)}\nstored before, nothing was run: {before.folder}")
        return
    from dadiff.running.assembly import Experiment

    stored = run_tracked(Experiment.of(config))
    print(f"{summary.one_run(stored)}\nstored in {stored.folder}")


@hydra.main(version_base="1.3", config_path=str(shipped("conf").absolute()), config_name="config")
def _application(config: DictConfig) -> None:
    choices = HydraConfig.get().runtime.choices
    if code := reported("dadiff", lambda: one_run(plain(config, choices))):
        raise SystemExit(code)


def check_what_is_printed(arguments: list[str]) -> None:
    """For `dadiff --cfg ...`, which Hydra answers without running anything: check the configuration first."""
    given = get_args_parser().parse_args(arguments)
    if given.experimental_rerun is not None:
        raise ConfigError("--experimental-rerun: is not offered, as it would load a pickle; give the overrides")
    if given.cfg is None:
        if given.resolve:
            raise ConfigError("--resolve: says how --cfg prints a configuration; give it with --cfg job")
        return
    from dadiff.config import assemble

    assemble(configuration(given.overrides, given.config_dir))


def overrides_first(arguments: list[str]) -> list[str]:
    """The arguments with overrides before options, since Hydra takes only one group of overrides."""
    flags = list(arguments)
    overrides = get_args_parser().parse_intermixed_args(arguments).overrides
    for override in overrides:
        flags.remove(override)
    return [*overrides, *flags]


def main() -> None:
    """Entry point."""
    sys.argv[1:] = overrides_first(sys.argv[1:])
    given = get_args_parser().parse_args(sys.argv[1:])
    if given.help:
        raise SystemExit(reported("dadiff", lambda: print(manual.text(given.config_dir))))
    settle()
    trust(components_named(given.overrides))
    raise SystemExit(
        reported("dadiff", lambda: check_what_is_printed(sys.argv[1:])) or reported("dadiff", _application)
    )


if __name__ == "__main__":
    main()

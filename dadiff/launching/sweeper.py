"""The Hydra sweeper `cells`: every combination of values, handed to the launcher, which composes and stores them.

Hydra's own writes a file first, also for a dry run or into a folder that is read only, and composes each cell twice.
"""

from __future__ import annotations

from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from dadiff.errors import ConfigError


class RunSweeper(BasicSweeper):
    """As Hydra's `basic`, but nothing is written and cells are composed by the launcher alone."""

    def sweep(self, arguments: list[str]) -> Any:
        """Launch the cells of the file's parameters, with the command's on top."""
        if self.hydra_context is None or self.launcher is None:
            raise ConfigError("hydra.sweeper: is not set up")
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        given = parser.parse_overrides(arguments)
        named = {override.key_or_group for override in given}  # whatever stands before the name, such as `++`
        filed = [o for o in parser.parse_overrides(self._parse_config()) if o.key_or_group not in named]
        batches = self.split_arguments([*filed, *given], self.max_batch_size)
        if not batches[0]:
            raise ConfigError("the sweep has no runs: one of its parameters ranges over nothing")
        return [self.launcher.launch(batch, initial_job_idx=0) for batch in batches]

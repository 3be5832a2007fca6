"""Configurations of a sweep's cells, composed quickly.

Hydra reads every preset again for every cell, twice. Cells that choose the same presets differ in values only,
so they are copies of one composition with those values set, which is what Hydra does last itself.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cache
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf


class Composer:
    """A Hydra config loader that composes each choice of presets once."""

    def __init__(self, loader: ConfigLoader) -> None:
        self._loader = loader
        self._bases: dict[tuple[str, ...], DictConfig] = {}
        self._cells: dict[tuple[str, ...], DictConfig] = {}
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed = cache(self._parse)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """The configuration of one cell; as `ConfigLoader.load_sweep_config`."""
        cell = tuple(sweep_overrides)
        if cell not in self._cells:
            values = [parsed for text in cell if (parsed := self._parsed(text)) is not None]
            lines = {value.input_line for value in values}
            chosen = (*(text for text in cell if text not in lines), *(value.key_or_group for value in values))
            if chosen not in self._bases:
                self._bases[chosen] = self._loader.load_sweep_config(master_config, sweep_overrides)
            self._cells[cell] = _with_values(self._bases[chosen], values)
        return self._cells[cell]

    def _parse(self, text: str) -> Override | None:
        """An override that sets a plain value; None for one that chooses a preset or does anything else."""
        (override,) = self._parser.parse_overrides([text])
        name = override.key_or_group
        plain = override.type == OverrideType.CHANGE and override.package is None and not name.startswith("hydra")
        return override if plain and not self._loader.get_group_options(name) else None


def _with_values(base: DictConfig, values: Sequence[Override]) -> DictConfig:
    config = copy.deepcopy(base)
    for override in values:
        OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    return config

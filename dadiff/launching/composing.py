"""Configurations of a sweep's cells, composed quickly.

Hydra reads every preset again for every cell, twice. Cells that choose the same presets differ in values only,
so they are copies of one composition with those values set, which is what Hydra does last itself. Of its own part of a
composition, the greater one, a cell needs no more than the names of the chosen presets.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf


@dataclass(frozen=True)
class Base:
    """A composition without Hydra's part, pickled: loading it is the fastest copy by far.

    Args:
        choices: group -> preset.
    """

    content: bytes
    choices: Mapping[str, str]

    @classmethod
    def of(cls, config: DictConfig) -> Base:
        """What cells need of a composition."""
        content = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        OmegaConf.set_struct(content, True)  # keys that are not there are refused
        return cls(pickle.dumps(content), dict(config.hydra.runtime.choices))

    def with_values(self, values: Sequence[Override]) -> DictConfig:
        """A copy with values set."""
        config: DictConfig = pickle.loads(self.content)
        for override in values:
            OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
        return config


class Composer:
    """A Hydra config loader that composes each choice of presets once."""

    def __init__(self, loader: ConfigLoader) -> None:
        self._loader = loader
        self._bases: dict[tuple[str, ...], Base] = {}
        self._cells: dict[tuple[str, ...], tuple[DictConfig, Mapping[str, str]]] = {}
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed = cache(self._parse)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """The configuration of one cell without Hydra's part; as `ConfigLoader.load_sweep_config`."""
        return self.cell(master_config, sweep_overrides)[0]

    def cell(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> tuple[DictConfig, Mapping[str, str]]:
        """The configuration of one cell, and its choices of presets by group."""
        cell = tuple(sweep_overrides)
        if cell not in self._cells:
            values = [parsed for text in cell if (parsed := self._parsed(text)) is not None]
            lines = {value.input_line for value in values}
            chosen = (*(text for text in cell if text not in lines), *(value.key_or_group for value in values))
            if chosen not in self._bases:
                self._bases[chosen] = Base.of(self._loader.load_sweep_config(master_config, list(cell)))
            base = self._bases[chosen]
            self._cells[cell] = base.with_values(values), base.choices
        return self._cells[cell]

    def _parse(self, text: str) -> Override | None:
        """An override that sets a plain value; None for one that chooses a preset or does anything else."""
        (override,) = self._parser.parse_overrides([text])
        name = override.key_or_group
        plain = override.type == OverrideType.CHANGE and override.package is None and not name.startswith("hydra")
        return override if plain and not self._loader.get_group_options(name) else None

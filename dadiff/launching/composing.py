"""Configurations of a sweep's cells, composed quickly.

Hydra reads every preset again for every cell, twice. Cells that choose the same presets differ in values only, so they
are copies of one composition, resolved once, with those values set wherever they are read, which is what Hydra does
last itself. Where that cannot be seen at once, because a value is a mapping or is read inside an expression, omegaconf
sets and resolves it.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf

from dadiff.config.composed import plain

REFERENCE = re.compile(r"\$\{([A-Za-z_][\w.]*)\}")
"""An interpolation that takes another key's value as it is."""
INDIRECT = re.compile(r"\$\{\.|\$\{[^}]*\$\{")
"""One whose text does not name the key that it reads: relative, or made by another one."""
WORD = re.compile(r"[A-Za-z_][\w.]*")


@dataclass(frozen=True)
class Base:
    """A composition without Hydra's part, as the first cell that chose its presets has it.

    Args:
        content: pickled, its interpolations as they are written.
        resolved: pickled, plain; loading it is the fastest copy by far.
        values: key -> value, of the overrides that are values.
        readers: key -> the keys that take its value.
        read: words of all other interpolations, keys among them; None where an interpolation may read any key.
        choices: group -> preset.
    """

    content: bytes
    resolved: bytes
    values: Mapping[str, Any]
    readers: Mapping[str, Sequence[str]]
    read: frozenset[str] | None
    choices: Mapping[str, str]

    @classmethod
    def of(cls, config: DictConfig, values: Sequence[Override]) -> Base:
        """What cells need of a composition.

        Raises:
            ConfigError: if it cannot be resolved.
        """
        choices = dict(config.hydra.runtime.choices)
        content = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        OmegaConf.set_struct(content, True)  # keys that are not there are refused
        written = {k: str(text) for k, text in _leaves(OmegaConf.to_container(content)) if "${" in str(text)}
        taken = {key: match[1] for key, text in written.items() if (match := REFERENCE.fullmatch(text))}
        others = [text for key, text in written.items() if key not in taken]
        return cls(
            pickle.dumps(content),
            pickle.dumps(plain(content, choices)),
            {value.key_or_group: value.value() for value in values},
            {source: [key for key, other in taken.items() if other == source] for source in taken.values()},
            None if any(map(INDIRECT.search, others)) else frozenset(WORD.findall(" ".join(others))),
            choices,
        )

    def cell(self, values: Sequence[Override]) -> dict[str, Any]:
        """A resolved copy with values set.

        Raises:
            ConfigError: if it cannot be resolved.
        """
        changed = {value.key_or_group: value.value() for value in values}
        changed = {k: v for k, v in changed.items() if type(v) is not type(self.values[k]) or v != self.values[k]}
        if not all(map(self._is_plain, changed, changed.values())):
            return self._composed(values)
        config: dict[str, Any] = pickle.loads(self.resolved)
        for key, value in changed.items():
            for place in self._places(key):
                _put(config, place, value)
        return config

    def _is_plain(self, key: str, value: Any) -> bool:
        """Whether setting a value is all that it changes: none is made absolute, merged, or read in an expression."""
        if self.read is None or key == "output_dir" or not isinstance(value, int | float | str | None):
            return False
        parts = any(other.startswith(f"{key}.") or key.startswith(f"{other}.") for other in {*self.readers, *self.read})
        expressed = any(place in self.read for place in self._places(key))
        return not parts and not expressed and "${" not in str(value)

    def _places(self, key: str) -> Iterator[str]:
        """The key, and all that take its value, at first or second hand."""
        yield key
        for reader in self.readers.get(key, ()):
            yield from self._places(reader)

    def _composed(self, values: Sequence[Override]) -> dict[str, Any]:
        config: DictConfig = pickle.loads(self.content)
        for override in values:
            new = override.type == OverrideType.FORCE_ADD
            OmegaConf.update(config, override.key_or_group, override.value(), merge=True, force_add=new)
        return plain(config, self.choices)


class Composer:
    """Composes each choice of presets of a sweep once.

    Args:
        master: the sweep's own configuration.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader, self._master = loader, master
        self._bases: dict[tuple[str, ...], Base] = {}
        self._parser = OverridesParser.create(config_loader=loader)
        self._parsed = cache(self._parse)

    def cell(self, overrides: Sequence[str]) -> dict[str, Any]:
        """The resolved configuration of one cell, as `dadiff.config.composed.plain` gives it.

        Raises:
            ConfigError: if it cannot be composed.
        """
        values = [parsed for text in overrides if (parsed := self._parsed(text)) is not None]
        lines = {value.input_line for value in values}
        chosen = (*(text for text in overrides if text not in lines), *(value.key_or_group for value in values))
        if chosen not in self._bases:
            self._bases[chosen] = Base.of(self._loader.load_sweep_config(self._master, list(overrides)), values)
        return self._bases[chosen].cell(values)

    def _parse(self, text: str) -> Override | None:
        """An override that sets a plain value; None for one that chooses a preset or does anything else."""
        (override,) = self._parser.parse_overrides([text])
        name = override.key_or_group
        sets = override.type in (OverrideType.CHANGE, OverrideType.FORCE_ADD)
        plain = sets and override.package is None and not name.startswith("hydra")
        return override if plain and not self._loader.get_group_options(name) else None


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key -> value; a list is one value."""
    for name, value in node.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _put(config: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key."""
    *above, last = key.split(".")
    for name in above:
        config = config[name]
    config[last] = value

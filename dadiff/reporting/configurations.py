"""The resolved configurations behind a report: once what all cells share, and for each cell what sets it apart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from dadiff.reporting.sources import Sweep

PLACES = ("output_dir", "tracking", "force", "dry_run", "progress")
"""Groups that say where and how a run is done, but not what it gives."""


def to_yaml(sweep: Sweep) -> str:
    """`shared` and `cells` as yaml, parameters under dotted names; cells that stored nothing are left out.

    What sets a cell apart stands by groups (system, projector, ...), and those that cells have in common are said once,
    where the first has them: `&` names one and `*` stands for it, as yaml readers know.
    """
    configs = {cell.key: flat(cell.record.config) for cell in sweep.cells if cell.record}
    first = next(iter(configs.values()), {})
    shared = {name: value for name, value in first.items() if all(_has(c, name, value) for c in configs.values())}
    names = {cell.key: cell.name for cell in sweep.cells}
    said: dict[str, Any] = {}
    cells = {
        key: {"run": names[key], **_groups({name: value for name, value in config.items() if name not in shared}, said)}
        for key, config in configs.items()
    }
    return _yaml(shared, cells)


def _yaml(shared: Mapping[str, Any], cells: Mapping[str, Any]) -> str:
    looks: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "default_flow_style": None, "width": 120}
    return yaml.safe_dump({"shared": shared, "cells": cells}, **looks)


def _groups(config: Mapping[str, Any], said: dict[str, Any]) -> dict[str, Any]:
    """Parameters below their groups; equal groups are one object, `said` before."""
    groups: dict[str, Any] = {}
    for name, value in config.items():
        group, _, rest = name.partition(".")
        if rest:
            groups.setdefault(group, {})[rest] = value
        else:
            groups[group] = value
    return {name: said.setdefault(repr(part), part) for name, part in groups.items()}


def flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted name -> value, without `PLACES`; lists are values."""
    return dict(_leaves({name: part for name, part in config.items() if name not in PLACES}, ""))


def _leaves(config: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    found = []
    for name, value in config.items():
        nested = isinstance(value, Mapping) and value
        found += _leaves(value, f"{prefix}{name}.") if nested else [(f"{prefix}{name}", value)]
    return found


def _has(config: Mapping[str, Any], name: str, value: Any) -> bool:
    return name in config and config[name] == value

"""Numbers in fewer bytes, for what is kept under version control: what the tables, the drawings and the configurations
of a published report say is not said again in its `report.json`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

DIGITS = 6
"""Of numbers in report.json: the last ones differ between processors."""

CSV_DIGITS = 9

CURVE, DRAWN_DIGITS = 9, 3
"""A figure's lists of so many numbers are drawn, not read: they have as many digits as a page can show."""

DEPTH = 3
"""Levels of report.json that have a line an entry; what lies below stands on one."""


def numbers(content: dict[str, Any]) -> str:
    """JSON to `DIGITS` significant digits, indented where it says what there is and dense below.

    What the methods of figures were configured with stands in configurations.yaml, by their runs.
    """
    figures = {name: _drawn(part) for name, part in content.get("figures", {}).items()}
    return _dense(_rounded({**content, **({"figures": figures} if figures else {})}), 0) + "\n"


def table(csv: str) -> str:
    """A csv whose long numbers have `CSV_DIGITS` significant digits."""
    return re.sub(r"-?\d+\.\d{9,}(?:e-?\d+)?", lambda found: repr(_rounded(float(found[0]), CSV_DIGITS)), csv)


def _drawn(value: Any) -> Any:
    """Of a figure: without axes, and curves with the digits that are seen."""
    if isinstance(value, dict):
        return {name: _drawn(part) for name, part in value.items() if name != "axes"}
    if isinstance(value, list):
        digits = DRAWN_DIGITS if len(value) >= CURVE else DIGITS
        return [_rounded(part, digits) if isinstance(part, float) else _drawn(part) for part in value]
    return value


def _dense(value: Any, depth: int) -> str:
    if depth == DEPTH or not value or not isinstance(value, (dict, list)):
        return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    parts = [_dense(part, depth + 1) for part in (value.values() if isinstance(value, dict) else value)]
    if isinstance(value, dict):
        parts = [f"{json.dumps(name, ensure_ascii=False)}: {part}" for name, part in zip(value, parts, strict=True)]
    ends = "{}" if isinstance(value, dict) else "[]"
    blanks = " " * (depth + 1)
    return f"{ends[0]}\n{blanks}" + f",\n{blanks}".join(parts) + f"\n{' ' * depth}{ends[1]}"


def _rounded(value: Any, digits: int = DIGITS) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(part, digits) for name, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part, digits) for part in value]
    return float(f"{value:.{digits + _beside_one(value)}g}") if isinstance(value, float) else value


def _beside_one(value: float) -> int:
    """Digits that a number close to 1 needs more: of costs over the optimum, what lies above 1 is read."""
    beside = abs(value - 1)
    return max(-math.floor(math.log10(beside)) - 2, 0) if beside > 1e-9 else 0


IN_CSV = ("difference",)
"""Parts of a table's values that its csv has, and no page shows."""

DRAWN = ("dots",)
"""Of a figure, what only its drawing shows."""


def packed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a report as its published folder needs it: `unpacked` gives back what pages and verdicts read.

    Estimates are lists [value, low, high], runs are places in `cells`, which are named in configurations.yaml.
    """
    places = {cell["key"]: place for place, cell in enumerate(content["cells"])}
    claims = [
        {**claim, "findings": [_without(found, "text") for found in claim["findings"]]} if "aside" in claim
        else _without(claim, "lines") for claim in content["claims"]
    ]  # fmt: skip
    small = {**content, "cells": [_cell(cell) for cell in content["cells"]], "claims": claims}
    return {name: part if name == "cells" else _packed(part, places) for name, part in small.items()}


def unpacked(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a report, packed or not, with runs by their keys."""
    keys = [cell["key"] for cell in content["cells"]]
    return {name: _unpacked(part, keys) for name, part in content.items()}


def _without(content: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: part for name, part in content.items() if name not in names}


def _cell(cell: Mapping[str, Any]) -> dict[str, Any]:
    """A cell; what finished has its name in configurations.yaml."""
    return {name: cell[name] for name in ("key", "status")} if cell["status"] == "finished" else dict(cell)


def _packed(value: Any, places: Mapping[str, int]) -> Any:
    if isinstance(value, Mapping):
        if value.keys() == {"value", "low", "high"}:
            return [value[end] for end in ("value", "low", "high")]
        kept = _without(value, *IN_CSV, *DRAWN)
        return {name: _places(part, places) if name == "runs" else _packed(part, places) for name, part in kept.items()}
    return [_packed(part, places) for part in value] if isinstance(value, list) else value


def _places(runs: Any, places: Mapping[str, int]) -> Any:
    return [places.get(run, run) for run in runs] if isinstance(runs, list) else runs


def _unpacked(value: Any, keys: list[str]) -> Any:
    if isinstance(value, Mapping):
        return {name: _keys(part, keys) if name == "runs" else _unpacked(part, keys) for name, part in value.items()}
    return [_unpacked(part, keys) for part in value] if isinstance(value, list) else value


def _keys(runs: Any, keys: list[str]) -> Any:
    return [keys[run] if isinstance(run, int) else run for run in runs] if isinstance(runs, list) else runs

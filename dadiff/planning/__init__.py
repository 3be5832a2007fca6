"""Planning: a trained model as something that gives plans, from memory or from one self-contained file."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dadiff.planning.planner import Planner
    from dadiff.planning.plans import Plans

__all__ = ["Planner", "Plans"]

HOMES = {"Planner": "dadiff.planning.planner", "Plans": "dadiff.planning.plans"}
"""Loaded when they are first asked for, so that `dadiff-plan --help` does not wait for torch."""


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'dadiff.planning' has no attribute {name!r}")
    return getattr(importlib.import_module(HOMES[name]), name)

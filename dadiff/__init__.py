"""dadiff: dynamics-aware diffusion for planning and control, as an experiment-tracking harness.

run = dadiff.run(["task=lqr", "projector=known_fixed"])     one run, or what is stored of it
runs = dadiff.results("outputs")                            a DataFrame, one row a run
planner = dadiff.Planner.load(run.folder)                   plans from what was trained
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dadiff.interface import results, run
    from dadiff.planning import Planner

__version__ = "0.1.0"
__all__ = ["Planner", "results", "run"]

HOMES = {"run": "dadiff.interface", "results": "dadiff.interface", "Planner": "dadiff.planning"}
"""Where each lives; loaded when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module 'dadiff' has no attribute {name!r}")
    return getattr(importlib.import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *HOMES])

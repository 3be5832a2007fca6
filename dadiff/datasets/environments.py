"""Environments from a file of one's own: a yaml list, or an npz with the same arrays.

A yaml file holds a list of mappings, positions in metres and times in steps:

    - x_init: [0, 0, 0.5, 0]
      target: [3, 1]
      waypoints: [{position: [0.5, 0.2], time: 5}]
      obstacles: [{centre: [1.5, 0.5], radius: 0.4}]

An npz file holds x_init (N, 4), target (N, 2), waypoints (N, W, 3) as x, y, time and obstacles (N, O, 3) as x, y,
radius; a slot whose three numbers are all nan is empty. Waypoints and obstacles may be left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dadiff.errors import DataError
from dadiff.outside import npz, yaml_of
from dadiff.tasks.environments import OPTIONAL, PARTS, REQUIRED, check, encode, join, parse
from dadiff.tasks.obstacles import Obstacles


def load_environments(path: str | Path, task: Obstacles, time_step: float = 0.1) -> np.ndarray:
    """Condition vectors (N, c) of the environments in a yaml or npz file.

    Args:
        time_step: of the system, in seconds; x_init fixes p(1) too, which must be clear of discs.

    Raises:
        DataError: naming file, environment and field, if something is missing, of a wrong shape or unusable.
        InfeasibleError: if start, waypoint or target lies inside a disc.
    """
    path = Path(path)
    readers = {".yaml": _from_yaml, ".yml": _from_yaml, ".npz": _from_npz}
    if path.suffix not in readers:
        raise DataError(f"{path}: a file of environments ends in .yaml or .npz; found '{path.suffix}'")
    if not path.is_file():
        raise DataError(f"{path}: no such file; set dataset.path to a yaml or npz file of environments")
    records = readers[path.suffix](path)
    if not records:
        raise DataError(f"{path}: holds no environment; expected at least one")
    environments = join(
        [parse(r, task.max_waypoints, task.max_obstacles, f"{path}: environment {i}") for i, r in enumerate(records)]
    )
    check(environments, task.horizon, time_step, where=f"{path}: ")
    return encode(environments, task.horizon)


def _from_yaml(path: Path) -> list[Any]:
    content = yaml_of(path)
    if not isinstance(content, list):
        raise DataError(f"{path}: expected a list of environments; found {type(content).__name__}")
    return content


def _from_npz(path: Path) -> list[Any]:
    with npz(path) as file:
        arrays = {name: file[name] for name in file.files}
    for name in REQUIRED:
        if name not in arrays:
            raise DataError(f"{path}: '{name}' is missing; expected arrays {', '.join(REQUIRED + OPTIONAL)}")
    if flat := [name for name, a in arrays.items() if a.ndim == 0]:
        raise DataError(f"{path}: {flat[0]} is a single number; expected one row for each environment")
    lengths = {name: len(a) for name, a in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(f"{path}: arrays hold different numbers of environments: {lengths}")
    slots = {name: arrays.pop(name) for name in OPTIONAL if name in arrays}
    for name, a in slots.items():
        if a.ndim != 3 or a.shape[-1] != 3:
            raise DataError(f"{path}: {name} has shape {a.shape}; expected (N, slots, 3)")
    rows = [{name: a[i] for name, a in arrays.items()} for i in range(next(iter(lengths.values())))]
    for name, a in slots.items():
        place, number = PARTS[name]
        for row, values in zip(rows, a, strict=True):
            row[name] = [{place: v[:2], number: v[2]} for v in values if not np.isnan(v).all()]
    return rows

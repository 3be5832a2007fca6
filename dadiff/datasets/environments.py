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

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dadiff.datasets.files import opened
from dadiff.errors import DataError
from dadiff.tasks.environments import Environments, check, encode, join
from dadiff.tasks.obstacles import Obstacles

_REQUIRED, _OPTIONAL = ("x_init", "target"), ("waypoints", "obstacles")
_PARTS = {"waypoints": ("position", "time"), "obstacles": ("centre", "radius")}


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
    environments = join([_parse(r, f"{path}: environment {i}", task) for i, r in enumerate(records)])
    check(environments, task.horizon, time_step, where=f"{path}: ")
    return encode(environments, task.horizon)


def _from_yaml(path: Path) -> list[Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not readable as yaml: {' '.join(str(error).split())}") from error
    if not isinstance(content, list):
        raise DataError(f"{path}: expected a list of environments; found {type(content).__name__}")
    return content


def _from_npz(path: Path) -> list[Any]:
    with opened(path, "an array") as file:
        arrays = {name: file[name] for name in file.files}
    for name in _REQUIRED:
        if name not in arrays:
            raise DataError(f"{path}: '{name}' is missing; expected arrays {', '.join(_REQUIRED + _OPTIONAL)}")
    if flat := [name for name, a in arrays.items() if a.ndim == 0]:
        raise DataError(f"{path}: {flat[0]} is a single number; expected one row for each environment")
    lengths = {name: len(a) for name, a in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(f"{path}: arrays hold different numbers of environments: {lengths}")
    slots = {name: arrays.pop(name) for name in _OPTIONAL if name in arrays}
    for name, a in slots.items():
        if a.ndim != 3 or a.shape[-1] != 3:
            raise DataError(f"{path}: {name} has shape {a.shape}; expected (N, slots, 3)")
    rows = [{name: a[i] for name, a in arrays.items()} for i in range(next(iter(lengths.values())))]
    for name, a in slots.items():
        place, number = _PARTS[name]
        for row, values in zip(rows, a, strict=True):
            row[name] = [{place: v[:2], number: v[2]} for v in values if not np.isnan(v).all()]
    return rows


def _parse(record: Any, place: str, task: Obstacles) -> Environments:
    """One environment (N = 1) from a mapping."""
    _check_keys(record, place, _REQUIRED, _OPTIONAL)
    x_init, target = _numbers(record, "x_init", 4, place), _numbers(record, "target", 2, place)
    waypoints = _slots(record, "waypoints", task.max_waypoints, place)
    obstacles = _slots(record, "obstacles", task.max_obstacles, place)
    parts = (x_init, target, *_columns(waypoints), *_columns(obstacles))
    return Environments(*(part[None] for part in parts))


def _slots(record: Mapping[str, Any], field: str, most: int, place: str) -> np.ndarray:
    """The slots of a field, (most, 4): x, y, time or radius, mask."""
    items = record.get(field) or []
    if not isinstance(items, list):
        raise DataError(f"{place}: {field} is {type(items).__name__}; expected a list")
    if len(items) > most:
        raise DataError(f"{place}: {field} are {len(items)}; task.max_{field} is {most}, and so is a model's")
    point, number = _PARTS[field]
    slots = np.zeros((most, 4))
    for k, item in enumerate(items):
        where = f"{place}: {field}[{k}]"
        _check_keys(item, where, _PARTS[field], ())
        slots[k] = [*_numbers(item, point, 2, where), *_numbers(item, number, 1, where), 1]
    return slots


def _columns(slots: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return slots[:, :2], slots[:, 2], slots[:, 3] > 0


def _check_keys(record: Any, place: str, required: tuple[str, ...], optional: tuple[str, ...]) -> None:
    if not isinstance(record, Mapping):
        raise DataError(f"{place}: expected a mapping with {', '.join(required)}; found {type(record).__name__}")
    for name in required:
        if name not in record:
            raise DataError(f"{place}: '{name}' is missing; expected {', '.join(required)}")
    for name in record:
        if name not in required + optional:
            raise DataError(f"{place}: '{name}' is not known; expected {', '.join(required + optional)}")


def _numbers(record: Mapping[str, Any], field: str, count: int, place: str) -> np.ndarray:
    """The field as (count,) floats."""
    try:
        values = np.atleast_1d(np.asarray(record[field], dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise DataError(f"{place}: {field} is {record[field]!r}; expected {count} numbers") from error
    if values.shape != (count,):
        raise DataError(f"{place}: {field} has shape {values.shape}; expected {count} numbers")
    return values

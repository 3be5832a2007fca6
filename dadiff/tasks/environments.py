"""Environments of the obstacle task: their arrays, their checks, and the condition vector E that encodes them.

    E = [x_init (4), target (2), W waypoint slots (x, y, t/T, mask), O obstacle slots (x, y, r, mask)]

Absent slots are zero. E holds the whole environment, so that `decode` undoes `encode`. `condition` is its layout.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from dadiff.errors import DataError, InfeasibleError
from dadiff.tasks.task import numbers
from dadiff.trajectory.layout import Array, Channel, Layout

REQUIRED, OPTIONAL = ("x_init", "target"), ("waypoints", "obstacles")
PARTS = {"waypoints": ("position", "time"), "obstacles": ("centre", "radius")}


@dataclass(frozen=True)
class Environments:
    """N environments with W waypoint slots and O obstacle slots; what a mask leaves out is zero.

    Args:
        x_init: (N, 4), positions and velocities.
        target: (N, 2), due at T.
        waypoint: (N, W, 2).
        time: (N, W), in steps.
        due: whether there is a waypoint, (N, W).
        centre: (N, O, 2).
        radius: (N, O), without margin.
        present: whether there is an obstacle, (N, O).
    """

    x_init: np.ndarray
    target: np.ndarray
    waypoint: np.ndarray
    time: np.ndarray
    due: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    present: np.ndarray

    @property
    def count(self) -> int:
        """N."""
        return len(self.x_init)

    def take(self, index: np.ndarray) -> Environments:
        """The environments at `index`."""
        return Environments(*(getattr(self, field.name)[index] for field in fields(self)))


def join(parts: list[Environments]) -> Environments:
    """One set of environments after the other."""
    return Environments(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Environments)))


def condition(max_waypoints: int, max_obstacles: int) -> Layout:
    """The layout of E: waypoints (W, 4) and obstacles (O, 4) are slots."""
    waypoints = Channel("waypoints", 4, 1, max_waypoints, ("x", "y", "t/T", "mask"))
    obstacles = Channel("obstacles", 4, 1, max_obstacles, ("x", "y", "radius", "mask"))
    start = Channel("x_init", 4, labels=("x", "y", "vx", "vy"))
    return Layout((start, Channel("target", 2, labels=("x", "y")), waypoints, obstacles))


def present(slots: Array) -> Array:
    """The first three numbers of the slots (k, 4) that are not empty: (x, y, t/T) or (x, y, radius)."""
    return slots[slots[:, 3] > 0.5][:, :3]


def encode(environments: Environments, horizon: int) -> np.ndarray:
    """E, (N, c)."""
    e = environments
    waypoints = np.concatenate([e.waypoint, e.time[..., None] / horizon, e.due[..., None]], axis=-1)
    obstacles = np.concatenate([e.centre, e.radius[..., None], e.present[..., None]], axis=-1)
    layout = condition(e.due.shape[1], e.present.shape[1])
    return layout.pack(x_init=e.x_init, target=e.target, waypoints=waypoints, obstacles=obstacles)


def decode(environment: np.ndarray, layout: Layout, horizon: int) -> Environments:
    """The environments of E (N, c).

    Raises:
        ShapeError: if c is not the length of the layout.
    """
    E = layout.unpack(environment)
    waypoints, obstacles = E["waypoints"], E["obstacles"]
    time, due, there = np.rint(waypoints[..., 2] * horizon), waypoints[..., 3] > 0.5, obstacles[..., 3] > 0.5
    return Environments(
        E["x_init"], E["target"], waypoints[..., :2], time, due, obstacles[..., :2], obstacles[..., 2], there
    )


def check(environments: Environments, horizon: int, time_step: float, where: str = "") -> None:
    """Raise unless every environment can be solved; the message names its index and the field.

    Args:
        time_step: in seconds; x_init fixes p(1) too.
        where: what the message begins with, such as a file's name.

    Raises:
        DataError: for values that are not finite, negative radii, or times that are doubled or outside 1..T.
        InfeasibleError: if start, waypoint or target lies inside a disc.
    """
    for index in range(environments.count):
        one = environments.take(np.array([index]))
        place = f"{where}environment {index}"
        _check_values(one, place)
        _check_times(one, horizon, place)
        _check_clear(one, time_step, place)


def _check_values(one: Environments, place: str) -> None:
    named: list[tuple[str, Any]] = [("x_init", one.x_init), ("target", one.target)]
    for k in np.flatnonzero(one.due[0]):
        named += [(f"waypoints[{k}].position", one.waypoint[0, k]), (f"waypoints[{k}].time", one.time[0, k])]
    for j in np.flatnonzero(one.present[0]):
        named += [(f"obstacles[{j}].centre", one.centre[0, j]), (f"obstacles[{j}].radius", one.radius[0, j])]
    for name, value in named:
        if not np.isfinite(value).all():
            raise DataError(f"{place}: {name} is {_show(value)}; every number must be finite")
        if name.endswith("radius") and value <= 0:
            raise DataError(f"{place}: {name} is {value:g}; a radius must be positive (metres)")


def _check_times(one: Environments, horizon: int, place: str) -> None:
    seen = {horizon: "the target, which is due at T"}
    for k in np.flatnonzero(one.due[0]):
        time, name = one.time[0, k], f"waypoints[{k}].time"
        if time != np.rint(time) or not 1 <= time <= horizon:
            raise DataError(f"{place}: {name} is {time:g}; expected a whole number in 1..{horizon} (steps)")
        if int(time) in seen:
            raise DataError(f"{place}: {name} is {time:g}, the time of {seen[int(time)]}; no two may share a time")
        seen[int(time)] = f"waypoints[{k}]"


def _check_clear(one: Environments, time_step: float, place: str) -> None:
    position = one.x_init[0, :2]
    points = [("x_init", position), ("x_init (after one step)", position + time_step * one.x_init[0, 2:])]
    points += [(f"waypoints[{k}].position", one.waypoint[0, k]) for k in np.flatnonzero(one.due[0])]
    points.append(("target", one.target[0]))
    for name, point in points:
        for j in np.flatnonzero(one.present[0]):
            centre, radius = one.centre[0, j], one.radius[0, j]
            if np.linalg.norm(point - centre) < radius:
                raise InfeasibleError(
                    f"{place}: {name} {_show(point)} lies inside obstacles[{j}] (centre {_show(centre)}, radius "
                    f"{radius:g}); move one of them"
                )


def _show(value: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:g}" for v in np.ravel(value)) + ")"


def parse(record: Any, max_waypoints: int, max_obstacles: int, place: str) -> Environments:
    """One environment (N = 1) from a mapping with x_init, target, and lists of waypoints and obstacles.

    Raises:
        DataError: naming place and field, if something is missing, not known, or of a wrong shape.
    """
    _check_keys(record, place, REQUIRED, OPTIONAL)
    x_init, target = numbers(record["x_init"], "x_init", (4,), place), numbers(record["target"], "target", (2,), place)
    waypoints = _slots(record, "waypoints", max_waypoints, place)
    obstacles = _slots(record, "obstacles", max_obstacles, place)
    parts = (x_init, target, *_columns(waypoints), *_columns(obstacles))
    return Environments(*(part[None] for part in parts))


def _slots(record: Mapping[str, Any], field: str, most: int, place: str) -> np.ndarray:
    """The slots of a field, (most, 4): x, y, time or radius, mask."""
    items = record.get(field) or []
    if not isinstance(items, list):
        raise DataError(f"{place}: {field} is {type(items).__name__}; expected a list")
    if len(items) > most:
        raise DataError(f"{place}: {field} are {len(items)}; task.max_{field} is {most}, and so is a model's")
    point, number = PARTS[field]
    slots = np.zeros((most, 4))
    for k, item in enumerate(items):
        where = f"{place}: {field}[{k}]"
        _check_keys(item, where, PARTS[field], ())
        slots[k] = [*numbers(item[point], point, (2,), where), *numbers(item[number], number, (1,), where), 1]
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

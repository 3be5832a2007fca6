"""An animation of robots that execute their plans, at their pace: in the robots' plane, and rendered if they can be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dadiff.errors import DataError
from dadiff.planning.planner import Planner
from dadiff.planning.plans import Plans
from dadiff.tasks.environments import present
from dadiff.tasks.task import Steering

if TYPE_CHECKING:
    from matplotlib.animation import AbstractMovieWriter
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 12  # plans that are shown, the first ones
SIDE = 5.0  # inches
PER_SECOND = 10.0  # frames, where the time between two states is not known


@dataclass(frozen=True)
class Scene:
    """What is seen: plans, what becomes of them, and what lies in the plane.

    Args:
        planned, executed: positions, (plans, T+1, 2).
        outlines: of the robots as they execute their plans, (plans, T+1, k, 2).
        target: (2,), or None where E names none.
        waypoints, discs: (k, 3), as x, y, t / T and x, y, r.
        labels: of the axes.
        time_step: seconds between two frames.
        frames: rendered pictures of the first plan, (T+1, height, width, 3), or None.
    """

    planned: np.ndarray = field(repr=False)
    executed: np.ndarray = field(repr=False)
    outlines: np.ndarray = field(repr=False)
    target: np.ndarray | None
    waypoints: np.ndarray
    discs: np.ndarray
    labels: Sequence[str]
    time_step: float
    frames: np.ndarray | None = field(default=None, repr=False)

    @classmethod
    def of(cls, planner: Planner, plans: Plans, environment: np.ndarray) -> Scene:
        """Of plans for one condition E (c,).

        Raises:
            DataError: if there is no plane: the robot has one state.
        """
        if planner.layout.state_dim < 2:
            raise DataError("animation: the robot has one state, and a plane needs two; draw the plans with --plot")
        system, E = planner.system, planner.condition.unpack(environment)
        executed = system.replay(E["x_init"], plans.inputs)
        outlines = system.outline(executed)
        waypoints, discs = (present(E[name]) if name in E else np.empty((0, 3)) for name in ("waypoints", "obstacles"))
        return cls(
            _flat(system.position(plans.states), 2),
            _flat(system.position(executed), 2),
            _flat(outlines, 3),
            _target(planner, environment),
            waypoints,
            discs,
            (system.plane or plans.columns("x"))[:2],
            plans.time_step or 1 / PER_SECOND,
            system.frames(executed.reshape(-1, *executed.shape[-2:])[0]),
        )

    @property
    def window(self) -> tuple[np.ndarray, float]:
        """The middle (2,) and half of the side of a square around everything that stays finite."""
        points = [self.planned.reshape(-1, 2), self.outlines.reshape(-1, 2), self.discs[:, :2], self.waypoints[:, :2]]
        seen = np.concatenate([*points, np.empty((0, 2)) if self.target is None else self.target[None]])
        seen = seen[np.isfinite(seen).all(axis=-1)]
        low, high = seen.min(axis=0), seen.max(axis=0)
        return (low + high) / 2, 0.55 * max(float((high - low).max()), 0.5)


def _target(planner: Planner, environment: np.ndarray) -> np.ndarray | None:
    """Where the robot should come, (2,), of E (c,)."""
    if isinstance(planner.task, Steering):
        goal = planner.task.goal(planner.system, environment)
        return planner.system.position(goal).reshape(-1, 2)[0]
    E = planner.condition.unpack(environment)
    return E["target"][:2] if "target" in E else None


def _flat(array: np.ndarray, kept: int) -> np.ndarray:
    """The first plans, in one leading dimension before the last `kept`."""
    return array.reshape(-1, *array.shape[-kept:])[:MOST]


def animate(planner: Planner, plans: Plans, environment: np.ndarray, path: Path) -> Path:
    """Write robots executing their plans as .gif, or as .mp4 where ffmpeg is installed.

    Raises:
        DataError: for another suffix, without ffmpeg, or if the place cannot be written to.
    """
    from matplotlib.animation import FuncAnimation

    scene = Scene.of(planner, plans, environment)
    writer = _writer(path, 1 / scene.time_step)
    figure, update = drawn(scene)
    film = FuncAnimation(figure, update, frames=scene.planned.shape[1], blit=False)
    try:
        film.save(path, writer=writer, dpi=90)
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); name another place") from error
    return path


def drawn(scene: Scene) -> tuple[Figure, Callable[[int], None]]:
    """The picture, and what moves it on to a time t."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = 1 if scene.frames is None else 2
    figure = Figure(figsize=(columns * SIDE, SIDE), layout="constrained")
    FigureCanvasAgg(figure)
    axes, *beside = figure.subplots(1, columns, squeeze=False)[0]
    pictures = [(ax.imshow(scene.frames[0]), scene.frames) for ax in beside if scene.frames is not None]
    for ax in beside:
        ax.set_axis_off()
    _surroundings(axes, scene)
    dot = scene.outlines.shape[-2] == 1
    moving = []
    for k, outline in enumerate(scene.outlines):
        axes.plot(*scene.planned[k].T, color=f"C{k % 10}", lw=1, alpha=0.35)
        (trail,) = axes.plot([], [], color=f"C{k % 10}", lw=1.5)
        (body,) = axes.plot([], [], color=f"C{k % 10}", lw=2.5, marker="o" if dot else "", ms=7)
        moving.append((trail, scene.executed[k], body, outline))

    def update(t: int) -> None:
        for trail, executed, body, outline in moving:
            trail.set_data(*executed[: t + 1].T)
            body.set_data(*outline[t].T)
        for picture, frames in pictures:
            picture.set_data(frames[t])
        axes.set_title(f"{t * scene.time_step:.2f} s")

    return figure, update


def _surroundings(axes: Axes, scene: Scene) -> None:
    from matplotlib.patches import Circle

    for x, y, r in scene.discs:
        axes.add_patch(Circle((x, y), r, fc="#e0604c", alpha=0.3, lw=0))
    if len(scene.waypoints):
        axes.plot(*scene.waypoints[:, :2].T, "o", color="#3566c8", ms=6)
    if scene.target is not None:
        axes.plot(*scene.target, "*", color="#d03a2b", ms=11, mew=0)
    middle, half = scene.window
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(scene.labels[1])


def _writer(path: Path, per_second: float) -> AbstractMovieWriter:
    from matplotlib.animation import FFMpegWriter, PillowWriter

    if path.suffix == ".gif":
        return PillowWriter(fps=round(per_second))
    if path.suffix != ".mp4":
        raise DataError(f"{path}: an animation is written as .gif or .mp4; found '{path.suffix}'")
    if not FFMpegWriter.isAvailable():
        raise DataError(f"{path}: .mp4 needs the program ffmpeg, which is not installed; name a file ending in .gif")
    return FFMpegWriter(fps=round(per_second))

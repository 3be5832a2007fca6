"""Frames of an animation: robots as they execute one plan each, a row a method, a column a time."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.figures import paths
from dadiff.reporting.figures.style import INK, legend_below, look_of, panels, tag
from dadiff.reporting.labels import method_name
from dadiff.reporting.selection import Selector

SIDE = 2.1


@dataclass(frozen=True)
class Film:
    """One method's robot: its plan (T+1, 2), its replay (T+1, 2), and its outlines (times, k, 2)."""

    label: str
    axes: dict[str, Any]
    planned: np.ndarray
    replayed: np.ndarray
    outlines: np.ndarray


@dataclass(frozen=True)
class Frames:
    """What the figure shows: films of one case, at times t (times,)."""

    scene: paths.Scene
    optimum: np.ndarray
    films: list[Film]
    times: np.ndarray
    channels: tuple[str, str]
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """All panels have one window."""
        figure, axes = panels(len(self.films) * len(self.times), len(self.times), width=SIDE, height=SIDE + 0.2)
        shared = [paths.Panel("", self.scene, self.optimum, [_path(film) for film in self.films], self.channels)]
        for index, ax in enumerate(axes):
            film, column = self.films[index // len(self.times)], index % len(self.times)
            self._frame(ax, film, column)
            paths.window(ax, shared)
            said = [*textwrap.wrap(film.label, 24), self.channels[1]]
            ax.set_ylabel("\n".join(said) if column == 0 else "")
            ax.tick_params(labelleft=column == 0)
        legend_below(figure, axes[:1])
        return figure

    def _frame(self, ax: Axes, film: Film, column: int) -> None:
        t, look = int(self.times[column]), look_of(film.axes)
        paths.draw_scene(ax, self.scene, self.optimum)
        tag(film.label, *ax.plot(*film.planned.T, color=look.colour, lw=0.8, alpha=0.5))
        tag(film.label, *ax.plot(*film.replayed[: t + 1].T, color=look.colour, lw=1.6))
        marker = "o" if film.outlines.shape[1] == 1 else ""
        tag(film.label, *ax.plot(*film.outlines[column].T, color=look.colour, lw=1.6, marker=marker))
        ax.set_title(f"t = {t}", color=INK)
        ax.set_xlabel(self.channels[0])


def collect(
    evidence: Evidence, *, cells: Selector, robot: int | None = None, case: int | None = None, count: int = 5
) -> Frames:
    """Of one case, from the same noise: the first seed, the first plan.

    Args:
        robot: of a fleet, which of the robots whose plans are stored.
        case: among the stored examples; None takes the most telling one, as `paths` does.
        count: number of times.
    """
    methods = evidence.methods(cells)
    used, shown = [m for m in methods if m.finished and paths.in_a_plane(m.finished[0].examples)], varying(methods)
    notes = [f"{method_name(m.axes, shown)}: {m.outcome}" for m in methods if m.lost]
    if not used:
        nothing = paths.Scene(*np.empty((3, 0, 3)))
        return Frames(nothing, np.empty((0, 2)), [], np.empty(0, dtype=int), ("", ""), [], notes)
    stored = used[0].finished[0].examples
    robot = 0 if robot is None and "robots" in stored else robot
    case = paths.most_telling(used[0], robot) if case is None else case
    scene, optimum = paths.scene_of(used[0], robot, case)
    times = np.linspace(0, len(optimum) - 1, count).round().astype(int)
    films = [_film(method, robot, case, times, method_name(method.axes, shown)) for method in used]
    return Frames(scene, optimum, films, times, paths.channels_of(stored), [m.finished[0].key for m in used], notes)


def _film(method: Method, robot: int | None, case: int, times: np.ndarray, label: str) -> Film:
    planned, replayed = (paths.of_case(method, name, robot, case)[0, :, :2] for name in ("states", "rollout_states"))
    outlines = paths.outlines_of(method, robot, case, times)
    return Film(label, method.axes, planned, replayed, replayed[times, None] if outlines is None else outlines)


def _path(film: Film) -> paths.Path:
    return paths.Path(film.label, film.axes, film.replayed, None, film.outlines)

"""Paths in the plane: a sample of the data with waypoints and discs, and plans of several methods beside the optimum.

Fig. 3 (a, b) of the paper; on the fleet a row a robot. The first two states are the position. Where runs stored the
outline of their robot, it is drawn at some times of the replay.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.figures.style import INK, legend_below, letter, look_of, panels, tag
from dadiff.reporting.labels import axis_value, method_name
from dadiff.reporting.selection import Selector
from dadiff.tasks.environments import present

PANEL_SIDE = 2.9
REPLAY = (0, (1, 1))


@dataclass(frozen=True)
class Scene:
    """What lies in the plane: positions (k, 2), discs (k, 3) as x, y, r."""

    waypoints: np.ndarray
    target: np.ndarray
    discs: np.ndarray


@dataclass(frozen=True)
class Path:
    """Positions (T+1, 2) of one plan, and of the replay of its inputs; outlines (times, k, 2) of the robot in it."""

    label: str
    axes: dict[str, Any]
    planned: np.ndarray
    replayed: np.ndarray | None
    outlines: np.ndarray | None = None


@dataclass(frozen=True)
class Panel:
    """One picture: the optimum (T+1, 2) and the plans drawn over it; `channels` names its axes."""

    title: str
    scene: Scene
    optimum: np.ndarray
    paths: list[Path]
    channels: tuple[str, str]


@dataclass(frozen=True)
class Paths:
    """What the figure shows."""

    panels: list[Panel]
    across: int
    runs: list[str]
    notes: list[str]

    def draw(self, columns: int) -> Figure:
        """Equal axes; panels of one row share their window."""
        across = self.across if columns > 1 else min(2, self.across)
        figure, axes = panels(len(self.panels), across, width=PANEL_SIDE, height=PANEL_SIDE + 0.15)
        for ax, panel in zip(axes, self.panels, strict=True):
            _draw_panel(ax, panel)
            window(ax, [p for p in self.panels if p.optimum is panel.optimum])
        if self.across <= 3:
            letter(axes)
        if any(path.replayed is not None for panel in self.panels for path in panel.paths):
            axes[0].plot([], [], color=INK, lw=1.5, label="plan")
            axes[0].plot([], [], color=INK, ls=REPLAY, lw=1.8, label="replay of its inputs")
        legend_below(figure, axes)
        return figure


def draw_scene(ax: Axes, scene: Scene, optimum: np.ndarray) -> None:
    """What lies in the plane, and the optimum (T+1, 2)."""
    for x, y, r in scene.discs:
        ax.add_patch(Circle((x, y), r, fc="#e0604c", alpha=0.3, lw=0))
    ax.plot(*optimum.T, color=INK, lw=1.2, ls=(0, (3, 2)), label="optimum", zorder=3)
    ax.plot(*optimum[0], "o", color=INK, ms=4.5, zorder=4, label="start")
    ax.plot(*scene.target.T, "*", color="#d03a2b", ms=9, mew=0, zorder=4, label="target")
    if len(scene.waypoints):
        ax.plot(*scene.waypoints.T, "o", color="#3566c8", ms=5, zorder=4, label="waypoint")


def _draw_panel(ax: Axes, panel: Panel) -> None:
    draw_scene(ax, panel.scene, panel.optimum)
    for rank, path in enumerate(panel.paths):
        look = look_of(path.axes)
        width = max(3.2 - 0.7 * rank, 1.0) if len(panel.paths) > 1 else 1.5
        label = path.label if path.replayed is None else ""
        (plan,) = ax.plot(*path.planned.T, color=look.colour, ls=look.line, lw=width, label=label)
        tag(path.label, plan)
        if path.replayed is not None:
            tag(path.label, *ax.plot(*path.replayed.T, color=look.colour, ls=REPLAY, lw=1.8))
        for outline in [] if path.outlines is None else path.outlines:
            tag(path.label, *ax.plot(*outline.T, color=look.colour, lw=1.1, alpha=0.7))
    ax.set_title("\n".join(textwrap.wrap(panel.title, 30)))
    ax.set_xlabel(panel.channels[0])
    ax.set_ylabel(panel.channels[1])


def window(ax: Axes, shared: list[Panel]) -> None:
    """Equal axes around all paths of the row, ignoring how far a poor plan strays."""
    shown = [p for panel in shared for p in panel.paths]
    bodies = [p.outlines.reshape(-1, 2) for p in shown if p.outlines is not None]
    points = np.concatenate([shared[0].optimum, shared[0].scene.target, *(p.planned for p in shown), *bodies])
    optimum = np.concatenate([shared[0].optimum, shared[0].scene.target])
    reach = 1.6 * max(np.ptp(optimum, axis=0).max(), 1.0)
    centre = (optimum.max(0) + optimum.min(0)) / 2
    x, y, r = shared[0].scene.discs.T
    rims = [np.column_stack([x + dx * r, y + dy * r]) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    points = np.concatenate([points, *rims])
    points = points[(np.abs(points - centre) < reach).all(axis=1)]
    middle, half = (points.max(0) + points.min(0)) / 2, 0.55 * max(np.ptp(points, axis=0).max(), 0.5)
    ax.set_xlim(middle[0] - half, middle[0] + half)
    ax.set_ylim(middle[1] - half, middle[1] + half)
    ax.set_aspect("equal")


def collect(
    evidence: Evidence,
    *,
    cells: Selector,
    case: int | None = None,
    robots: list[int] | None = None,
    sample_of_data: bool = False,
    by: str | None = None,
    apart: bool = False,
    outlines: int = 0,
) -> Paths:
    """Plans of one case from the same noise: the first seed, the first plan.

    Args:
        case: among the stored examples; None takes the one whose optimum passes a disc most closely, or the first.
        robots: of a fleet, a row each.
        sample_of_data: a first panel with the optimum alone.
        by: an axis with a panel of its own for each value.
        apart: a panel a method, with the replay of its inputs, instead of one panel for all.
        outlines: at how many times the robot itself is drawn, where runs stored what it looks like.
    """
    methods = evidence.methods(cells)
    used = [m for m in methods if m.finished and in_a_plane(m.finished[0].examples)]
    values = list(dict.fromkeys(m.axes.get(by) for m in used)) if by else [None]
    channels = channels_of(used[0].finished[0].examples) if used else ("", "")
    shown, drawn = [name for name in varying(methods) if name != by], []
    rows: list[int] | list[None] = robots or [None]
    for robot in rows if used else []:
        case = most_telling(used[0], robot) if case is None else case
        scene, optimum = scene_of(used[0], robot, case)
        paths = [_path(method, robot, case, shown, replay=apart, outlines=outlines) for method in used]
        title = "plans" if robot is None else f"robot {used[0].finished[0].examples['robots'][robot]}"
        if sample_of_data:
            drawn.append(Panel("a sample of the data", scene, optimum, [], channels))
        if apart:
            titles = [f"{title}: {p.label}" if robot is not None else p.label for p in paths]
            drawn += [Panel(t, scene, optimum, [p], channels) for t, p in zip(titles, paths, strict=True)]
        else:
            for value in values:
                here = [path for path in paths if by is None or path.axes.get(by) == value]
                condition = f", {axis_value(by, value)}" if by and len(values) > 1 else ""
                drawn.append(Panel(title + condition, scene, optimum, _told_apart(here), channels))
    across = min(len(used), 6 if robots else 4) if apart else min(max(len(values) + sample_of_data, 2), 3)
    notes = [f"{method_name(m.axes, varying(methods))}: {m.outcome}" for m in methods if m.lost]
    return Paths(drawn, across, [m.finished[0].key for m in used], notes)


def in_a_plane(stored: Mapping[str, np.ndarray]) -> bool:
    return "environment_target" in stored and stored["states"].shape[-1] >= 2


def most_telling(method: Method, robot: int | None) -> int:
    """The stored case whose optimum comes closest to a disc; the first where there are none."""
    stored = method.finished[0].examples["reference_states"]
    scenes = [scene_of(method, robot, case) for case in range(len(stored if robot is None else stored[robot]))]
    return int(np.argmin([_clearance(scene.discs, optimum) for scene, optimum in scenes]))


def _clearance(discs: np.ndarray, path: np.ndarray) -> float:
    """The least distance of a path (T+1, 2) from the rims of discs (k, 3); inf without discs."""
    apart = np.linalg.norm(path[:, None] - discs[:, :2], axis=-1) - discs[:, 2]
    return float(apart.min(initial=np.inf))


def of_case(method: Method, name: str, robot: int | None, case: int) -> np.ndarray:
    """An example array of one case; robots lead where there are any."""
    stored = method.finished[0].examples[name]
    return stored[case] if robot is None else stored[robot, case]


def _path(method: Method, robot: int | None, case: int, shown: list[str], *, replay: bool, outlines: int) -> Path:
    planned, replayed = (of_case(method, name, robot, case)[0, :, :2] for name in ("states", "rollout_states"))
    times = np.linspace(0, len(planned) - 1, outlines).round().astype(int)
    bodies = outlines_of(method, robot, case, times) if outlines else None
    return Path(method_name(method.axes, shown), method.axes, planned, replayed if replay else None, bodies)


def outlines_of(method: Method, robot: int | None, case: int, times: np.ndarray) -> np.ndarray | None:
    """The robot's outline at times of the replay, (times, k, 2); None where none was stored."""
    if "outlines" not in method.finished[0].examples:
        return None
    return of_case(method, "outlines", robot, case)[0][times]


def channels_of(stored: Mapping[str, np.ndarray]) -> tuple[str, str]:
    """What the first two states are called, with their units."""
    names = stored["state_names"][:2].tolist() if "state_names" in stored else ["x position", "y position"]
    units = stored["state_units"][:2].tolist() if "state_units" in stored else ["", ""]
    first, second = (f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True))
    return first, second


def _told_apart(paths: list[Path]) -> list[Path]:
    """Plans that no eye can tell apart as one, named after all of them."""
    distinct: list[Path] = []
    for path in paths:
        extent = np.ptp(path.planned, axis=0).max()
        for index, other in enumerate(distinct):
            if np.abs(path.planned - other.planned).max() < 1e-3 * extent:
                distinct[index] = replace(other, label=f"{other.label} = {path.label}")
                break
        else:
            distinct.append(path)
    return distinct


def scene_of(method: Method, robot: int | None, case: int) -> tuple[Scene, np.ndarray]:
    optimum = of_case(method, "reference_states", robot, case)
    waypoints, discs = (_slots(method, f"environment_{name}", robot, case) for name in ("waypoints", "obstacles"))
    target = of_case(method, "environment_target", robot, case)
    return Scene(waypoints[:, :2], target[None, :2], discs), optimum[:, :2]


def _slots(method: Method, name: str, robot: int | None, case: int) -> np.ndarray:
    """The filled slots of a channel of E, (k, 3); none where E has no such channel."""
    stored = name in method.finished[0].examples
    return present(of_case(method, name, robot, case)) if stored else np.empty((0, 3))

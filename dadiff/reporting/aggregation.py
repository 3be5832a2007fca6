"""From cells to methods: which cells are replicates of one another, and what each is compared to.

A method is what a reader compares: all axes but those of replication, which are seeds. Its finished runs stand in a
grid by what was drawn anew between them (training seed, recording, ...), and their results have the axes of the grid,
then robots and cases; plans of one case are averaged. Runs that are missing, failed or diverged are named beside the
method and never enter a mean.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from pandas.api.types import is_numeric_dtype

from dadiff.errors import StoreError
from dadiff.reporting.selection import Selector, matches
from dadiff.reporting.sources import ReportedRun, Sweep
from dadiff.reporting.statistics import Draws

PRESETS = ("_fixed", "_unchecked")  # what they set is an axis of its own
ALIASES = ("projector.initial_state",)  # stored as `initial_state`, too
FIRST = (
    *("task", "projector", "projector.features", "enforcement", "enforcement.spread", "initial_state"),
    *("recording.length", "system.process_noise", "denoiser", "training", "training.projects"),
)
LEVELS = ("robot", "case", "sample", "t")

DRAWN = {"seed": "seed", "training.seed": "training seed", "recording.seed": "recording", "dataset.seed": "data set",
         "evaluation.seed": "noise of sampling", "task.seed": "draw of the robots"}  # fmt: skip
"""What a seed draws anew."""


@dataclass(frozen=True)
class Runs:
    """Finished runs by what was drawn anew between them, each draw with each other.

    Args:
        levels: names of the grid's axes.
        cells: the runs, (*levels).
    """

    levels: tuple[str, ...]
    cells: np.ndarray

    @property
    def keys(self) -> list[str]:
        """Keys of the runs, each once."""
        return list(dict.fromkeys(cell.key for cell in self.cells.ravel()))

    @property
    def nested(self) -> bool:
        """Whether the runs have cases of their own."""
        return len({cell.link("cases") for cell in self.cells.ravel()}) > 1

    def curves(self, metric: str, group: str | None = None) -> Draws:
        """A metric's means over the plans of each case: (*levels, [robots,] cases[, T+1]).

        Args:
            group: of a fleet, the robots of this group alone.

        Raises:
            StoreError: if a run has no such metric, rows are missing, or runs differ in size.
        """
        found = [_of_cell(cell, metric, group) for cell in self.cells.ravel()]
        shapes = sorted({array.shape for array in found})
        if len(shapes) > 1:
            raise StoreError(f"metric {metric}: replicates have shapes {shapes}; expected one; rerun with equal sizes")
        units = shapes[0][:-1] if _along_time(self.cells.ravel()[0], metric) else shapes[0]
        names = ("robot", "case")[2 - len(units) :]
        return Draws(np.stack(found).reshape(*self.cells.shape, *shapes[0]), self.levels + names, self.nested)

    def scalars(self, metric: str, group: str | None = None) -> Draws:
        """As `curves`, with metrics along time averaged over the times at which they are defined."""
        draws = self.curves(metric, group)
        if not _along_time(self.cells.ravel()[0], metric):
            return draws
        defined = ~np.isnan(draws.values).all(axis=tuple(range(len(draws.levels))))
        return Draws(draws.values[..., defined].mean(axis=-1), draws.levels, draws.nested)


@dataclass(frozen=True)
class Method:
    """Cells that differ in replication only.

    Args:
        axes: what the cells share, without what does not apply.
        cells: the replicates, in the sweep's order, each configuration once.
    """

    axes: dict[str, Any]
    cells: list[ReportedRun] = field(repr=False)

    @property
    def finished(self) -> list[ReportedRun]:
        """Replicates with results."""
        return [cell for cell in self.cells if cell.status == "finished"]

    @property
    def lost(self) -> list[ReportedRun]:
        """Replicates without results."""
        return [cell for cell in self.cells if cell.status != "finished"]

    @property
    def diverged(self) -> bool:
        """Whether a replicate diverged: a result of the method, not a gap."""
        return any(cell.status == "diverged" for cell in self.cells)

    @cached_property
    def runs(self) -> Runs:
        """The finished runs that numbers come from."""
        levels, places = grid([seeds_of(cell) for cell in self.finished])
        return Runs(levels, _objects(self.finished)[places])

    @property
    def identity(self) -> bool:
        """Whether its projector leaves everything as it is, so that it is another method's twin."""
        return any(cell.identity for cell in self.finished)

    @property
    def keys(self) -> list[str]:
        """Keys of the runs that numbers come from."""
        return self.runs.keys if self.finished else []

    @property
    def outcome(self) -> str:
        """What happened to the replicates without results, in words; empty if there are none."""
        return "; ".join(dict.fromkeys(cell.outcome for cell in self.lost))

    def counts(self) -> dict[str, int]:
        """Numbers of seeds, recordings, robots, cases and samples behind the method's numbers."""
        seeds = {cell.axes.get("seed") for cell in self.finished}
        recordings = {cell.link("recording") for cell in self.finished} - {None}
        trained = any(cell.link("denoiser") for cell in self.finished)
        stored = self.finished[0].counts if self.finished else {}
        counts = {"training seeds" if trained else "seeds": len(seeds), "recordings": len(recordings), **stored}
        return {name: int(count) for name, count in counts.items() if count}


@dataclass(frozen=True)
class Evidence:
    """What a report may draw on: one sweep, as methods."""

    sweep: Sweep

    @cached_property
    def all_methods(self) -> list[Method]:
        """Every method of the sweep, in its order."""
        groups, seen = dict[str, Method](), set[tuple[str, str]]()
        for cell in self.sweep.cells:
            axes = shared_axes(cell)
            method = groups.setdefault(name := repr(sorted(axes.items())), Method(axes, []))
            if (name, cell.key) not in seen:
                method.cells.append(cell)
            seen.add((name, cell.key))
        return list(groups.values())

    def methods(self, cells: Selector) -> list[Method]:
        """Methods that a selector asks for, whatever became of them."""
        return [method for method in self.all_methods if matches(method.axes, cells)]

    def of(self, cells: Selector) -> Evidence:
        """What some cells say; all if none are selected."""
        chosen = [cell for cell in self.sweep.cells if matches(cell.axes, cells)]
        return Evidence(replace(self.sweep, cells=chosen)) if cells else self

    def partner(self, method: Method, against: Selector) -> Method | None:
        """What a method is compared to: the method that `against` asks for, alike in all else that applies.

        None if there is none, or if no two of their finished runs are of the same draw.
        """
        found = [other for other in self.methods(against) if _alike(method, other, against) and pairs(method, other)]
        return found[0] if found else None


def shared_axes(cell: ReportedRun) -> dict[str, Any]:
    """What a cell has in common with its replicates; presets such as `known_fixed` go by the projector they set."""
    axes = {k: v for k, v in cell.axes.items() if v is not None and not is_seed(k) and k not in ALIASES}
    for preset in PRESETS:
        axes["projector"] = str(axes.get("projector")).removesuffix(preset)
    return axes


def is_seed(axis: str) -> bool:
    """Whether an axis is one of replication."""
    return axis == "seed" or axis.endswith(".seed")


def _alike(method: Method, other: Method, against: Selector) -> bool:
    shared = [name for name in method.axes if name in other.axes and name.split(".")[0] not in against]
    return all(method.axes[name] == other.axes[name] for name in shared if name not in against)


def pair(method: Method, other: Method) -> tuple[Runs, Runs]:
    """Runs that both have: of the same seed, and of the same recording where both use one.

    Raises:
        StoreError: if two paired runs were not made on the same cases.
    """
    found = pairs(method, other)
    for a, b in found:
        if a.link("cases") != b.link("cases"):
            raise StoreError(f"runs {a.key} and {b.key}: their data sets differ, so their cases cannot be paired")
    levels, places = grid([{**seeds_of(b), **seeds_of(a)} for a, b in found])
    own, theirs = ([two[side] for two in found] for side in (0, 1))
    return _narrowed(Runs(levels, _objects(own)[places])), _narrowed(Runs(levels, _objects(theirs)[places]))


def _narrowed(runs: Runs) -> Runs:
    """Without the levels over which the same run is repeated; one level stays."""
    levels, cells = runs.levels, runs.cells
    for axis in reversed(range(cells.ndim)):
        keys = np.array([cell.key for cell in cells.ravel()]).reshape(cells.shape)
        if cells.ndim > 1 and (keys == keys.take([0], axis=axis)).all():
            levels, cells = levels[:axis] + levels[axis + 1 :], cells.take(0, axis=axis)
    return Runs(levels, cells)


def _objects(cells: list[ReportedRun]) -> np.ndarray:
    found = np.empty(len(cells), dtype=object)
    found[:] = cells
    return found


def pairs(method: Method, other: Method) -> list[tuple[ReportedRun, ReportedRun]]:
    """Finished runs of both that are of the same draw: alike in every seed that applies to both."""
    own, theirs = _by_seeds(method.finished), _by_seeds(other.finished)
    return [
        two
        for names, cells in own.items()
        for applying, others in theirs.items()
        for two in _joined(cells, others, [name for name in names if name in applying])
    ]


def _by_seeds(cells: list[ReportedRun]) -> dict[tuple[str, ...], list[ReportedRun]]:
    """Cells by the names of the seeds that apply to them."""
    found: dict[tuple[str, ...], list[ReportedRun]] = {}
    for cell in cells:
        found.setdefault(tuple(seeds_of(cell)), []).append(cell)
    return found


def _joined(
    cells: list[ReportedRun], others: list[ReportedRun], names: list[str]
) -> Iterator[tuple[ReportedRun, ReportedRun]]:
    """Each cell with the others that are alike in some axes."""
    alike = defaultdict[tuple[Any, ...], list[ReportedRun]](list)
    for other in others:
        alike[tuple(other.axes[name] for name in names)].append(other)
    return ((cell, other) for cell in cells for other in alike[tuple(cell.axes[name] for name in names)])


def seeds_of(cell: ReportedRun) -> dict[str, Any]:
    """The axes of replication that apply to a cell."""
    return {name: value for name, value in cell.axes.items() if is_seed(name) and value is not None}


def grid(seeds: list[dict[str, Any]]) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of what varies between runs, and the places of runs that make a full grid over it.

    Seeds that follow one another are one level, named after the first. Of a grid with gaps the seed or recording with
    the most of them is left out until there are none; where that costs more than half of the runs they are one level.
    """
    axes = _drawn_anew(seeds)
    kept = list(range(len(seeds)))
    while len(kept) < _full(seeds, kept, axes):
        counts = [(sum(seeds[k].get(a) == v for k in kept) * len(_values(seeds, a, kept)), a, v)
                  for a in axes for v in _values(seeds, a, kept)]  # fmt: skip
        _, axis, value = min(counts, key=lambda found: found[0])
        kept = [k for k in kept if seeds[k].get(axis) != value]
    if 2 * len(kept) < len(seeds) or len(kept) > _full(seeds, kept, axes):
        return ("run",), np.arange(len(seeds))
    kept.sort(key=lambda k: [repr(seeds[k].get(axis)).zfill(24) for axis in axes])
    levels = tuple(DRAWN.get(axis, axis.removesuffix(".seed")) for axis in axes) or ("seed",)
    return levels, np.array(kept).reshape([len(_values(seeds, axis, kept)) for axis in axes] or [1])


def _drawn_anew(seeds: list[dict[str, Any]]) -> list[str]:
    """The axes that vary, of those that tell the same runs apart the first."""
    axes: dict[tuple[int, ...], str] = {}
    for axis in dict.fromkeys(name for found in seeds for name in found):
        values = _values(seeds, axis)
        axes.setdefault(tuple(values.index(found.get(axis)) for found in seeds), axis)
    return [axis for places, axis in axes.items() if any(places)]


def _values(seeds: list[dict[str, Any]], axis: str, kept: list[int] | None = None) -> list[Any]:
    return list(dict.fromkeys(seeds[k].get(axis) for k in (range(len(seeds)) if kept is None else kept)))


def _full(seeds: list[dict[str, Any]], kept: list[int], axes: list[str]) -> int:
    """Number of entries of the grid that some runs span."""
    return math.prod(len(_values(seeds, axis, kept)) for axis in axes)


def _along_time(cell: ReportedRun, metric: str) -> bool:
    return _table_with(cell, metric) == "per_step"


def _table_with(cell: ReportedRun, metric: str) -> str | None:
    """The table of a run that holds a metric per plan or per step."""
    for name in ("per_step", "per_plan"):
        if cell.has_column(name, metric):
            return name
    return None


EPISODES = re.compile(r"closed_loop_(?P<same>same_)?(?P<controller>[a-z]+)_(?P<every>\d+)")
"""Metrics of episodes in closed loop: the cost over that of the expert, at the shortest or the same interval."""


def _episodes(cell: ReportedRun, wanted: re.Match[str]) -> np.ndarray:
    """([robots,] cases)."""
    table = cell.table("closed_loop")
    rows = table[(table["controller"] == wanted["controller"]) & (table["every"] == int(wanted["every"]))]
    return dense(rows, "cost_ratio_same" if wanted["same"] else "cost_ratio", where=f"run {cell.key}, closed_loop")


def _of_cell(cell: ReportedRun, metric: str, group: str | None) -> np.ndarray:
    if name := _table_with(cell, metric):
        if (name, metric) not in cell.means:
            cell.means.update(_means(cell, name))
        means = cell.means[name, metric]
        return means if group is None else means[_robots_in(cell, group)]
    if metric not in cell.metrics:
        raise StoreError(f"run {cell.key} ({cell.name}): has no metric {metric!r}; found {', '.join(cell.metrics)}")
    if (wanted := EPISODES.fullmatch(metric)) and cell.has("closed_loop"):
        values = _episodes(cell, wanted)
        return values if group is None else values[_robots_in(cell, group)]
    return np.asarray(cell.metrics[metric], dtype=np.float64)


def _means(cell: ReportedRun, name: str) -> dict[tuple[str, str], np.ndarray]:
    """Of every metric of a table, which is read once for all of them, means over the plans of each case."""
    table = cell.table(name)
    metrics = [column for column in table.columns if column not in LEVELS and is_numeric_dtype(table[column])]
    values = dense(table, metrics, where=f"run {cell.key}, {name}").mean(axis=-3 if name == "per_step" else -2)
    return {(name, metric): values[..., k] for k, metric in enumerate(metrics)}


def _robots_in(cell: ReportedRun, group: str) -> np.ndarray:
    if not cell.has("robots"):
        raise StoreError(f"run {cell.key}: has no table of its robots, so none is of group {group}; run it again")
    return (cell.table("robots")["group"] == group).to_numpy()


def has_metric(cells: list[ReportedRun], metric: str) -> bool:
    """Whether each of these runs has a metric."""
    return all(metric in cell.metrics or _table_with(cell, metric) for cell in cells)


def dense(table: pd.DataFrame, columns: str | list[str], *, where: str) -> np.ndarray:
    """Columns of a long table as an array over its index columns: ([robot,] case, sample[, t][, column]).

    Raises:
        StoreError: if a combination of indices is missing or comes twice.
    """
    index = [name for name in LEVELS if name in table.columns]
    codes = [pd.factorize(table[name], sort=True) for name in index]
    shape = tuple(len(found) for _, found in codes)
    place = np.ravel_multi_index([code for code, _ in codes], shape)
    if len(table) != np.prod(shape) or (np.bincount(place) != 1).any():
        raise StoreError(
            f"{where}: has {len(table)} rows for {dict(zip(index, shape, strict=True))}; expected each once"
        )
    found = table[columns].to_numpy(dtype=np.float64)
    values = np.empty_like(found)
    values[place] = found
    return values.reshape(*shape, *found.shape[1:])


def varying(methods: list[Method]) -> list[str]:
    """The fewest axes that tell methods apart, taken in the order of `FIRST`, then choices before parameters."""
    chosen: list[str] = []
    for name in in_order(name for method in methods for name in method.axes):
        if _distinct(methods, [*chosen, name]) > _distinct(methods, chosen):
            chosen.append(name)
    return chosen


def in_order(names: Iterable[str]) -> list[str]:
    """Axes in the order of `FIRST`, then choices before parameters."""
    rank = {name: index for index, name in enumerate(FIRST)}
    return sorted(dict.fromkeys(names), key=lambda name: (rank.get(name, len(FIRST)), "." in name))


def _distinct(methods: list[Method], axes: list[str]) -> int:
    return len({repr([method.axes.get(name) for name in axes]) for method in methods})

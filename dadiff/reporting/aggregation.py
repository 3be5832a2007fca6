"""From cells to methods: which cells are replicates of one another, and what each is compared to.

A method is what a reader compares: all axes but those of replication (seeds). Its values have the axes
(replicates, [robots,] cases[, t]); plans of one case are averaged. Replicates that are missing, failed or
diverged are named beside the method and never enter a mean; a method is `complete` only without any.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import pandas as pd

from dadiff.errors import StoreError
from dadiff.randomness import numpy_generator
from dadiff.reporting.selection import Selector, matches
from dadiff.reporting.sources import Cell, Sweep
from dadiff.reporting.statistics import bootstrap_weights

RESAMPLES = 1000
PRESETS = ("_fixed", "_unchecked")  # what they set is an axis of its own
ALIASES = ("projector.initial_state",)  # stored as `initial_state`, too
FIRST = ("task", "projector", "enforcement", "initial_state", "recording.length", "system.process_noise", "denoiser")
LEVELS = ("robot", "case", "sample", "t")


@lru_cache(maxsize=4)
def weights_for(levels: tuple[int, ...]) -> np.ndarray:
    """The resamples of arrays with these levels: the same for every method, so that comparisons are paired."""
    return bootstrap_weights(levels, RESAMPLES, numpy_generator(0, "report"))


@dataclass(frozen=True)
class Method:
    """Cells that differ in replication only.

    Args:
        axes: what the cells share, without what does not apply.
        cells: the replicates, in the sweep's order, each configuration once.
    """

    axes: dict[str, Any]
    cells: list[Cell] = field(repr=False)

    @property
    def finished(self) -> list[Cell]:
        """Replicates with results."""
        return [cell for cell in self.cells if cell.status == "finished"]

    @property
    def lost(self) -> list[Cell]:
        """Replicates without results."""
        return [cell for cell in self.cells if cell.status != "finished"]

    @property
    def diverged(self) -> bool:
        """Whether a replicate diverged: a result of the method, not a gap."""
        return any(cell.status == "diverged" for cell in self.cells)

    @property
    def keys(self) -> list[str]:
        """Keys of the runs that numbers come from."""
        return [cell.key for cell in self.finished]

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
        groups: dict[str, Method] = {}
        for cell in self.sweep.cells:
            axes = shared_axes(cell)
            method = groups.setdefault(repr(sorted(axes.items())), Method(axes, []))
            if cell.key not in [other.key for other in method.cells]:
                method.cells.append(cell)
        return list(groups.values())

    def methods(self, cells: Selector) -> list[Method]:
        """Methods that a selector asks for, whatever became of them."""
        return [method for method in self.all_methods if matches(method.axes, cells)]

    def partner(self, method: Method, against: Selector) -> Method | None:
        """What a method is compared to: the method that `against` asks for, alike in all else that applies.

        None if there is none, or if no two of their finished runs are of the same draw.
        """
        found = [other for other in self.methods(against) if _alike(method, other, against) and _pairs(method, other)]
        return found[0] if found else None


def shared_axes(cell: Cell) -> dict[str, Any]:
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


def pair(method: Method, other: Method) -> tuple[list[Cell], list[Cell]]:
    """Replicates that both have, in the same order: same seed, and same recording where both use one.

    Raises:
        StoreError: if two paired runs were not made on the same cases.
    """
    pairs = _pairs(method, other)
    for a, b in pairs:
        if a.link("cases") != b.link("cases"):
            raise StoreError(f"runs {a.key} and {b.key}: their data sets differ, so their cases cannot be paired")
    return [a for a, _ in pairs], [b for _, b in pairs]


def _pairs(method: Method, other: Method) -> list[tuple[Cell, Cell]]:
    return [(a, b) for a in method.finished for b in other.finished if _same_draw(a, b)]


def _same_draw(a: Cell, b: Cell) -> bool:
    shared = [name for name in a.axes if is_seed(name) and b.axes.get(name) is not None]
    return all(a.axes[name] in (b.axes[name], None) for name in shared)


def case_means(cells: list[Cell], metric: str, group: str | None = None) -> np.ndarray:
    """Means over the plans of each case: (replicates, [robots,] cases[, T+1]).

    Metrics with one value a run come as (replicates,).

    Args:
        group: of a fleet, the robots of this group alone.

    Raises:
        StoreError: if a run has no such metric, rows are missing, or replicates differ in size.
    """
    arrays = [_of_cell(cell, metric, group) for cell in cells]
    shapes = sorted({array.shape for array in arrays})
    if len(shapes) > 1:
        raise StoreError(f"metric {metric}: replicates have shapes {shapes}; expected one; rerun with equal sizes")
    return np.stack(arrays)


def case_scalars(cells: list[Cell], metric: str, group: str | None = None) -> np.ndarray:
    """As `case_means`, with metrics along time averaged over t: (replicates, [robots,] cases)."""
    values = case_means(cells, metric, group)
    if all(_table_with(cell, metric) == "per_step" for cell in cells):
        defined = ~np.isnan(values).all(axis=tuple(range(values.ndim - 1)))
        return values[..., defined].mean(axis=-1)
    return values


def _table_with(cell: Cell, metric: str) -> str | None:
    """The table of a run that holds a metric per plan or per step."""
    for name in ("per_step", "per_plan"):
        if cell.has_column(name, metric):
            return name
    return None


def _of_cell(cell: Cell, metric: str, group: str | None) -> np.ndarray:
    if name := _table_with(cell, metric):
        if (name, metric) not in cell.means:
            values = dense(cell.table(name), metric, where=f"run {cell.key}, {name}")
            cell.means[name, metric] = values.mean(axis=-2 if name == "per_step" else -1)
        means = cell.means[name, metric]
        return means if group is None else means[_robots_in(cell, group)]
    if metric not in cell.metrics:
        raise StoreError(f"run {cell.key} ({cell.name}): has no metric {metric!r}; found {', '.join(cell.metrics)}")
    return np.asarray(cell.metrics[metric], dtype=np.float64)


def _robots_in(cell: Cell, group: str) -> np.ndarray:
    if not cell.has("robots"):
        raise StoreError(f"run {cell.key}: has no table of its robots, so none is of group {group}; run it again")
    return (cell.table("robots")["group"] == group).to_numpy()


def has_metric(cells: list[Cell], metric: str) -> bool:
    """Whether each of these runs has a metric."""
    return all(metric in cell.metrics or _table_with(cell, metric) for cell in cells)


def dense(table: pd.DataFrame, column: str, *, where: str) -> np.ndarray:
    """A column of a long table as an array over its index columns: ([robot,] case, sample[, t]).

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
    values = np.empty(len(table))
    values[place] = table[column]
    return values.reshape(shape)


def varying(methods: list[Method]) -> list[str]:
    """The fewest axes that tell methods apart, taken in the order of `FIRST`, then choices before parameters."""
    names = dict.fromkeys(name for method in methods for name in method.axes)
    rank = {name: index for index, name in enumerate(FIRST)}
    ordered = sorted(names, key=lambda name: (rank.get(name, len(FIRST)), "." in name))
    chosen: list[str] = []
    for name in ordered:
        if _distinct(methods, [*chosen, name]) > _distinct(methods, chosen):
            chosen.append(name)
    return chosen


def _distinct(methods: list[Method], axes: list[str]) -> int:
    return len({repr([method.axes.get(name) for name in axes]) for method in methods})

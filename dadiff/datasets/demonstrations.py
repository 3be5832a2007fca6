"""Own demonstrations and test cases: files of the kinds that recordings have, as trajectories of T inputs.

A run of more than T inputs is cut into windows of T, one of fewer is left out. E = [x_init; target] is where a window
begins and where it should go: as the file says, else the state in which the window ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dadiff.datasets.generated import Part
from dadiff.datasets.logs import Run, arrays_of, content_of, list_logs, log, runs_of, saying
from dadiff.datasets.physics import judge, plant_of, tell_shifted
from dadiff.datasets.tables import START, TARGET, Arrays, Columns, arrays_of_table
from dadiff.errors import ConfigError, DataError
from dadiff.memory import check_fits
from dadiff.systems import System
from dadiff.tasks import Cases, Demonstrations, Task
from dadiff.trajectory import Layout

if TYPE_CHECKING:
    import pandas as pd

MOST_LEFT_OUT = 0.5
"""Of the runs, those that may be too short: more are a horizon that was not meant."""


@dataclass(frozen=True)
class Shown:
    """A run that somebody shows, and where it should go.

    Args:
        name: what it is from.
        states, inputs: (S+1, n) and (S, m).
        targets: (S+1, n), what is aimed at in each state; None where nobody says.
    """

    name: str
    states: np.ndarray
    inputs: np.ndarray
    targets: np.ndarray | None

    @classmethod
    def all_in(cls, arrays: Arrays, where: str, system: System) -> list[Shown]:
        """The runs in arrays that are called as in a file.

        Raises:
            DataError: if they cannot be read, or one says that it begins where it does not.
        """
        beside = [name for name in (TARGET, START) if name in arrays]
        runs = runs_of(arrays, where, system, beside)
        names = [f"{where}, run {k}" if len(runs) > 1 else where for k in range(len(runs))]
        return [cls._of(name, run, beside) for name, run in zip(names, runs, strict=True)]

    @classmethod
    def _of(cls, name: str, run: Run, beside: Sequence[str]) -> Shown:
        parts = dict(zip(("states", *beside), np.split(run[0], 1 + len(beside), axis=-1), strict=True))
        first, said = parts["states"][0], parts.get(START, parts["states"])[0]
        if not np.allclose(said, first, rtol=1e-4, atol=1e-6):
            raise DataError(f"{name}: {START} is {said.tolist()}, but states begin at {first.tolist()}")
        return cls(name, parts["states"], run[1], parts.get(TARGET))

    def windows(self, T: int, stride: int) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
        """Where windows begin, their states (N, T+1, n), inputs (N, T, m) and targets (N, n), where one holds."""
        x, u = (_windows(values, length)[::stride] for values, length in ((self.states, T + 1), (self.inputs, T)))
        if self.targets is None:
            return list(range(0, stride * len(x), stride)), x, u, x[:, -1]
        aimed = _windows(self.targets, T + 1)[::stride]
        kept = (aimed == aimed[:, :1]).all(axis=(1, 2))
        return (stride * np.flatnonzero(kept)).tolist(), x[kept], u[kept], aimed[kept, 0]


def _windows(values: np.ndarray, length: int) -> np.ndarray:
    """All windows (N, length, k) of values (S, k), without a copy."""
    return np.lib.stride_tricks.sliding_window_view(values, length, axis=0).swapaxes(1, 2)


@dataclass(frozen=True)
class Windows:
    """Windows of runs, with a name for each, and the runs."""

    names: list[str]
    states: np.ndarray
    inputs: np.ndarray
    targets: np.ndarray
    runs: list[Run]

    @classmethod
    def of(cls, runs: Sequence[Shown], T: int, stride: int, where: str) -> Windows:
        """All windows of T inputs, every `stride` steps; says what is cut, left out, and taken for a target.

        Raises:
            DataError: if most runs are shorter than T, or only some have a target.
            ConfigError: if they do not fit into memory.
        """
        long = _long_enough(runs, T, where)
        _tell_targets(long, where)
        count = sum((len(run.inputs) - T) // stride + 1 for run in long)
        each = (T + 1) * long[0].states.shape[-1] + T * long[0].inputs.shape[-1]
        check_fits(16.0 * count * each, f"{where}: {count} windows of {T} inputs; a larger dataset.stride takes fewer")
        cut = [run.windows(T, stride) for run in long]
        starts = [(run, k) for run, found in zip(long, cut, strict=True) for k in found[0]]
        names = [Path(run.name).name + (f" from row {k}" if len(run.inputs) > T else "") for run, k in starts]
        _tell_windows(long, T, count, len(names), where)
        x, u, target = (np.concatenate([found[part] for found in cut]) for part in (1, 2, 3))
        return cls(names, x, u, target, [(run.states, run.inputs) for run in long])

    def trajectories(self, system: System) -> np.ndarray:
        """tau (N, d)."""
        return system.layout(self.inputs.shape[1]).flatten(self.states, self.inputs)

    def environment(self, condition: Layout) -> np.ndarray:
        """E (N, 2n)."""
        return condition.pack(x_init=self.states[:, 0], target=self.targets)


def _long_enough(runs: Sequence[Shown], T: int, where: str) -> list[Shown]:
    """Those of at least T inputs."""
    short = [run for run in runs if len(run.inputs) < T]
    if short:
        least = min(short, key=lambda run: len(run.inputs))
        told = (
            f"{where}: {len(short)} of {len(runs)} demonstrations have fewer than the {T} inputs of the task, "
            f"{least.name} has {len(least.inputs)}"
        )
        if len(short) > MOST_LEFT_OUT * len(runs):
            raise DataError(f"{told}: set task.horizon={len(least.inputs)}, which all have, or take the short ones out")
        log.warning("%s; they are left out", told)
    return [run for run in runs if len(run.inputs) >= T]


def _tell_targets(runs: Sequence[Shown], where: str) -> None:
    without = [run.name for run in runs if run.targets is None]
    if len(without) == len(runs):
        log.warning(
            "%s: no target is given (array %s, or columns.target of a table): the target of each trajectory is taken "
            "to be the state in which it ends",
            where,
            TARGET,
        )
    elif without:
        raise DataError(f"{without[0]}: has no array {TARGET}, where others have one; add it, or leave it out of all")


def _tell_windows(runs: Sequence[Shown], T: int, count: int, taken: int, where: str) -> None:
    if not taken:
        raise DataError(f"{where}: {TARGET} changes within every window of {T} inputs; set a smaller task.horizon")
    if taken < count:
        log.warning("%s: %s changes within %d of %d windows, which are left out", where, TARGET, count - taken, count)
    if count > len(runs):
        log.warning("%s: %d runs are cut into %d trajectories of %d inputs", where, len(runs), count, T)


@dataclass(frozen=True)
class NpzTrajectories:
    """Demonstrations and test cases from files in `path`/train and `path`/test.

    See `dadiff.datasets.logs` for the files that are taken; besides, they may say `target_state` (n,), of the file, of
    each run or of each state. The reference of a test case is its stored trajectory; test cases do not overlap.

    Args:
        path: the folder.
        train_size, test_size: how many runs to take, in the order of their names; None takes all.
        allow_mismatch: take data that do not obey the configured system, with a warning.
        columns: of tables, as of `NpzRecordings`, and `target`, n columns.
        stride: from how many steps to the next windows of T inputs begin in longer demonstrations.
    """

    path: str
    train_size: int | None = None
    test_size: int | None = None
    allow_mismatch: bool = False
    columns: Mapping[str, str | Sequence[str]] | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        for name in ("train_size", "test_size", "stride"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ConfigError(f"dataset: {name} is {value}; it must be at least 1")

    def determined_by(self, part: Part) -> dict[str, Any]:
        """What the folder holds, in place of where it lies, and what is taken of it."""
        _files(folder := Path(self.path) / part)
        taken = {"columns": self.columns, "stride": self.stride if self.stride > 1 else None}
        size = self.train_size if part == "train" else self.test_size
        return {"content": content_of(folder), "size": size} | {k: v for k, v in taken.items() if v}

    def train(self, task: Task, system: System) -> Demonstrations:
        """The trajectories of `path`/train."""
        shown = self._read("train", task, system)
        tau, folder = shown.trajectories(system), f"{self.path}/train"
        copies = len(tau) - len({row.tobytes() for row in tau})
        if copies:
            log.warning("%s: %d of %d trajectories are copies of others", folder, copies, len(tau))
        plant = plant_of(system, shown.runs)
        if plant.learned:
            tell_shifted(shown.runs, folder)
        residual = judge(plant, shown.states, shown.inputs, folder, self.allow_mismatch, shown.names)
        return Demonstrations(tau, shown.environment(task.condition(system)), {"residual": residual, "copies": copies})

    def test(self, task: Task, system: System) -> Cases:
        """The cases of `path`/test."""
        shown = self._read("test", task, system)
        with saying(0):
            learned = self._read("train", task, system)
        tau, condition = shown.trajectories(system), task.condition(system)
        shared = len({row.tobytes() for row in learned.trajectories(system)} & {row.tobytes() for row in tau})
        if shared:
            log.warning("%s: %d of %d test trajectories are also in train", self.path, shared, len(tau))
        plant = plant_of(system, learned.runs)
        residual = judge(plant, shown.states, shown.inputs, f"{self.path}/test", self.allow_mismatch, shown.names)
        return Cases(condition, shown.environment(condition), tau, {"also_in_train": shared, "residual": residual})

    def _read(self, part: str, task: Task, system: System) -> Windows:
        _check_ends(task, system)
        folder, count = Path(self.path) / part, self.train_size if part == "train" else self.test_size
        stride = self.stride if part == "train" else task.horizon
        runs = (
            run
            for file in _files(folder)
            for arrays in arrays_of(file, self.columns, (TARGET, START))
            for run in Shown.all_in(arrays, str(file), system)
        )
        with saying():
            return Windows.of(list(islice(runs, count)), task.horizon, stride, str(folder))


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise DataError(
            f"{folder}: there is no such folder; demonstrations lie in train and test cases in test, below dataset.path"
        )
    return list_logs(folder)


def demonstrations_of(
    tables: Sequence[pd.DataFrame], columns: Columns, system: System, task: Task, stride: int = 1
) -> Demonstrations:
    """Demonstrations from data frames, read like files.

    Args:
        tables: one row a time step.
        columns, stride: as of `NpzTrajectories`.
        system: whose sizes and time step they have; `dadiff.systems.unknown(n, m)` where there is none.
        task: whose horizon they are cut to, and whose E = [x_init; target] they are given.

    Example:
        >>> demonstrations_of([log], {"states": ["x", "v"], "inputs": ["u"]}, unknown(2, 1), LQR()).trajectories
    """
    _check_ends(task, system)
    named = {f"table {k}": arrays_of_table(table, columns, f"table {k}") for k, table in enumerate(tables)}
    runs = [run for name, parts in named.items() for arrays in parts for run in Shown.all_in(arrays, name, system)]
    found = Windows.of(runs, task.horizon, stride, "tables")
    return Demonstrations(found.trajectories(system), found.environment(task.condition(system)))


def _check_ends(task: Task, system: System) -> None:
    """Refuse a task whose E is not [x_init; target], and several robots."""
    if not isinstance(system, System) or system.robots:
        raise ConfigError("dataset: trajectories from files belong to one system, and here are several robots")
    n, condition = system.state_dim, task.condition(system)
    if condition.names != ("x_init", "target") or condition.size != 2 * n:
        fields = ", ".join(f"{channel.name} ({channel.size})" for channel in condition.channels)
        raise ConfigError(
            f"dataset: files give E = [x_init ({n}); target ({n})], but the task's E has {fields}; use "
            "dataset=environments for own environments of the obstacle task"
        )

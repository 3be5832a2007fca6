"""Trajectories in folders of .npz files, one file a trajectory, from any source.

Files are read without pickle, so nothing in them is executed. Every complaint names the file and the array.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np

from dadiff.datasets.excitation import check_excited, tell_held
from dadiff.datasets.generated import Part
from dadiff.datasets.logs import ENDINGS, Run, list_logs, read_runs, runs_of, side_by_side
from dadiff.datasets.physics import judge, judge_runs, plant_of, tell_offset, tell_shifted
from dadiff.datasets.tables import Columns, arrays_of_table
from dadiff.errors import ConfigError, DataError, NotApplicableError
from dadiff.outside import digest_of, npz
from dadiff.systems import Recording, System, TimeVarying
from dadiff.tasks import Cases, Demonstrations, Task

if TYPE_CHECKING:
    import pandas as pd

INPUT_NAMES = ("inputs", "controls")

log = logging.getLogger(__name__)


@runtime_checkable
class FromFiles(Protocol):
    """What reads files under its `path`: they count by what they hold and not by where they lie."""

    def fingerprint(self) -> str:
        """A hash of the content."""
        ...


def list_files(folder: Path) -> list[Path]:
    """The .npz files of a folder, sorted by name.

    Raises:
        DataError: if the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder; expected a folder of .npz files")
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise DataError(f"{folder}: holds no .npz file; expected one for each trajectory")
    return files


def fingerprint(folder: Path) -> str:
    """A hash of the names and contents of all .npz files below a folder."""
    return digest_of(sorted(folder.rglob("*.npz")), folder)


def read_array(file: Path, names: Sequence[str], shape: tuple[int | None, ...], remedy: str = "") -> np.ndarray:
    """One float64 array from an .npz file.

    Args:
        names: accepted names, the first that is there is read.
        shape: expected shape; None accepts any length.
        remedy: what to do if it is missing or has another shape.

    Raises:
        DataError: if it is missing, holds objects, has another shape, or values that are not finite.
    """
    label = " or ".join(names)
    array = _first_of(file, names, label, remedy)
    if array.dtype.kind not in "fiu":
        raise DataError(f"{file}: array {label} holds {array.dtype}; expected real numbers")
    expected = "(" + ", ".join("any" if k is None else str(k) for k in shape) + ")"
    if array.ndim != len(shape) or any(k not in (None, size) for k, size in zip(shape, array.shape, strict=True)):
        raise DataError(f"{file}: array {label} has shape {array.shape}; expected {expected}{remedy}")
    if not np.isfinite(array).all():
        raise DataError(f"{file}: array {label} holds a value that is not finite")
    return array.astype(np.float64)


def _first_of(file: Path, names: Sequence[str], label: str, remedy: str) -> np.ndarray:
    with npz(file, f"array {label}") as archive:
        present = [name for name in names if name in archive.files]
        if not present:
            raise DataError(f"{file}: has no array {label}; found {', '.join(archive.files) or 'none'}{remedy}")
        return np.asarray(archive[present[0]])


@dataclass(frozen=True)
class NpzTrajectories:
    """Demonstrations and test cases from `path`/train and `path`/test.

    Each file holds `states (T+1, n)`, `inputs` or `controls (T, m)`, `initial_state (n,)` and `target_state (n,)`;
    other arrays are ignored. The reference of a test case is its stored trajectory, and E = [x_init; x_target].

    Args:
        path: the folder.
        train_size, test_size: how many files to take, in the order of their names; None takes all.
        allow_mismatch: take data that do not obey the configured system, with a warning.
    """

    path: str
    train_size: int | None = None
    test_size: int | None = None
    allow_mismatch: bool = False

    def determined_by(self, part: Part) -> dict[str, Any]:
        """What the folder holds, in place of where it lies."""
        list_files(folder := Path(self.path) / part)
        return {"content": fingerprint(folder), "size": self.train_size if part == "train" else self.test_size}

    def train(self, task: Task, system: System) -> Demonstrations:
        """The trajectories of `path`/train."""
        tau, environment = self._read("train", task, system, self.train_size)
        copies = len(tau) - len({row.tobytes() for row in tau})
        if copies:
            log.warning("%s/train: %d of %d trajectories are copies of others", self.path, copies, len(tau))
        residual = self._judged("train", system, task.horizon, tau, tau)
        return Demonstrations(tau, environment, {"residual": residual, "copies": copies})

    def test(self, task: Task, system: System) -> Cases:
        """The cases of `path`/test."""
        tau, environment = self._read("test", task, system, self.test_size)
        learned, _ = self._read("train", task, system, self.train_size)
        shared = len({row.tobytes() for row in learned} & {row.tobytes() for row in tau})
        if shared:
            log.warning("%s: %d of %d test trajectories are also in train", self.path, shared, len(tau))
        residual = self._judged("test", system, task.horizon, tau, learned)
        return Cases(task.condition(system), environment, tau, {"also_in_train": shared, "residual": residual})

    def _judged(self, part: Part, system: System, horizon: int, tau: np.ndarray, learned: np.ndarray) -> float:
        """How well trajectories (N, d) obey the system; of an unknown one, those that are learned from."""
        layout, folder = system.layout(horizon), Path(self.path) / part
        runs = list(zip(*layout.split(learned), strict=True))
        plant = plant_of(system, runs)
        if plant.learned and part == "train":
            tell_shifted(runs, str(folder))
        names = [file.name for file in list_files(folder)[: len(tau)]]
        return judge(plant, *layout.split(tau), str(folder), self.allow_mismatch, names)

    def _read(self, part: str, task: Task, system: System, count: int | None) -> tuple[np.ndarray, np.ndarray]:
        if not isinstance(system, System) or system.robots:
            raise ConfigError("dataset: npz trajectories belong to one system, and here are several robots")
        n, m, T = system.state_dim, system.input_dim, task.horizon
        condition = task.condition(system)
        if condition.names != ("x_init", "target") or condition.size != 2 * n:
            fields = ", ".join(f"{channel.name} ({channel.size})" for channel in condition.channels)
            raise ConfigError(
                f"dataset: npz files give E = [x_init ({n}); target ({n})], but the task's E has {fields}; use "
                "dataset=environments for own environments of the obstacle task"
            )
        files = list_files(Path(self.path) / part)[:count]
        fit = f"; the task has {T} inputs and one state more: set task.horizon, cut, or add the state that is missing"
        states = np.stack([read_array(f, ["states"], (T + 1, n), fit) for f in files])
        inputs = np.stack([read_array(f, INPUT_NAMES, (T, m), fit) for f in files])
        add = "; add it: a trajectory's E is where it starts and where it should go"
        x_init, target = (
            np.stack([read_array(f, [name], (n,), add) for f in files]) for name in ("initial_state", "target_state")
        )
        for file, start, first in zip(files, x_init, states[:, 0], strict=True):
            if not np.allclose(start, first, rtol=1e-4, atol=1e-6):
                raise DataError(f"{file}: initial_state is {start.tolist()}, but states begin at {first.tolist()}")
        return system.layout(T).flatten(states, inputs), condition.pack(x_init=x_init, target=target)


@dataclass(frozen=True)
class NpzRecordings:
    """Own recordings Γ: a folder of .npz, .csv, .parquet or .hdf5 files with `states` and `inputs`.

    Of a fleet, one such folder a robot: `path`/robot_0, robot_1, ... See `dadiff.datasets.logs` for what is taken.
    They are held against the configured system, see `dadiff.datasets.physics`.

    Args:
        path: the folder.
        columns: of tables, `states` and `inputs` as lists of column names; `episode` and `time` as names.
        allow_mismatch: take data that do not obey the configured system, with a warning.
        offset: `estimated` holds them against the system up to a constant offset, which the projector learns.
    """

    path: str
    columns: Mapping[str, str | Sequence[str]] | None = None
    allow_mismatch: bool = False
    offset: Literal["none", "estimated", "known"] = "none"

    def fingerprint(self) -> str:
        """What the folder holds, in place of where it lies."""
        folder = Path(self.path)
        if not any(folder.glob("robot_*/*")):
            list_logs(folder)
        return digest_of(sorted(file for file in folder.rglob("*") if file.suffix in ENDINGS), folder)

    def record(self, system: System) -> Recording:
        """All runs side by side.

        Raises:
            DataError: if a file's sizes disagree with the system, or its steps; if a robot has no folder, or another
                number or length of recordings than the first one.
            NotApplicableError: if the system varies in time.
        """
        if isinstance(system, TimeVarying):
            raise NotApplicableError(
                "recording: the system varies in time, what is learned from recordings does not; use projector=known"
            )
        if not system.robots:
            return self._read(Path(self.path), system)
        folders = [Path(self.path) / f"robot_{k}" for k in range(system.robots[0])]
        if missing := [folder.name for folder in folders if not folder.is_dir()]:
            raise DataError(
                f"{self.path}: no recordings for {', '.join(missing)}; expected one folder for each of "
                f"{len(folders)} robots"
            )
        return _together(folders, [self._read(folder, system, robot) for robot, folder in enumerate(folders)])

    def _read(self, folder: Path, system: System, robot: int | None = None) -> Recording:
        runs = {str(file): read_runs(file, system, self.columns) for file in list_logs(folder)}
        return self.judged(runs, str(folder), system, robot)

    def judged(
        self, runs: Mapping[str, Sequence[Run]], where: str, system: System, robot: int | None = None
    ) -> Recording:
        """Runs side by side, held against the system.

        Args:
            runs: by the name of what they are from.
            where: all of them are from.
        """
        _tell_duplicates([(name, x) for name, its in runs.items() for x, _ in its])
        together = [run for its in runs.values() for run in its]
        plant = plant_of(system, together, robot)
        if plant.learned:
            tell_shifted(together, where)
        elif self.offset == "estimated":
            plant = tell_offset(plant, together, where)
        ratios = [judge_runs(plant, its, name, self.allow_mismatch) for name, its in runs.items()]
        states, inputs = side_by_side(together)
        notes = {"recording_residual": max(ratios), "inputs_held": float(tell_held([u for _, u in together], where))}
        if not self.allow_mismatch:
            notes["excitation_condition"] = check_excited(inputs, system.state_dim + 1, where)
        return Recording(states, inputs, notes)


def recording_of(tables: Sequence[pd.DataFrame], columns: Columns, system: System, **options: Any) -> Recording:
    """A recording from data frames, read and judged like files.

    Args:
        tables: one row a time step.
        columns: as of `NpzRecordings`.
        system: that they are held against; `dadiff.systems.unknown(n, m)` where there is none.
        options: `allow_mismatch` and `offset`, as of `NpzRecordings`.

    Example:
        >>> recording_of([log], {"states": ["x", "v"], "inputs": ["u"]}, unknown(2, 1)).length
    """
    named = {f"table {k}": arrays_of_table(table, columns, f"table {k}") for k, table in enumerate(tables)}
    runs = {name: [run for part in parts for run in runs_of(part, name, system)] for name, parts in named.items()}
    return NpzRecordings("tables", columns, **options).judged(runs, "tables", system)


def _together(folders: Sequence[Path], recordings: Sequence[Recording]) -> Recording:
    """The recordings of a fleet; the worst of what is noted of any.

    Raises:
        DataError: if a robot has another number or length of recordings than the first one.
    """
    first = recordings[0]
    for folder, recording in zip(folders, recordings, strict=True):
        if recording.inputs.shape != first.inputs.shape or np.isnan(recording.states).any():
            raise DataError(
                f"{folder}: holds {recording.count} recordings with S = {recording.length}, {folders[0].name} "
                f"{first.count} with {first.length}; cut to equal number and S"
            )
    notes = {name: max(recording.notes[name] for recording in recordings) for name in first.notes}
    return Recording(np.stack([r.states for r in recordings]), np.stack([r.inputs for r in recordings]), notes)


def _tell_duplicates(runs: Sequence[tuple[str, np.ndarray]]) -> None:
    """Say which runs are copies of others: they add nothing to what is learned from them."""
    seen: dict[bytes, str] = {}
    for name, states in runs:
        first = seen.setdefault(states.tobytes(), name)
        if first != name:
            log.warning("%s: is a copy of %s, and adds nothing", name, Path(first).name)

"""Trajectories in folders of .npz files, one file a trajectory, from any source.

Files are read without pickle, so nothing in them is executed. Every complaint names the file and the array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dadiff.datasets.generated import Part
from dadiff.errors import ConfigError, DataError
from dadiff.outside import digest_of, npz
from dadiff.systems import Recording, System
from dadiff.tasks import Cases, Demonstrations, Task

INPUT_NAMES = ("inputs", "controls")


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


def read_array(file: Path, names: Sequence[str], shape: tuple[int | None, ...]) -> np.ndarray:
    """One float64 array from an .npz file.

    Args:
        names: accepted names, the first that is there is read.
        shape: expected shape; None accepts any length.

    Raises:
        DataError: if it is missing, holds objects, has another shape, or values that are not finite.
    """
    label = " or ".join(names)
    array = _first_of(file, names, label)
    if array.dtype.kind not in "fiu":
        raise DataError(f"{file}: array {label} holds {array.dtype}; expected real numbers")
    expected = "(" + ", ".join("any" if k is None else str(k) for k in shape) + ")"
    if array.ndim != len(shape) or any(k not in (None, size) for k, size in zip(shape, array.shape, strict=True)):
        raise DataError(f"{file}: array {label} has shape {array.shape}; expected {expected}")
    if not np.isfinite(array).all():
        raise DataError(f"{file}: array {label} holds a value that is not finite")
    return array.astype(np.float64)


def _first_of(file: Path, names: Sequence[str], label: str) -> np.ndarray:
    with npz(file, f"array {label}") as archive:
        present = [name for name in names if name in archive.files]
        if not present:
            raise DataError(f"{file}: has no array {label}; found {', '.join(archive.files) or 'none'}")
        return np.asarray(archive[present[0]])


@dataclass(frozen=True)
class NpzTrajectories:
    """Demonstrations and test cases from `path`/train and `path`/test.

    Each file holds `states (T+1, n)`, `inputs` or `controls (T, m)`, `initial_state (n,)` and `target_state (n,)`;
    other arrays are ignored. The reference of a test case is its stored trajectory, and E = [x_init; x_target].

    Args:
        path: the folder.
        train_size, test_size: how many files to take, in the order of their names; None takes all.
    """

    path: str
    train_size: int | None = None
    test_size: int | None = None

    def determined_by(self, part: Part) -> dict[str, Any]:
        """What the folder holds, in place of where it lies."""
        list_files(folder := Path(self.path) / part)
        return {"content": fingerprint(folder), "size": self.train_size if part == "train" else self.test_size}

    def train(self, task: Task, system: System) -> Demonstrations:
        """The trajectories of `path`/train."""
        tau, environment = self._read("train", task, system, self.train_size)
        return Demonstrations(tau, environment)

    def test(self, task: Task, system: System) -> Cases:
        """The cases of `path`/test."""
        tau, environment = self._read("test", task, system, self.test_size)
        return Cases(task.condition(system), environment, tau)

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
        states = np.stack([read_array(f, ["states"], (T + 1, n)) for f in files])
        inputs = np.stack([read_array(f, INPUT_NAMES, (T, m)) for f in files])
        x_init, target = (
            np.stack([read_array(f, [name], (n,)) for f in files]) for name in ("initial_state", "target_state")
        )
        for file, start, first in zip(files, x_init, states[:, 0], strict=True):
            if not np.allclose(start, first, rtol=1e-4, atol=1e-6):
                raise DataError(f"{file}: initial_state is {start.tolist()}, but states begin at {first.tolist()}")
        return system.layout(T).flatten(states, inputs), condition.pack(x_init=x_init, target=target)


@dataclass(frozen=True)
class NpzRecordings:
    """Own recordings Γ: a folder of .npz files with `states (S+1, n)` and `inputs` or `controls (S, m)`, equal in S.

    Of a fleet, one such folder a robot: `path`/robot_0, robot_1, ...

    Args:
        path: the folder.
    """

    path: str

    def fingerprint(self) -> str:
        """What the folder holds, in place of where it lies."""
        if not any(Path(self.path).glob("robot_*/*.npz")):
            list_files(Path(self.path))
        return fingerprint(Path(self.path))

    def record(self, system: System) -> Recording:
        """All files side by side.

        Raises:
            DataError: if a file's sizes disagree with the system or with the first file; if a robot has no folder,
                or another number or length of recordings than the first one.
        """
        if not system.robots:
            return self._read(Path(self.path), system)
        folders = [Path(self.path) / f"robot_{k}" for k in range(system.robots[0])]
        if missing := [folder.name for folder in folders if not folder.is_dir()]:
            raise DataError(
                f"{self.path}: no recordings for {', '.join(missing)}; expected one folder for each of "
                f"{len(folders)} robots"
            )
        recordings = [self._read(folder, system) for folder in folders]
        for folder, recording in zip(folders, recordings, strict=True):
            if recording.inputs.shape != recordings[0].inputs.shape:
                raise DataError(
                    f"{folder}: holds {recording.count} recordings with S = {recording.length}, {folders[0].name} "
                    f"{recordings[0].count} with {recordings[0].length}; cut to equal number and S"
                )
        return Recording(*(np.stack([getattr(r, part) for r in recordings]) for part in ("states", "inputs")))

    def _read(self, folder: Path, system: System) -> Recording:
        files = list_files(folder)
        inputs = [read_array(f, INPUT_NAMES, (None, system.input_dim)) for f in files]
        for file, u in zip(files, inputs, strict=True):
            if len(u) != len(inputs[0]):
                raise DataError(
                    f"{file}: has S = {len(u)} inputs, {files[0].name} has {len(inputs[0])}; cut to equal S"
                )
        states = [read_array(f, ["states"], (len(inputs[0]) + 1, system.state_dim)) for f in files]
        return Recording(np.stack(states), np.stack(inputs))

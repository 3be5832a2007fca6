"""Own recordings: folders of files from any source, held against the system. Nothing in them is executed."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np

from dadiff.datasets.excitation import check_excited, tell_held
from dadiff.datasets.logs import Run, content_of, list_logs, read_runs, runs_of, saying, side_by_side
from dadiff.datasets.physics import judge_runs, plant_of, tell_offset, tell_shifted
from dadiff.datasets.tables import Columns, arrays_of_table
from dadiff.errors import DataError, NotApplicableError
from dadiff.systems import Recording, System, TimeVarying

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)


@runtime_checkable
class FromFiles(Protocol):
    """What reads files under its `path`: they count by what they hold and not by where they lie."""

    def fingerprint(self) -> str:
        """A hash of the content."""
        ...


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
        return content_of(folder)

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
        with saying():
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
        plant, notes = plant_of(system, together, robot), dict[str, float]()
        if plant.learned:
            tell_shifted(together, where)
        elif self.offset == "estimated":
            plant, notes["offset_residual"] = tell_offset(plant, together, where)
        ratios = [judge_runs(plant, its, name, self.allow_mismatch) for name, its in runs.items()]
        states, inputs = side_by_side(together)
        notes |= {"recording_residual": max(ratios), "inputs_held": float(tell_held([u for _, u in together], where))}
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

"""Sweeps on disk: `sweeps/<name>/sweep.json` says which cells a sweep has, and how each ended.

One process at a time runs a sweep: it holds the lock beside the record, and `launcher.json` says who it is.
"""

from __future__ import annotations

import os
import platform
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dadiff.errors import DataError, LockedError
from dadiff.outside import passwords_removed
from dadiff.store.files import is_locked, locked, make_folder, read_json, strict, write_json
from dadiff.store.names import SWEEP, key_of, sweep_name
from dadiff.store.typed import read_typed

PATIENCE_SECONDS = 2.0  # for a lock that is only being looked at
HOLDER = "launcher.json"


@dataclass(frozen=True)
class SweptRun:
    """One run of a sweep, as its record lists it.

    Args:
        status: "waiting" until it ended, then the status of its run, or "interrupted".
        reason: why it failed.
    """

    key: str
    name: str
    axes: dict[str, Any] = field(default_factory=dict)
    status: str = "waiting"
    reason: str | None = None


@dataclass(frozen=True)
class Sweep:
    """A sweep's definition and its cells, each key once.

    Args:
        command: what a person types to run or resume it.
        definition: parameter -> what it ranges over, as given.
    """

    name: str
    command: str
    definition: dict[str, str]
    cells: Sequence[SweptRun]


@dataclass(frozen=True)
class Holder:
    """The launcher that runs a sweep, as `launcher.json` says."""

    token: str
    host: str
    pid: int


@dataclass(frozen=True)
class Lease:
    """The right to run a sweep, as its launcher has it until its process ends. Jobs on any machine can look at it.

    Args:
        folder: of the sweep.
        token: of this launcher.
    """

    folder: Path
    token: str

    def is_held(self) -> bool:
        """Whether the launcher that took it still runs."""
        try:
            return _is_run(self.folder) and read_typed(self.folder / HOLDER, Holder).token == self.token
        except DataError:
            return True


class Sweeps:
    """The sweeps below an output folder."""

    def __init__(self, output_dir: Path | str) -> None:
        self.root = Path(output_dir).absolute() / "sweeps"

    def folder(self, name: str) -> Path:
        """Where a sweep's record and logs lie."""
        return self.root / sweep_name(name)

    def names(self) -> list[str]:
        """The names of all stored sweeps."""
        folders = [path.parent.name for path in self.root.glob("*/sweep.json")]
        return sorted(name for name in folders if SWEEP.fullmatch(name))

    @contextmanager
    def running(self, name: str) -> Iterator[Lease]:
        """Take the right to run a sweep.

        Raises:
            LockedError: if another process has it.
            StoreError: if the folder cannot be written to.
        """
        folder = make_folder(self.folder(name))
        with ExitStack() as stack:
            try:
                stack.enter_context(locked(_lock_file(folder), f"sweep {name}", PATIENCE_SECONDS))
            except LockedError as error:
                holder = read_typed(folder / HOLDER, Holder)
                raise LockedError(
                    f"sweep {name} is being run by process {holder.pid} on {holder.host}; "
                    "wait until it ends, or give this one another name with hydra.launcher.sweep=..."
                ) from error
            holder = Holder(uuid.uuid4().hex, platform.node(), os.getpid())
            write_json(folder / HOLDER, asdict(holder))
            yield Lease(folder, holder.token)

    def is_running(self, name: str) -> bool:
        """Whether a living process runs the sweep."""
        return _is_run(self.folder(name))

    def write(self, sweep: Sweep) -> Path:
        """Store a sweep in place of an older one of its name."""
        folder = make_folder(self.folder(sweep.name))
        write_json(folder / "sweep.json", passwords_removed(asdict(sweep)))
        return folder

    def holds(self, sweep: Sweep) -> bool:
        """Whether exactly this is stored, with its table."""
        folder = self.folder(sweep.name)
        if not ((folder / "sweep.json").is_file() and (folder / "results.csv").is_file()):
            return False
        stored = read_json(folder / "sweep.json")
        return strict(passwords_removed(asdict(sweep))) == {k: v for k, v in stored.items() if k != "format"}

    def read(self, name: str) -> Sweep:
        """One stored sweep.

        Raises:
            DataError: if there is none of this name, or its record is damaged.
            StoreError: if its format is newer than this version reads.
        """
        path = self.folder(name) / "sweep.json"
        sweep = read_typed(path, Sweep)
        if sweep.name != name:
            raise DataError(
                f"{path}: is the record of sweep {sweep.name[:80]!r}; was its folder renamed? give it back its name"
            )
        for cell in sweep.cells:
            key_of(cell.key)
        return sweep


def _lock_file(folder: Path) -> Path:
    return folder / ".lock"


def _is_run(folder: Path) -> bool:
    return is_locked(_lock_file(folder))

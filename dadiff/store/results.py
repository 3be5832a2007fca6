"""Runs on disk: `runs/<key>` holds `run.json`, `config.yaml`, tables as parquet and arrays as npz.

A run is written into a hidden folder beside its place and renamed, so it is there whole or not at all.
Numbers that are not finite are null in `run.json` and nan again when read.
A failed run is recorded too, with its reason; such a record gives way when the run is done again.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dadiff.errors import DataError, LockedError, StoreError
from dadiff.outside import check_parquet, npz, passwords_removed
from dadiff.store.files import (
    broken_seals,
    checksum,
    files_in,
    fresh_folder,
    is_locked,
    locked,
    make_folder,
    seal,
    sync_folder,
    write_json,
)
from dadiff.store.folder import store_id
from dadiff.store.names import key_of
from dadiff.store.record import DONE, Record, Status, read_record

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

RECORD = "run.json"
PATIENCE_SECONDS = 2.0  # for a process that is just ending

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredRun:
    """A run as stored: its record at once, its tables and arrays when asked for.

    Args:
        folder: `runs/<key>`.
    """

    folder: Path
    record: Record

    @property
    def key(self) -> str:
        """The run's content-derived key, 16 hex digits."""
        return self.record.key

    @property
    def name(self) -> str:
        """The name for people."""
        return self.record.name

    @property
    def status(self) -> Status:
        """How it ended."""
        return self.record.status

    @property
    def axes(self) -> Mapping[str, Any]:
        """The parameters worth showing, flat."""
        return self.record.axes

    @property
    def metrics(self) -> Mapping[str, float]:
        """Headline scalars; nan where a value was not finite."""
        return self.record.metrics

    def has(self, name: str) -> bool:
        """Whether the run holds this table (without suffix)."""
        return (self.folder / f"{name}.parquet").is_file()

    def table(self, name: str) -> pd.DataFrame:
        """One table: "per_step", "per_plan" or "chain".

        Raises:
            StoreError: if the run has no such table or it is damaged.
        """
        return read_table(self.folder, name)

    def arrays(self, name: str = "examples") -> dict[str, np.ndarray]:
        """The arrays of an npz file; empty if the run has none.

        Raises:
            DataError, StoreError: if the file is damaged.
        """
        path = self.folder / f"{name}.npz"
        if not path.is_file():
            return {}
        _check_seal(path)
        with npz(path) as stored:
            return {key: stored[key] for key in stored.files}


@lru_cache(maxsize=4096)
def _seals(path: Path, changed: int) -> Mapping[str, Any]:
    return read_record(path).files


@lru_cache(maxsize=65536)
def _is_whole(path: Path, changed: int, seal: tuple[int, str]) -> bool:
    return (path.stat().st_size, checksum(path)) == seal


def _check_seal(path: Path) -> None:
    """Refuse a run's file that is not what was written; looked at once, and again when it changes.

    Raises:
        StoreError: if it differs from its checksum.
    """
    record = path.with_name(RECORD)
    seal = _seals(record, record.stat().st_mtime_ns).get(path.name)
    if seal and not _is_whole(path, path.stat().st_mtime_ns, (seal.get("bytes", -1), str(seal.get("sha256")))):
        raise StoreError(f"{path}: differs from its checksum; run it again with force=true")


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """A table of the run in a folder.

    Raises:
        StoreError: if the run has no such table or it is damaged.
    """
    from pyarrow.parquet import ParquetFile

    with _sound(path := folder / f"{name}.parquet"):
        check_parquet(path)
        with ParquetFile(path) as file:  # in a third of pandas' time, which first looks for a folder of such files
            return file.read(use_threads=False).to_pandas(use_threads=False)  # small: threads take longer to wake


def columns_of(folder: Path, name: str) -> tuple[str, ...]:
    """The columns of a table of the run in a folder, whose rows are not read.

    Raises:
        StoreError: as `read_table`.
    """
    from pyarrow.parquet import read_schema

    with _sound(path := folder / f"{name}.parquet"):
        return tuple(read_schema(path).names)


@contextmanager
def _sound(path: Path) -> Iterator[None]:
    """While a table is read that must be there and undamaged.

    Raises:
        StoreError: if it is not.
    """
    if not path.is_file():
        raise StoreError(f"{path}: this run has no such table; see status and reason in its {RECORD}")
    _check_seal(path)
    try:
        yield
    except DataError as error:
        raise StoreError(str(error)) from error
    except (OSError, ValueError, KeyError) as error:
        text = " ".join(str(error).split())
        raise StoreError(f"{path}: is damaged ({text}); run it again with force=true") from error


class Results:
    """The runs below an output folder."""

    def __init__(self, output_dir: Path | str) -> None:
        self.root = Path(output_dir).absolute() / "runs"

    def folder(self, key: str) -> Path:
        """Where a run lies, whether it exists or not."""
        return self.root / key_of(key)

    def status(self, key: str) -> Status | None:
        """The status of a stored run; None if there is none, or one that is damaged or another's.

        Raises:
            StoreError: if its format is newer than this version reads.
        """
        if not (self.folder(key) / RECORD).is_file():
            return None
        try:
            return self.read(key).status
        except DataError as error:
            log.warning("%s; it counts as not done", error)
            return None

    def is_done(self, key: str) -> bool:
        """Whether the run is finished, or ended in a way that is itself a result."""
        return self.status(key) in DONE

    def read(self, key: str) -> StoredRun:
        """One stored run.

        Raises:
            DataError: if there is none, or its record is damaged or that of another run.
            StoreError: if its format is newer than this version reads.
        """
        path = self.folder(key) / RECORD
        record = read_record(path)
        if record.key != key:
            raise DataError(
                f"{path}: is the record of run {record.key[:80]}; was its folder renamed? give it back its name"
            )
        return StoredRun(path.parent, record)

    def __iter__(self) -> Iterator[StoredRun]:
        """All stored runs, failed ones among them, in the order of their names; a line for each that is unreadable."""
        keys = [path.parent.name for path in sorted(self.root.glob(f"[!.]*/{RECORD}"))]
        return iter(sorted(filter(None, map(self._readable, keys)), key=lambda run: run.name))

    def _readable(self, key: str) -> StoredRun | None:
        try:
            return self.read(key)
        except (DataError, StoreError) as error:
            log.warning("left out: %s", error)
            return None

    def damaged(self) -> Iterator[tuple[str, list[str]]]:
        """The runs whose record cannot be read or whose files differ from their checksums, with what is wrong."""
        for path in sorted(self.root.glob(f"[!.]*/{RECORD}")):
            try:
                problems = broken_seals(path.parent, self.read(path.parent.name).record.files)
            except (DataError, StoreError) as error:
                problems = [str(error)]
            if problems:
                yield path.parent.name, problems

    def working(self, key: str) -> AbstractContextManager[None]:
        """Claim the run while working on it; a second process that wants it waits, then finds it done."""
        return locked(self._lock_file(key), f"run {key}")

    def working_keys(self) -> list[str]:
        """The runs that living processes work on."""
        return [lock.stem for lock in sorted(self.root.glob(".locks/*.lock")) if is_locked(lock)]

    def write(
        self,
        record: Record,
        *,
        files: Mapping[str, bytes] | None = None,
        tables: Mapping[str, pd.DataFrame] | None = None,
        arrays: Mapping[str, np.ndarray] | None = None,
    ) -> StoredRun:
        """Store a run whole, in place of an older one with its key.

        Args:
            files: name -> content, such as the resolved configuration as yaml, for people.
            tables: name -> table, each a parquet file.
            arrays: what goes into `examples.npz`.

        Raises:
            StoreError: if the folder cannot be written to.
        """
        import numpy as np

        make_folder(self.root)
        store_id(self.root.parent)
        work = fresh_folder(self.root / f".writing-{key_of(record.key)}")
        for name, table in (tables or {}).items():
            table.to_parquet(work / f"{name}.parquet", index=False)
        if arrays:
            np.savez(work / "examples.npz", **dict(arrays))  # type: ignore[arg-type]
        for name, content in (files or {}).items():
            (work / name).write_bytes(content)
        sealed = replace(record, files=seal(files_in(work), work)).to_json()
        write_json(work / RECORD, passwords_removed(sealed))
        sync_folder(work)
        _replace(work, self.folder(record.key))
        return self.read(record.key)

    def write_failure(self, record: Record) -> None:
        """Record how a run failed, unless a result with its key is there already, or on its way."""
        try:
            with locked(self._lock_file(record.key), f"run {record.key}", PATIENCE_SECONDS):
                if not self.is_done(record.key):
                    self.write(record)
        except LockedError:
            log.info("run %s: failed here (%s), but another process works on it", record.key, record.reason)

    def _lock_file(self, key: str) -> Path:
        return self.root / ".locks" / f"{key_of(key)}.lock"


def _replace(new: Path, folder: Path) -> None:
    old = folder.with_name(f".replaced-{folder.name}")
    shutil.rmtree(old, ignore_errors=True)
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)

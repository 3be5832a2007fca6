"""Files that are whole or absent: strict JSON, checksums, syncing to disk, and locks between processes."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from dadiff.errors import DataError, LockedError, StoreError
from dadiff.outside import text_of
from dadiff.store.names import is_inside

FORMAT = 1
"""Version of everything that `dadiff.store` writes; readers refuse newer ones."""

log = logging.getLogger(__name__)


def make_folder(path: Path) -> Path:
    """The folder, made if needed.

    Raises:
        StoreError: if it cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{path}: cannot make this folder ({error.strerror}); choose another output_dir") from error
    if not os.access(path, os.W_OK):
        raise StoreError(f"{path}: this folder cannot be written to; choose another output_dir (of a report: --out)")
    return path


def strict(value: Any) -> Any:
    """A copy for strict JSON: numbers that are not finite become null, numpy scalars plain ones, paths text."""
    if isinstance(value, dict):
        return {str(name): strict(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(part) for part in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write strict JSON with the format's version on top, replacing an older file at once."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)  # where a link led, nothing is written
    temporary.write_text(json.dumps({"format": FORMAT, **strict(value)}, indent=1, allow_nan=False) + "\n")
    sync(temporary)
    temporary.replace(path)


def read_json(path: Path) -> dict[str, Any]:
    """What `write_json` wrote.

    Raises:
        DataError: if the file is missing or damaged.
        StoreError: if it is of a newer format than this version reads.
    """
    text = text_of(path)
    try:
        value = json.loads(text)
        version = int(value["format"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{path}: is damaged or not written by dadiff ({error}); remove it and run again") from error
    if version > FORMAT:
        raise StoreError(f"{path}: has format {version}, this version reads up to {FORMAT}; update dadiff")
    return value


def fresh_folder(path: Path) -> Path:
    """An empty folder in the place of whatever lies there. Of a link only the link goes.

    Raises:
        StoreError: if it cannot be made or written to.
    """
    if path.is_symlink() or path.is_file():
        path.unlink()
    shutil.rmtree(path, ignore_errors=True)
    return make_folder(path)


def files_in(folder: Path) -> list[Path]:
    """All files below a folder, in a fixed order, without links."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def seal(files: Iterable[Path], folder: Path) -> dict[str, dict[str, Any]]:
    """What tells later whether files are what was written: relative path -> checksum and size."""
    return {
        path.relative_to(folder).as_posix(): {"sha256": checksum(path), "bytes": path.stat().st_size} for path in files
    }


def broken_seals(folder: Path, sealed: Mapping[str, Any]) -> list[str]:
    """What is wrong with sealed files, one phrase a file; empty if they are what was written."""
    return [problem for name, seal in sealed.items() if (problem := _broken(folder, name, seal))]


def _broken(folder: Path, name: str, seal: Any) -> str | None:
    path = folder / name
    if not is_inside(name) or not isinstance(seal, Mapping):
        return f"{name!r} is no file of this folder"
    if not path.is_file() or path.is_symlink():
        return f"{name} is missing"
    differs = path.stat().st_size != seal.get("bytes") or checksum(path) != seal.get("sha256")
    return f"{name} differs from its checksum" if differs else None


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Wait until a file or folder has reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until a folder with all its files has reached the disk."""
    for path in [*files_in(folder), folder]:
        sync(path)


@contextmanager
def locked(path: Path, what: str, patience: float | None = None) -> Iterator[None]:
    """Hold a lock that is freed when its process ends, however it ends. Says so when it has to wait.

    Args:
        patience: seconds to wait for it; None for as long as it takes.

    Raises:
        LockedError: if another process holds it for longer.
    """
    lock = _lock(path)
    try:
        lock.acquire(timeout=patience or 0)
    except Timeout:
        if patience is not None:
            raise LockedError(f"{what}: another process is working on it; wait until it ends") from None
        log.info("waiting for %s, which another process is working on", what)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock."""
    if not path.exists():
        return False
    lock = _lock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return True
    lock.release()
    return False


def _lock(path: Path) -> FileLock:
    make_folder(path.parent)
    return FileLock(path, thread_local=False)

"""The content-addressed cache: data sets, recordings and trained denoisers, each built once.

An entry is the folder `cache/<kind>/<key>` with its payload and `manifest.json` (identity and checksums).
It is built in `<key>.partial`, which survives a kill so that a training can go on from its checkpoint,
and renamed when it is whole. A damaged entry is set aside as `<key>.damaged-N` and built again.
"""

from __future__ import annotations

import logging
import platform
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dadiff.errors import DataError, StoreError
from dadiff.store.files import checksum, files_in, is_locked, locked, make_folder, read_json, sync_folder, write_json

MANIFEST = "manifest.json"
PARTIAL, DAMAGED = ".partial", ".damaged-"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """One folder of the cache as it lies on disk.

    Args:
        state: "whole" (its checksums are not looked at here), "partial", "building" or "damaged".
        size: in bytes.
    """

    kind: str
    key: str
    folder: Path
    state: str
    size: int


class Cache:
    """The cache below an output folder. Entries are verified once per process, when first read."""

    def __init__(self, output_dir: Path | str) -> None:
        self.root = Path(output_dir).absolute() / "cache"
        self._verified: set[Path] = set()

    def folder(self, kind: str, key: str) -> Path:
        """Where an entry lies, whether it exists or not."""
        return self.root / kind / key

    def contains(self, kind: str, key: str) -> bool:
        """Whether the entry was built; a look at the folder only, checksums are verified on reading."""
        return (self.folder(kind, key) / MANIFEST).is_file()

    def get_or_build(
        self,
        kind: str,
        key: str,
        identity: dict[str, Any],
        build: Callable[[Path], None],
        *,
        resumable: bool = False,
    ) -> Path:
        """The folder of an intact entry; built here if it is missing or damaged, by one process at a time.

        Args:
            identity: everything that determines the content; kept in the manifest for people.
            build: writes the payload, and nothing else that should not stay, into the folder that it is given.
            resumable: hand `build` what a killed predecessor left in its folder, instead of an empty one.

        Raises:
            StoreError: if the cache cannot be written to or `build` wrote nothing.
        """
        folder = self.folder(kind, key)
        if not self._is_intact(folder):
            with locked(self._lock_file(kind, key), f"{kind} {key}"):
                if not self._is_intact(folder):
                    _set_aside(folder)
                    _build(folder, kind, key, identity, build, resumable)
                self._verified.add(folder)
        return folder

    def is_building(self, kind: str, key: str) -> bool:
        """Whether a living process is building the entry."""
        return is_locked(self._lock_file(kind, key))

    def entries(self) -> Iterator[Entry]:
        """Every folder in the cache, whole or not."""
        for folder in sorted(self.root.glob("[!.]*/[!.]*/")):
            kind, key = folder.parent.name, folder.name.split(".")[0]
            size = sum(path.stat().st_size for path in files_in(folder))
            yield Entry(kind, key, folder, self._state(folder, kind, key), size)

    def _state(self, folder: Path, kind: str, key: str) -> str:
        if DAMAGED in folder.name:
            return "damaged"
        if folder.name.endswith(PARTIAL):
            return "building" if self.is_building(kind, key) else "partial"
        return "whole"

    def _lock_file(self, kind: str, key: str) -> Path:
        return self.root / ".locks" / f"{kind}-{key}.lock"

    def _is_intact(self, folder: Path) -> bool:
        if folder in self._verified:
            return True
        intact = folder.exists() and not damage(folder)
        if intact:
            self._verified.add(folder)
        return intact


def damage(folder: Path) -> list[str]:
    """What is wrong with an entry, one phrase a file; empty if its files are those of its manifest.

    Raises:
        StoreError: if a newer version wrote it.
    """
    try:
        files = read_json(folder / MANIFEST)["files"]
    except DataError as error:
        return [str(error)]
    problems = []
    for name, expected in files.items():
        path = folder / name
        if not path.is_file():
            problems.append(f"{name} is missing")
        elif path.stat().st_size != expected["bytes"] or checksum(path) != expected["sha256"]:
            problems.append(f"{name} differs from its checksum")
    return problems


def _set_aside(folder: Path) -> None:
    if not folder.exists():
        return
    number = 1
    while (aside := folder.with_name(f"{folder.name}{DAMAGED}{number}")).exists():
        number += 1
    log.warning(
        "%s %s is damaged (%s): set aside as %s, built again",
        folder.parent.name, folder.name, "; ".join(damage(folder)), aside.name,
    )  # fmt: skip
    folder.rename(aside)


def _build(
    folder: Path, kind: str, key: str, identity: dict[str, Any], build: Callable[[Path], None], resumable: bool
) -> None:
    partial = folder.with_name(folder.name + PARTIAL)
    if partial.exists() and not resumable:
        shutil.rmtree(partial)
    make_folder(partial)
    build(partial)
    files = {str(p.relative_to(partial)): p for p in files_in(partial) if p.name != MANIFEST}
    if not files:
        raise StoreError(f"{folder}: building it wrote no file")
    write_json(
        partial / MANIFEST,
        {
            "kind": kind,
            "key": key,
            "identity": identity,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "host": platform.node(),
            "files": {name: {"sha256": checksum(p), "bytes": p.stat().st_size} for name, p in files.items()},
        },
    )
    sync_folder(partial)
    partial.rename(folder)

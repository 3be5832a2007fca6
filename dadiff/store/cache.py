"""The content-addressed cache: data sets, recordings and trained denoisers, each built once.

An entry is the folder `cache/<kind>/<key>` with its payload and `manifest.json` (identity and checksums).
It is built in `<key>.partial`, which survives a kill so that a training can go on from its checkpoint,
and renamed when it is whole. A damaged or misplaced entry is set aside as `<key>.damaged-N` and built again.
"""

from __future__ import annotations

import logging
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dadiff.errors import DataError, StoreError
from dadiff.store.files import (
    broken_seals,
    files_in,
    fresh_folder,
    is_locked,
    locked,
    seal,
    sync_folder,
    write_json,
)
from dadiff.store.folder import store_id
from dadiff.store.names import KEY, KIND, key_of, kind_of
from dadiff.store.typed import read_typed

MANIFEST = "manifest.json"
PARTIAL, DAMAGED = ".partial", ".damaged-"
FOLDER = re.compile(rf"{KEY.pattern}(\{PARTIAL}|\{DAMAGED}\d+)?")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Manifest:
    """`manifest.json` of an entry.

    Args:
        identity: everything that determines the content, for people.
        files: name -> checksum and size; none while it is being built.
    """

    kind: str
    key: str
    files: Mapping[str, Mapping[str, Any]]
    identity: Mapping[str, Any] = field(default_factory=dict)
    created: str | None = None
    host: str = ""


@dataclass(frozen=True)
class Entry:
    """One folder of the cache as it lies on disk.

    Args:
        state: "whole" (its checksums are not looked at here), "partial", "building", "damaged", or "foreign": without a
            manifest of its kind and key.
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
        return self.root / kind_of(kind) / key_of(key)

    def contains(self, kind: str, key: str) -> bool:
        """Whether the entry was built; a look at its manifest only, checksums are verified on reading."""
        folder = self.folder(kind, key)
        return (folder / MANIFEST).is_file() and not misplaced(folder, kind, key)

    def get_or_build(
        self,
        kind: str,
        key: str,
        identity: dict[str, Any],
        build: Callable[[Path], None],
        *,
        resumable: bool = False,
        anew: bool = False,
    ) -> Path:
        """The folder of an intact entry; built here if it is missing or damaged, by one process at a time.

        Args:
            identity: everything that determines the content; kept in the manifest for people.
            build: writes the payload, and nothing else that should not stay, into the folder that it is given.
            resumable: hand `build` what a killed predecessor left in its folder, instead of an empty one.
            anew: build it again in place of the one that is there.

        Raises:
            StoreError: if the cache cannot be written to or `build` wrote nothing.
        """
        folder = self.folder(kind, key)
        if anew or not self._is_intact(folder):
            store_id(self.root.parent)
            with locked(self._lock_file(kind, key), f"{kind} {key}"):
                if anew and folder.is_dir():
                    fresh_folder(folder).rmdir()
                    self._verified.discard(folder)
                if not self._is_intact(folder):
                    _set_aside(folder)
                    _build(folder, kind, key, identity, build, resumable)
                self._verified.add(folder)
        return folder

    def is_building(self, kind: str, key: str) -> bool:
        """Whether a living process is building the entry."""
        return is_locked(self._lock_file(kind, key))

    def entries(self) -> Iterator[Entry]:
        """Every folder in the cache that has the name of an entry, whole or not. Links are not followed."""
        for folder in sorted(self.root.glob("*/*/")):
            kind, key = folder.parent.name, folder.name.split(".")[0]
            named = KIND.fullmatch(kind) and FOLDER.fullmatch(folder.name)
            if named and not folder.is_symlink() and not folder.parent.is_symlink():
                size = sum(path.stat().st_size for path in files_in(folder))
                yield Entry(kind, key, folder, self._state(folder, kind, key), size)

    def _state(self, folder: Path, kind: str, key: str) -> str:
        if misplaced(folder, kind, key):
            return "foreign"
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
    if wrong := misplaced(folder, folder.parent.name, folder.name.split(".")[0]):
        return [wrong]
    files = read_typed(folder / MANIFEST, Manifest).files
    return broken_seals(folder, files) if files else [f"{MANIFEST} names no file"]


def misplaced(folder: Path, kind: str, key: str) -> str | None:
    """What is wrong with a folder's manifest as that of an entry; None if it says this kind and key.

    Raises:
        StoreError: if a newer version wrote it.
    """
    try:
        found = read_typed(folder / MANIFEST, Manifest)
    except DataError as error:
        return str(error)
    if (found.kind, found.key) == (kind, key):
        return None
    return f"{MANIFEST} is that of {found.kind} {found.key}, not of {kind} {key}"


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
    manifest = {"kind": kind, "key": key, "identity": identity, "host": platform.node()}
    if not resumable or partial.is_symlink() or misplaced(partial, kind, key):
        write_json(fresh_folder(partial) / MANIFEST, {**manifest, "files": {}})  # whose it is, also if killed
    build(partial)
    files = seal((path for path in files_in(partial) if path.name != MANIFEST), partial)
    if not files:
        raise StoreError(f"{folder}: building it wrote no file")
    created = datetime.now(UTC).isoformat(timespec="seconds")
    write_json(partial / MANIFEST, {**manifest, "created": created, "files": files})
    sync_folder(partial)
    partial.rename(folder)

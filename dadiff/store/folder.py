"""The output folder as a whole: an id that goes with it wherever it is moved or mounted."""

from __future__ import annotations

import os
import uuid
from dataclasses import dataclass
from pathlib import Path

from dadiff.errors import DataError
from dadiff.store.files import locked, make_folder, write_json
from dadiff.store.typed import read_typed

STORE = "store.json"


@dataclass(frozen=True)
class Store:
    """`store.json`: what an output folder says of itself."""

    id: str


def store_id(output_dir: Path | str) -> str:
    """The folder's id, made when it is first asked for.

    Raises:
        StoreError: if the folder cannot be written to.
        DataError: if the file that holds the id is damaged.
    """
    root = make_folder(Path(output_dir).absolute())
    path = root / STORE
    if not path.is_file():
        with locked(root / ".store.lock", f"the id of {root}"):
            if not path.is_file():
                write_json(path, {"id": uuid.uuid4().hex})
    return read_typed(path, Store).id


def is_read_only(output_dir: Path | str) -> bool:
    """Whether the folder is there and this process may not write to it."""
    return os.path.isdir(output_dir) and not os.access(output_dir, os.W_OK)


def is_store(output_dir: Path | str) -> bool:
    """Whether a folder is one that dadiff has written to."""
    try:
        return bool(read_typed(Path(output_dir).absolute() / STORE, Store).id)
    except DataError:
        return False

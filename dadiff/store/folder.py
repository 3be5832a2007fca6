"""The output folder as a whole: an id that goes with it wherever it is moved or mounted."""

from __future__ import annotations

import uuid
from pathlib import Path

from dadiff.store.files import locked, make_folder, read_json, write_json


def store_id(output_dir: Path | str) -> str:
    """The folder's id, made when it is first asked for.

    Raises:
        StoreError: if the folder cannot be written to.
        DataError: if the file that holds the id is damaged.
    """
    root = make_folder(Path(output_dir).absolute())
    path = root / "store.json"
    if not path.is_file():
        with locked(root / ".store.lock", f"the id of {root}"):
            if not path.is_file():
                write_json(path, {"id": uuid.uuid4().hex})
    return str(read_json(path)["id"])

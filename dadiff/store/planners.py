"""Planners in files, as bytes; what they mean is `dadiff.planning`'s to say.

A run's folder holds `planner.json` and `arrays.safetensors`, its weights lie in the cache beside it; a zip holds the
two with the weights among the arrays. Entries are stored, not compressed, so that no file unpacks to more than it has.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as read_arrays
from safetensors.numpy import save as write_arrays

from dadiff.errors import CheckpointError, DataError
from dadiff.outside import UNREADABLE, json_of, regular
from dadiff.store.cache import Cache

DESCRIPTION, ARRAYS, MODEL = "planner.json", "arrays.safetensors", "model.safetensors"
WEIGHTS = "weights."


def pack(folder: Path, path: Path) -> Path | None:
    """Write the planner of a run's folder as one file; None where the run has none that can be stored.

    Raises:
        CheckpointError: if what the folder holds is damaged, or the place cannot be written to.
    """
    if not (folder / DESCRIPTION).is_file() or "unavailable" in _description(folder):
        return None
    return write_file(path, *read_folder(folder))


def _description(folder: Path) -> dict[str, Any]:
    content = json_of(folder / DESCRIPTION)
    if not isinstance(content, dict):
        raise CheckpointError(f"{folder}: the planner in it is a {type(content).__name__}, which is none of dadiff's")
    return content


def write_file(path: Path, description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Path:
    """Write a planner whole, by renaming it into place.

    Raises:
        CheckpointError: if the place cannot be written to.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as file:
            file.writestr(DESCRIPTION, json.dumps(description))
            file.writestr(ARRAYS, write_arrays(dict(arrays)))
        partial.replace(path)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written ({error.strerror}); name another place") from error
    return path


def read_folder(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a run's folder holds, and the weights from the cache beside it.

    Raises:
        CheckpointError: if there is no planner, or it is damaged, or its weights are gone.
    """
    if not (path / DESCRIPTION).is_file():
        raise CheckpointError(
            f"{path}: holds no {DESCRIPTION}; it is no run of a plan that can be loaded, or an old one"
        )
    try:
        description = _description(path)
        if reason := description.get("unavailable"):
            raise CheckpointError(f"{path}: cannot be loaded as a planner: {str(reason)[:300]}")
        arrays = read_arrays(regular(path / ARRAYS).read_bytes())
        if (key := description.get("weights")) is None:
            return description, arrays
        return description, arrays | {WEIGHTS + name: a for name, a in _model(path, key).items()}
    except (DataError, SafetensorError, OSError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(
            f"{path}: the planner in it is damaged ({error}); run it again with force=true"
        ) from error


def _model(path: Path, key: object) -> dict[str, np.ndarray]:
    if not (isinstance(key, str) and re.fullmatch("[0-9a-f]{16}", key)):
        raise CheckpointError(f"{path}: names the weights {str(key)[:40]!r}, which is no key of a cache")
    file = Cache(path.absolute().parent.parent).folder("denoiser", key) / MODEL
    if not file.is_file():
        raise CheckpointError(f"{path}: its trained denoiser {key} is no longer in the cache; run it again")
    return dict(read_arrays(regular(file).read_bytes()))


def read_file(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a planner's file holds.

    Raises:
        CheckpointError: if it is missing, foreign or damaged.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; give a file that planner.save(...) wrote, or a run's folder")
    try:
        with zipfile.ZipFile(path) as file:
            _check_entries(file, path)
            return json.loads(file.read(DESCRIPTION)), read_arrays(file.read(ARRAYS))
    except (*UNREADABLE, SafetensorError, KeyError) as error:
        raise CheckpointError(f"{path}: is no planner of dadiff, or damaged ({error})") from error


def _check_entries(file: zipfile.ZipFile, path: Path) -> None:
    names = {entry.filename for entry in file.infolist()}
    if names != {DESCRIPTION, ARRAYS}:
        raise CheckpointError(f"{path}: holds {', '.join(sorted(names))[:80]}; expected {DESCRIPTION} and {ARRAYS}")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in file.infolist()):
        raise CheckpointError(f"{path}: is compressed, which a planner's file never is; save it again")
    if sum(entry.file_size for entry in file.infolist()) > path.stat().st_size:
        raise CheckpointError(f"{path}: declares more bytes than it has; it is damaged")

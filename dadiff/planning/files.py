"""Planners in files: a zip of `planner.json` (what it is made of) and `arrays.safetensors` (its numbers).

A run's folder holds the same two, without the weights, which lie in the store's cache. The zip holds the weights, the
robot's set and coordinates, and needs neither demonstrations nor the folder that it was trained in. Loading it executes
nothing: see `dadiff.planning.codec`. Entries are stored, not compressed, so that no file unpacks to more than its size.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load as read_arrays
from safetensors.numpy import save as write_arrays

from dadiff import __version__
from dadiff.denoisers.checkpoints import fill
from dadiff.errors import CheckpointError
from dadiff.planning.codec import Decoder, Encoder
from dadiff.planning.planner import Parts, Planner
from dadiff.store import Cache

FORMAT = 1
DESCRIPTION, ARRAYS, MODEL = "planner.json", "arrays.safetensors", "model.safetensors"
WEIGHTS = "weights."
RUNTIME = ("denoiser", "device")  # fields of a planner that are stored by other means, or not


def save(planner: Planner, path: Path) -> Path:
    """Write a planner whole, by renaming it into place.

    Raises:
        CheckpointError: if a part of it cannot be stored, or the place cannot be written to.
    """
    description, arrays = described(planner)
    arrays |= {WEIGHTS + name: tensor.detach().cpu().numpy() for name, tensor in planner.denoiser.state_dict().items()}
    partial = path.with_name(f".{path.name}.partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as file:
            file.writestr(DESCRIPTION, json.dumps(description))
            file.writestr(ARRAYS, write_arrays(arrays))
        partial.replace(path)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be written ({error.strerror}); name another place") from error
    return path


def described(planner: Planner) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a planner is made of, as plain data and arrays, without its weights."""
    encode = Encoder()
    parts = {f.name: getattr(planner, f.name) for f in fields(planner) if f.name not in RUNTIME}
    plain = {name: encode(value, name) for name, value in parts.items()}
    plain["denoiser"] = encode(planner.denoiser.made_from, "denoiser")
    return {"format": FORMAT, "dadiff": __version__, "planner": plain}, encode.arrays


def in_folder(planner: Planner, weights: str | None) -> dict[str, bytes]:
    """The files, by name, from which a run's folder is loaded as a planner.

    Where a part cannot be stored, such as a system made from a function, they say so to whoever loads them.

    Args:
        weights: the key of the trained denoiser in the cache; None where nothing is trained.
    """
    try:
        description, arrays = described(planner)
    except CheckpointError as error:
        return {DESCRIPTION: json.dumps({"format": FORMAT, "unavailable": str(error)}).encode()}
    return {DESCRIPTION: json.dumps({**description, "weights": weights}).encode(), ARRAYS: write_arrays(arrays)}


def load(path: Path, components: Sequence[str] = (), device: str = "cpu") -> Planner:
    """The planner of a file, or of a run's folder `runs/<key>`.

    Raises:
        CheckpointError: if the file is missing, foreign, damaged, too large, or of a newer version.
    """
    description, arrays = _folder(path) if path.is_dir() else _opened(path)
    return planner_of(description, arrays, str(path), components, device)


def planner_of(
    description: Mapping[str, Any], arrays: Mapping[str, np.ndarray], where: str, components: Sequence[str], device: str
) -> Planner:
    """The planner that is described, with the weights among the arrays."""
    _check_format(description, where)
    decode = Decoder(arrays, where, components)
    try:
        parts = {name: decode(plain) for name, plain in description["planner"].items()}
        made = parts.pop("denoiser")
        _check_sizes(made, parts, where)
        denoiser = made.build(device)
        planner = Planner(denoiser=denoiser, device=device, **parts)
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{where}: lacks a part of a planner ({error}); save it again") from error
    weights = {
        name.removeprefix(WEIGHTS): torch.from_numpy(a) for name, a in arrays.items() if name.startswith(WEIGHTS)
    }
    fill(denoiser.state_dict(), weights, Path(where))
    return planner


def _check_sizes(made: Parts, parts: Mapping[str, Any], where: str) -> None:
    """Raise unless all parts are of the same trajectories and condition: before anything of their sizes is built."""
    system, task, behaviour = parts["system"], parts["task"], parts.get("behaviour")
    d, c = system.layout(task.horizon).size, task.condition(system).size
    found = {"coordinates": parts["coordinates"].mean.size, "denoiser": made.sizes[0]}
    found |= {"set": behaviour.layout.size} if behaviour else {}
    for part, size in found.items():
        if size != d:
            raise CheckpointError(
                f"{where}: its {part} has tau of {size} entries, its task and system {d}; save it again"
            )
    if made.sizes[1] not in (None, c):
        raise CheckpointError(f"{where}: its denoiser takes E of {made.sizes[1]} entries, its task {c}; save it again")


def _check_format(description: Mapping[str, Any], where: str) -> None:
    found = description.get("format") if isinstance(description, Mapping) else None
    if not isinstance(found, int) or not isinstance(description.get("planner"), dict):
        raise CheckpointError(f"{where}: is no planner of dadiff; write one with planner.save(...)")
    if found > FORMAT:
        raise CheckpointError(
            f"{where}: has format {found}, this version reads up to {FORMAT}; update dadiff ({__version__} is here, "
            f"{description.get('dadiff', 'unknown')} wrote it)"
        )


def _folder(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a run's folder holds, and the weights from the cache beside it."""
    if not (path / DESCRIPTION).is_file():
        raise CheckpointError(
            f"{path}: holds no {DESCRIPTION}; it is no run of a plan that can be loaded, or an old one"
        )
    try:
        description = json.loads((path / DESCRIPTION).read_bytes())
        if reason := description.get("unavailable"):
            raise CheckpointError(f"{path}: cannot be loaded as a planner: {str(reason)[:300]}")
        arrays = read_arrays((path / ARRAYS).read_bytes())
        if (key := description.get("weights")) is None:
            return description, arrays
        return description, arrays | {WEIGHTS + name: a for name, a in _model(path, key).items()}
    except (json.JSONDecodeError, UnicodeDecodeError, SafetensorError, AttributeError, OSError) as error:
        raise CheckpointError(
            f"{path}: the planner in it is damaged ({error}); run it again with force=true"
        ) from error


def _model(path: Path, key: object) -> dict[str, np.ndarray]:
    if not (isinstance(key, str) and re.fullmatch("[0-9a-f]{16}", key)):
        raise CheckpointError(f"{path}: names the weights {str(key)[:40]!r}, which is no key of a cache")
    file = Cache(path.absolute().parent.parent).folder("denoiser", key) / MODEL
    if not file.is_file():
        raise CheckpointError(f"{path}: its trained denoiser {key} is no longer in the cache; run it again")
    return read_arrays(file.read_bytes())


def _opened(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file; give a file that planner.save(...) wrote, or a run's folder")
    try:
        with zipfile.ZipFile(path) as file:
            _check_entries(file, path)
            return json.loads(file.read(DESCRIPTION)), read_arrays(file.read(ARRAYS))
    except (zipfile.BadZipFile, json.JSONDecodeError, UnicodeDecodeError, SafetensorError, KeyError, OSError,
            RecursionError) as error:  # fmt: skip
        raise CheckpointError(f"{path}: is no planner of dadiff, or damaged ({error})") from error


def _check_entries(file: zipfile.ZipFile, path: Path) -> None:
    names = {entry.filename for entry in file.infolist()}
    if names != {DESCRIPTION, ARRAYS}:
        raise CheckpointError(f"{path}: holds {', '.join(sorted(names))[:80]}; expected {DESCRIPTION} and {ARRAYS}")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in file.infolist()):
        raise CheckpointError(f"{path}: is compressed, which a planner's file never is; save it again")
    if sum(entry.file_size for entry in file.infolist()) > path.stat().st_size:
        raise CheckpointError(f"{path}: declares more bytes than it has; it is damaged")

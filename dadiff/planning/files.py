"""Planners in files: a zip of `planner.json` (what it is made of) and `arrays.safetensors` (its numbers).

A run's folder holds the same two, without the weights, which lie in the store's cache. The zip holds the weights, the
robot's set and coordinates, and needs neither demonstrations nor the folder that it was trained in. Loading it executes
nothing: see `dadiff.planning.codec`; the files as such: `dadiff.store.planners`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save as write_arrays

from dadiff import __version__
from dadiff.denoisers.checkpoints import fill
from dadiff.errors import CheckpointError
from dadiff.planning.codec import Decoder, Encoder
from dadiff.planning.planner import Parts, Planner
from dadiff.store.planners import ARRAYS, DESCRIPTION, WEIGHTS, read_file, read_folder, write_file

FORMAT = 1
RUNTIME = ("denoiser", "device")  # fields of a planner that are stored by other means, or not


def save(planner: Planner, path: Path) -> Path:
    """Write a planner whole, by renaming it into place.

    Raises:
        CheckpointError: if a part of it cannot be stored, or the place cannot be written to.
    """
    description, arrays = described(planner)
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in planner.denoiser.state_dict().items()}
    return write_file(path, description, arrays | {WEIGHTS + name: weight.numpy() for name, weight in weights.items()})


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
    description, arrays = read_folder(path) if path.is_dir() else read_file(path)
    return planner_of(description, arrays, str(path), components, device)


def planner_of(
    description: Mapping[str, Any], arrays: Mapping[str, np.ndarray], where: str, components: Sequence[str], device: str
) -> Planner:
    """The planner that is described, with the weights among the arrays."""
    _check_format(description, where)
    decode = Decoder(arrays, where, components)
    try:
        parts = {name: decode(plain) for name, plain in description["planner"].items()}
        decode.check(Planner, {name: part for name, part in parts.items() if name != "denoiser"})
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

"""Files of weights: safetensors with a typed description in the header, so that loading executes nothing.

Files are written beside their place and renamed: a reader finds the old one or the new one, never half of one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dadiff.denoisers.description import Description, describe, require_equal
from dadiff.denoisers.learned import NetworkDenoiser
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import CheckpointError, StoreError
from dadiff.trajectory import Layout, TrajectoryLayout

CHECKSUM = "sha256"


def save(denoiser: NetworkDenoiser, path: Path) -> None:
    """Store a denoiser's weights, its scaling of E and its description."""
    write(path, denoiser.state_dict(), denoiser.description)


def load(
    path: Path, recipe: Recipe, layout: TrajectoryLayout, condition: Layout, schedule: Schedule
) -> NetworkDenoiser:
    """The stored denoiser.

    Raises:
        CheckpointError: if the file is missing or damaged, or made by another recipe, for other sizes or
            under another schedule.
    """
    tensors = read(path, describe(recipe, layout, condition, schedule))
    denoiser = recipe.build(layout, condition, schedule, torch.Generator())
    fill(denoiser.state_dict(), tensors, path)
    return denoiser


def write(path: Path, tensors: Mapping[str, Tensor], description: Description) -> None:
    """Store named tensors and their description, by renaming a whole file into place."""
    temporary = path.with_name(f".{path.name}.partial")  # one name: what a killed writer left is overwritten
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    temporary.unlink(missing_ok=True)
    metadata = {"dadiff": json.dumps(description), CHECKSUM: checksum(contiguous)}
    try:
        save_file(contiguous, temporary, metadata=metadata)
    except SafetensorError as error:
        raise StoreError(f"{path}: cannot be written ({error})") from error
    temporary.replace(path)


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and values, in hex."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {_kind(tensor)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def read(path: Path, expected: Description) -> dict[str, Tensor]:
    """The tensors of a file whose description is the expected one."""
    try:
        with safe_open(path, framework="pt") as file:
            require_equal(_description(file.metadata(), path), expected, str(path))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if file.metadata().get(CHECKSUM) != checksum(tensors):
                raise CheckpointError(f"{path}: differs from its checksum; delete it and train again")
            return tensors
    except (SafetensorError, OSError) as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else "truncated or damaged"
        raise CheckpointError(f"{path}: cannot be read as safetensors ({reason}); delete it and train again") from error


def _description(metadata: Mapping[str, str] | None, path: Path) -> Mapping[str, object]:
    try:
        description = json.loads((metadata or {})["dadiff"])
    except (KeyError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{path}: holds no description; it was not written by dadiff, train again") from error
    if not isinstance(description, dict):
        raise CheckpointError(f"{path}: its description is a {type(description).__name__}, expected an object")
    return description


def fill(places: Mapping[str, Tensor], tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy stored tensors into existing ones of the same names, shapes and types.

    Raises:
        CheckpointError: naming the first tensor that is missing or differs.
    """
    for name, place in places.items():
        found = _kind(tensors[name]) if name in tensors else "missing"
        if found != _kind(place):
            raise CheckpointError(f"{path}: tensor {name} is {found}, expected {_kind(place)}; train again")
    with torch.no_grad():
        for name, place in places.items():
            place.copy_(tensors[name])


def _kind(tensor: Tensor) -> str:
    return f"{tensor.dtype} {tuple(tensor.shape)}"

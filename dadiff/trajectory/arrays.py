"""The few operations that numpy and torch spell differently."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

Array = Any  # numpy.ndarray or torch.Tensor
Held = TypeVar("Held")


def stack(arrays: Sequence[Array], axis: int) -> Array:
    """A new dimension from a sequence of equal shapes."""
    if isinstance(arrays[0], np.ndarray):
        return np.stack(arrays, axis)
    import torch

    return torch.stack(list(arrays), axis)


def join(arrays: Sequence[Array], axis: int) -> Array:
    """One after the other along a dimension."""
    if isinstance(arrays[0], np.ndarray):
        return np.concatenate(list(arrays), axis)
    import torch

    return torch.cat(list(arrays), axis)


def solve(A: Array, b: Array) -> Array:
    """A^-1 b for A (..., k, k) and b (..., k, q)."""
    if isinstance(A, np.ndarray):
        return np.linalg.solve(A, b)
    import torch

    return torch.linalg.solve(A, b)


def contiguous(array: Array) -> Array:
    """The same in the order of its dimensions, which makes many small products fast."""
    return np.ascontiguousarray(array) if isinstance(array, np.ndarray) else array.contiguous()


def like(held: Held, array: Array) -> Held:
    """Numpy arrays, or a dataclass of them, as tensors of an array's type and place; unchanged beside numpy arrays."""
    if isinstance(array, np.ndarray):
        return held
    if isinstance(held, np.ndarray):
        import torch

        floating = np.issubdtype(held.dtype, np.floating)
        return torch.tensor(held, dtype=array.dtype if floating else None, device=array.device)  # type: ignore[return-value]
    if isinstance(held, tuple):
        return tuple(like(part, array) for part in held)  # type: ignore[return-value]
    if is_dataclass(held) and not isinstance(held, type):
        converted = copy.copy(held)
        for f in fields(held):
            if (there := like(getattr(held, f.name), array)) is not getattr(held, f.name):
                object.__setattr__(converted, f.name, there)
        return converted
    return held

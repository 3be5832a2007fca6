"""Explicit random generators, derived from one root seed and a role.

Two roles never share a stream, so that changing how many numbers one part draws moves no
other part: the noise of the sampler stays the same whatever the data set's size.
Library code never touches global random state.
"""

from __future__ import annotations

import zlib
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from dadiff.errors import ConfigError

if TYPE_CHECKING:
    import torch


def _sequence(seed: int, role: str) -> np.random.SeedSequence:
    if seed < 0:
        raise ConfigError(f"seed of {role}: is {seed}; it must not be negative")
    return np.random.SeedSequence(entropy=seed, spawn_key=(zlib.crc32(role.encode()),))


def numpy_generator(seed: int, role: str) -> np.random.Generator:
    """The generator of one role (``"demonstrations"``, ``"recording"``, ...) under a root seed."""
    return np.random.default_rng(_sequence(seed, role))


def torch_generator(seed: int, role: str) -> torch.Generator:
    """As `numpy_generator`, for torch. It lives on the CPU, so that every device gets the same noise."""
    import torch

    return torch.Generator().manual_seed(_state(seed, role) >> 1)


@lru_cache(maxsize=1024)
def _state(seed: int, role: str) -> int:
    return int(_sequence(seed, role).generate_state(1, np.uint64)[0])

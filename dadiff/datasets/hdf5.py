"""HDF5 files of offline reinforcement learning: Minari's episodes and D4RL's flat arrays.

Minari has a group for each episode, with `observations` (T+1, n) and `actions` (T, m); D4RL has `observations` (N, n),
`actions` (N, m) and says where episodes end in `terminals` and `timeouts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dadiff.datasets.tables import ENDS, INPUTS, STATES, STEPS, TIMES, Arrays
from dadiff.errors import ConfigError, DataError
from dadiff.memory import available, in_words
from dadiff.outside import regular

FLAGS = ("terminals", "timeouts", "terminations", "truncations")


def from_hdf5(file: Path, beside: Sequence[str] = ()) -> list[Arrays]:
    """The arrays of each episode, or of all in one with the rows at which they end.

    Args:
        beside: names of arrays that are read, too.

    Raises:
        ConfigError: if h5py is not installed.
        DataError: if it cannot be read, or holds observations of several kinds.
    """
    try:
        import h5py
    except ImportError as error:
        raise ConfigError(f"{file}: needs h5py; pip install 'dadiff[hdf5]'") from error
    try:
        with h5py.File(regular(file), "r") as content:
            episodes = sorted((name for name in content if name.startswith("episode_")), key=_number)
            parts = {f"{file}: {name}": _inside(content, name, str(file)) for name in episodes} or {str(file): content}
            return [_arrays(part, where, beside) for where, part in parts.items()]
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise DataError(f"{file}: cannot be read as HDF5 ({' '.join(str(error).split())})") from error


def _number(name: str) -> tuple[int, str]:
    digits = name.removeprefix("episode_")
    return (int(digits) if digits.isdigit() else 0, name)


def _arrays(group: Any, where: str, beside: Sequence[str]) -> dict[str, np.ndarray]:
    wanted = (*STATES, *INPUTS, *TIMES, *STEPS, ENDS, *FLAGS, *beside)
    found = {name: _read(_inside(group, name, where), f"{where}: {name}") for name in wanted if name in group}
    flags = [np.ravel(found.pop(name)).astype(bool) for name in FLAGS if name in found]
    states = next((found[name] for name in STATES if name in found), None)
    if flags and states is not None and states.ndim > 1 and {len(states)} == {len(flag) for flag in flags}:
        ends = np.flatnonzero(np.logical_or.reduce(flags)) + 1
        found[ENDS] = np.union1d(ends, [len(states)])
    return found


def _inside(group: Any, name: str, where: str) -> Any:
    """A member of the file itself.

    Raises:
        DataError: if it lies in another file, by links, a virtual array or external storage.
    """
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.ExternalLink):
        node = group[name]
        elsewhere = isinstance(node, h5py.Dataset) and (node.is_virtual or node.external)
        if not elsewhere and node.file.filename == group.file.filename:
            return node
    raise DataError(f"{where}: {name} lies in another file; write one file that holds what it needs")


def _read(node: Any, where: str) -> np.ndarray:
    """An array, its size judged before it is read.

    Raises:
        DataError: if it is a group of arrays, or does not fit into memory.
    """
    if not hasattr(node, "dtype"):
        inside = ", ".join(node)
        raise DataError(f"{where} is a group of {inside}; dadiff takes one array: write out the one that is the state")
    if node.shape is None:
        raise DataError(f"{where} is empty; expected an array of numbers")
    if (size := node.size * node.dtype.itemsize) > available():
        raise DataError(f"{where} holds {in_words(size)}, {in_words(available())} of memory are there")
    return np.asarray(node[()])

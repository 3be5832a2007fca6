"""Recordings and demonstrations as people have them: files, as runs of states (S+1, n) and inputs (S, m).

What can be read in one way only is taken: a trailing axis of one, a batch axis, integers, switches, as many states as
inputs (the last input has no next state and is dropped), several episodes in one file, which `episode_ends` or a column
separates, or time stamps that jump. Everything else is refused with the remedy.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from dadiff.datasets.tables import ENDS, INPUTS, STATES, STEPS, TIMES, Arrays, Columns, from_table
from dadiff.errors import DataError
from dadiff.outside import digest_of, npz
from dadiff.systems import System

TABLES, HDF5 = (".csv", ".parquet"), (".hdf5", ".h5")
ENDINGS = (".npz", *TABLES, *HDF5)

UNEVEN, JUMP = 0.1, 1.5
"""By what share of the usual step time stamps may differ, and from how many steps on a sample is missing."""

UNITS_OF_TIME = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}

Run = tuple[np.ndarray, np.ndarray]

MOST_SAID = 3
"""How often the same is said of the files of a folder."""

log = logging.getLogger(__name__)


@contextmanager
def saying(most: int = MOST_SAID) -> Iterator[None]:
    """While many files are read: the same is said of a few of them only, and then of how many more it holds."""
    said = Counter[str]()

    def first_ones(record: logging.LogRecord) -> bool:
        said[record.msg] += 1
        return said[record.msg] <= most

    log.addFilter(first_ones)
    try:
        yield
    finally:
        log.removeFilter(first_ones)
    if more := sum(count - most for count in said.values() if count > most > 0):
        log.warning("... and so on, %d times more", more)


def list_logs(folder: Path) -> list[Path]:
    """The files of a folder that hold recordings, sorted by name; where it has none itself, those below its `data`.

    Raises:
        DataError: if the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder; expected a folder of {', '.join(ENDINGS)} files")
    files = sorted(file for file in folder.iterdir() if file.suffix in ENDINGS)
    files = files or sorted(file for file in (folder / "data").rglob("*") if file.suffix in ENDINGS)
    if not files:
        raise DataError(f"{folder}: holds no file that ends in {', '.join(ENDINGS)}; expected at least one")
    return files


def content_of(folder: Path) -> str:
    """A hash of the names and contents of all files below a folder that hold recordings or demonstrations."""
    return digest_of(sorted(file for file in folder.rglob("*") if file.suffix in ENDINGS), folder)


def read_runs(file: Path, system: System, columns: Columns | None) -> list[Run]:
    """The runs in a file, each states (S+1, n) and inputs (S, m) in float64.

    Args:
        columns: of a table, which are `states` and which are `inputs`, and which one is the `episode` or the `time`.

    Raises:
        DataError: naming the file, the array, what was found and what was expected.
    """
    return [run for arrays in arrays_of(file, columns) for run in runs_of(arrays, str(file), system)]


def arrays_of(file: Path, columns: Columns | None, beside: Sequence[str] = ()) -> list[Arrays]:
    """What a file holds under the names that are known here, and `beside`: one mapping for each of its parts.

    Raises:
        DataError: if it cannot be read, or does not say what is what.
    """
    if file.suffix in HDF5:
        from dadiff.datasets.hdf5 import from_hdf5

        return from_hdf5(file, beside)
    return [_from_npz(file, beside)] if file.suffix == ".npz" else from_table(file, columns)


def runs_of(arrays: Arrays, where: str, system: System, beside: Sequence[str] = ()) -> list[Run]:
    """The runs in arrays that are called as in a file; see `read_runs`.

    Args:
        beside: names of arrays of n numbers for the file, for each run or for each state; those that are there follow
            the states as n more columns each.
    """
    states = _plain(where, arrays, STATES, system.state_dim)
    inputs = _plain(where, arrays, INPUTS, system.input_dim)
    stamps = _time_stamps(where, arrays, (states.shape[-2], inputs.shape[-2]), system.time_step)
    said = [int(end) for end in np.ravel(_finite(where, ENDS, arrays[ENDS]))] if ENDS in arrays else []
    more = [_a_state(where, name, arrays, states, said) for name in beside if name in arrays]
    together = np.concatenate([states, *more], axis=-1)
    runs = [_paired(where, x, u) for x, u in _batches(where, together, inputs)]
    if not (runs := _episodes(where, runs, _ends(where, said, stamps))):
        raise DataError(f"{where}: no episode has two states; expected runs of at least one step")
    return runs


def _from_npz(file: Path, beside: Sequence[str]) -> dict[str, np.ndarray]:
    wanted, found = (*STATES, *INPUTS, *TIMES, *STEPS, ENDS, *beside), dict[str, np.ndarray]()
    with npz(file) as archive:
        names = [str(name) for name in archive.files]
    if not set(names) & set(STATES) and "y" in names:
        raise DataError(f"{file}: holds inputs and outputs y; states are needed, input-output data are not offered")
    for name in names:
        if name in wanted:
            with npz(file, f"array {name}") as archive:
                found[name] = np.asarray(archive[name])
    if not found:
        raise DataError(f"{file}: has no array states or observations; found {', '.join(names) or 'none'}")
    return found


def _plain(where: str, arrays: Arrays, names: Sequence[str], size: int) -> np.ndarray:
    """An array of numbers (..., rows, size) in float64."""
    name = next((name for name in names if name in arrays), None)
    if name is None:
        raise DataError(f"{where}: has no array {' or '.join(names[:2])}; found {', '.join(arrays) or 'none of use'}")
    values = _real(where, name, arrays[name])
    if values.ndim == 1 and size == 1:
        values = values[:, None]
    if values.ndim == 3 and values.shape[-1] == 1 and values.shape[-2] == size:
        values = values[..., 0]
    if values.ndim not in (2, 3) or values.shape[-1] != size:
        turned = values.ndim == 2 and values.shape[0] == size
        what = "states" if names == STATES else "inputs"
        remedy = "; transpose it?" if turned else f"; the system has {size} {what}: choose which, or another system"
        raise DataError(f"{where}: array {name} has shape {values.shape}; expected (any, {size}){remedy}")
    return _finite(where, name, values)


def _finite(where: str, name: str, values: np.ndarray) -> np.ndarray:
    """Numbers as float64, every one of them finite."""
    values = _real(where, name, values)
    if not np.isfinite(values).all():
        cut = "cut there into episodes (episode_ends), without that row"
        at = f", first in row {np.argwhere(~np.isfinite(values))[0][-2]}; {cut}" if values.ndim > 1 else ""
        raise DataError(f"{where}: array {name} holds a value that is not finite{at}")
    return values


def _real(where: str, name: str, values: np.ndarray) -> np.ndarray:
    """Numbers or switches as float64."""
    if values.dtype.kind not in "fiub":
        raise DataError(f"{where}: array {name} holds {values.dtype}; expected real numbers")
    return values.astype(np.float64)


def _a_state(where: str, name: str, arrays: Arrays, states: np.ndarray, ends: Sequence[int]) -> np.ndarray:
    """A state of the file (n,), of each run or episode (count, n), or of each row, as rows beside the states."""
    values, n = _finite(where, name, arrays[name]), states.shape[-1]
    if states.ndim == 3 and values.shape == (len(states), n):
        values = values[:, None]
    elif ends and values.shape == (len(ends), n):
        values = values[np.searchsorted(ends[:-1], np.arange(len(states)), side="right")]
    elif values.shape not in ((n,), states.shape):
        raise DataError(f"{where}: array {name} has shape {values.shape}; expected ({n}), of all, each run or each row")
    return np.broadcast_to(values, states.shape)


def _batches(where: str, states: np.ndarray, inputs: np.ndarray) -> list[Run]:
    if states.ndim != inputs.ndim or (states.ndim == 3 and len(states) != len(inputs)):
        raise DataError(f"{where}: states have shape {states.shape}, inputs {inputs.shape}; expected the same runs")
    return list(zip(states, inputs, strict=True)) if states.ndim == 3 else [(states, inputs)]


def _paired(where: str, states: np.ndarray, inputs: np.ndarray) -> Run:
    if len(states) == len(inputs):
        log.info("%s: as many states as inputs; the last input, whose next state is not there, is dropped", where)
        inputs = inputs[:-1]
    if len(states) != len(inputs) + 1 or len(inputs) < 1:
        raise DataError(
            f"{where}: has {len(states)} states and {len(inputs)} inputs; expected one state more, or as many, and at "
            "least two states"
        )
    return states, inputs


def _ends(where: str, said: list[int], stamps: np.ndarray | None) -> list[int]:
    """The rows before which an episode ends: as said, and where time jumps or starts anew."""
    if stamps is None or len(stamps) < 3:
        return said
    steps = np.diff(stamps)
    usual = float(np.median(steps))
    jumps = [int(k) + 1 for k in np.flatnonzero((steps <= 0) | (steps > JUMP * usual)) if k + 1 not in said]
    if not jumps:
        return said
    log.warning(
        "%s: its time stamps jump before row %s: cut there into episodes",
        where,
        ", ".join(map(str, jumps[:5])) + (", ..." if len(jumps) > 5 else ""),
    )
    return sorted({*said, *jumps, len(stamps)})


def _episodes(where: str, runs: list[Run], places: list[int]) -> list[Run]:
    """Cut where an episode ends: the step from its last state to the next one's first is none of the system's."""
    if not places:
        return runs
    if len(runs) != 1:
        raise DataError(f"{where}: has {len(runs)} runs along a batch axis, and {ENDS}; give one or the other")
    states, inputs = runs[0]
    if sorted(set(places)) != places or not places[0] > 0 or places[-1] > len(states):
        raise DataError(f"{where}: {ENDS} is {places[:6]}; expected rising numbers of rows, at most {len(states)}")
    starts = [0, *places[:-1], *(end for end in places[-1:] if end < len(inputs))]
    cut = [(states[a:b], inputs[a : b - 1]) for a, b in pairwise(starts)]
    cut.append((states[starts[-1] :], inputs[starts[-1] :]))
    return [(x, u) for x, u in cut if len(u)]


def _time_stamps(where: str, arrays: Arrays, rows: Sequence[int], time_step: float | None) -> np.ndarray | None:
    """The time stamps (rows,), if there are any; refuses another time step than the system's, says uneven ones.

    Raises:
        DataError: if there are not as many as rows of states or inputs, or the usual step is not the system's.
    """
    stamps = next((_stamps(where, name, arrays[name], rows) for name in TIMES if name in arrays), None)
    told = [np.ravel(_finite(where, name, arrays[name])) for name in STEPS if name in arrays]
    told += [np.ravel(np.diff(stamps))] if stamps is not None else []
    for steps in filter(len, told):
        usual = float(np.median(steps))
        odd = np.abs(steps - usual) > UNEVEN * abs(usual)
        if (odd & (steps > 0) & (steps <= JUMP * usual)).any():
            log.warning("%s: its time stamps are uneven, %.3g to %.3g s apart", where, steps.min(), steps.max())
        if time_step is not None and abs(usual - time_step) > 0.01 * time_step:
            units = [f", in {name}?" for k, name in UNITS_OF_TIME.items() if 0.99 < usual / time_step / k < 1.01]
            found = f"its time step is {usual:.4g} s, the system's {time_step:.4g} s{units[0] if units else ''}"
            raise DataError(f"{where}: {found}; set system.time_step to that of the data, or sample them anew")
    return stamps if stamps is not None and stamps.ndim == 1 else None


def _stamps(where: str, name: str, values: np.ndarray, rows: Sequence[int]) -> np.ndarray:
    """Time stamps (rows,), or (runs, rows) of runs along a batch axis, in seconds."""
    if values.dtype.kind == "M":
        values = np.where(np.isnat(values), np.nan, values.astype("datetime64[ns]").astype(np.int64) / 1e9)
    values = _finite(where, name, values)
    values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    if not values.shape or values.ndim > 2 or values.shape[-1] not in rows:
        raise DataError(f"{where}: array {name} has shape {values.shape}; expected ({rows[0]},), one for each state")
    return values


def side_by_side(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray]:
    """Runs of different lengths as (count, S+1, n) and (count, S, m), S that of the longest; nan after a run's end."""
    S = max(len(inputs) for _, inputs in runs)
    states, inputs = (
        np.stack([np.pad(run[k], ((0, S + 1 - k - len(run[k])), (0, 0)), constant_values=np.nan) for run in runs])
        for k in (0, 1)
    )
    return states, inputs

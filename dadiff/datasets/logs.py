"""Recordings as people have them: .npz, .csv or .parquet files, as runs of states (S+1, n) and inputs (S, m).

What can be read in one way only is taken: a trailing axis of one, a batch axis, integers, switches, as many states as
inputs (the last input has no next state and is dropped), several episodes in one file that `episode_ends` separates.
Everything else is refused with the remedy.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dadiff.errors import DataError
from dadiff.outside import npz, regular
from dadiff.systems import System

STATES, INPUTS, ENDS = ("states", "observations"), ("inputs", "controls", "actions"), "episode_ends"
TIMES, STEPS = ("time", "times", "t"), ("dt", "time_step")
ENDINGS = (".npz", ".csv", ".parquet")

Columns = Mapping[str, Sequence[str]]
Run = tuple[np.ndarray, np.ndarray]

log = logging.getLogger(__name__)


def list_logs(folder: Path) -> list[Path]:
    """The files of a folder that hold recordings, sorted by name.

    Raises:
        DataError: if the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder; expected a folder of {', '.join(ENDINGS)} files")
    files = sorted(file for file in folder.iterdir() if file.suffix in ENDINGS)
    if not files:
        raise DataError(f"{folder}: holds no file that ends in {', '.join(ENDINGS)}; expected one for each recording")
    return files


def read_runs(file: Path, system: System, columns: Columns | None) -> list[Run]:
    """The runs in a file, each states (S+1, n) and inputs (S, m) in float64.

    Args:
        columns: of a table, which are `states` and which are `inputs`.

    Raises:
        DataError: naming the file, the array, what was found and what was expected.
    """
    arrays = _from_npz(file) if file.suffix == ".npz" else _from_table(file, columns)
    _check_time(file, arrays, system.time_step)
    states = _plain(file, arrays, STATES, system.state_dim)
    inputs = _plain(file, arrays, INPUTS, system.input_dim)
    runs = [_paired(file, x, u) for x, u in _batches(file, states, inputs)]
    return _episodes(file, runs, arrays.get(ENDS))


def _from_npz(file: Path) -> dict[str, np.ndarray]:
    wanted = (*STATES, *INPUTS, *TIMES, *STEPS, ENDS)
    with npz(file) as archive:
        if not set(archive.files) & set(STATES) and "y" in archive.files:
            raise DataError(f"{file}: holds inputs and outputs y; states are needed, input-output data are not offered")
        return {name: np.asarray(archive[name]) for name in archive.files if name in wanted}


def _from_table(file: Path, columns: Columns | None) -> dict[str, np.ndarray]:
    import pandas as pd

    if not columns or {"states", "inputs"} - set(columns):
        raise DataError(f"{file}: say which columns are which: recording.columns={{states: [x, y], inputs: [u]}}")
    try:
        table = pd.read_csv(regular(file)) if file.suffix == ".csv" else pd.read_parquet(regular(file))
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"{file}: cannot be read as a table ({' '.join(str(error).split())})") from error
    table.columns = [str(name).strip().lstrip("# ") for name in table.columns]
    for names in columns.values():
        if missing := [name for name in names if name not in table.columns]:
            raise DataError(f"{file}: has no column {missing[0]!r}; found {', '.join(table.columns)}")
    return {part: table[list(names)].to_numpy() for part, names in columns.items()}


def _plain(file: Path, arrays: Mapping[str, np.ndarray], names: Sequence[str], size: int) -> np.ndarray:
    """An array of numbers (..., rows, size) in float64."""
    name = next((name for name in names if name in arrays), None)
    if name is None:
        raise DataError(f"{file}: has no array {' or '.join(names[:2])}; found {', '.join(arrays) or 'none of use'}")
    values = arrays[name]
    if values.dtype.kind not in "fiub":
        raise DataError(f"{file}: array {name} holds {values.dtype}; expected real numbers")
    if values.ndim == 1 and size == 1:
        values = values[:, None]
    if values.ndim == 3 and values.shape[-1] == 1 and values.shape[-2] == size:
        values = values[..., 0]
    if values.ndim not in (2, 3) or values.shape[-1] != size:
        turned = values.ndim == 2 and values.shape[0] == size
        remedy = "; transpose it?" if turned else ""
        raise DataError(f"{file}: array {name} has shape {values.shape}; expected (any, {size}){remedy}")
    if not np.isfinite(values.astype(np.float64)).all():
        row = int(np.argwhere(~np.isfinite(values.astype(np.float64)))[0][-2])
        raise DataError(f"{file}: array {name} holds a value that is not finite, first in row {row}")
    return values.astype(np.float64)


def _batches(file: Path, states: np.ndarray, inputs: np.ndarray) -> list[Run]:
    if states.ndim != inputs.ndim or (states.ndim == 3 and len(states) != len(inputs)):
        raise DataError(f"{file}: states have shape {states.shape}, inputs {inputs.shape}; expected the same runs")
    return list(zip(states, inputs, strict=True)) if states.ndim == 3 else [(states, inputs)]


def _paired(file: Path, states: np.ndarray, inputs: np.ndarray) -> Run:
    if len(states) == len(inputs):
        log.info("%s: as many states as inputs; the last input, whose next state is not there, is dropped", file)
        inputs = inputs[:-1]
    if len(states) != len(inputs) + 1 or len(inputs) < 1:
        raise DataError(
            f"{file}: has {len(states)} states and {len(inputs)} inputs; expected one state more, or as many"
        )
    return states, inputs


def _episodes(file: Path, runs: list[Run], ends: np.ndarray | None) -> list[Run]:
    """Cut where an episode ends: the step from its last state to the next one's first is none of the system's."""
    if ends is None:
        return runs
    ((states, inputs),) = runs if len(runs) == 1 else [(np.empty((0, 0)), np.empty((0, 0)))]
    places = [int(end) for end in np.ravel(ends)]
    if sorted(set(places)) != places or not places or not places[0] > 0 or places[-1] > len(states):
        raise DataError(f"{file}: {ENDS} is {places[:6]}; expected rising numbers of rows, at most {len(states)}")
    starts, last = [0, *places[:-1]], places[-1] >= len(inputs)
    cut = [(states[a:b], inputs[a : b - 1]) for a, b in zip(starts, places, strict=True)]
    if last:
        cut[-1] = (states[starts[-1] :], inputs[starts[-1] :])
    return [(x, u) for x, u in cut if len(u)]


def _check_time(file: Path, arrays: Mapping[str, np.ndarray], time_step: float | None) -> None:
    """Refuse a file that says another time step than the system's; say where its stamps are uneven."""
    stamps = next((np.ravel(arrays[name]) for name in TIMES if name in arrays), None)
    said = next((float(np.ravel(arrays[name])[0]) for name in STEPS if name in arrays), None)
    if stamps is not None and stamps.dtype.kind in "fiu" and len(stamps) > 1:
        steps = np.diff(stamps.astype(np.float64))
        said = float(np.median(steps)) if said is None else said
        if np.abs(steps - np.median(steps)).max() > 0.1 * abs(np.median(steps)):
            log.warning("%s: its time stamps are uneven, %.3g to %.3g s apart", file, steps.min(), steps.max())
    if said is not None and time_step is not None and abs(said - time_step) > 0.01 * time_step:
        raise DataError(
            f"{file}: its time step is {said:.4g} s, the system's {time_step:.4g} s; sample it anew, or mend one"
        )


def of_one_length(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray]:
    """Runs of different lengths as windows of the shortest one's: (count, S+1, n), (count, S, m). All samples are used.

    Windows of a longer run overlap where its length is no multiple.
    """
    S = min(len(inputs) for _, inputs in runs)
    states, inputs = [], []
    for x, u in runs:
        for start in {min(k * S, len(u) - S) for k in range(-(-len(u) // S))}:
            states.append(x[start : start + S + 1])
            inputs.append(u[start : start + S])
    return np.stack(states), np.stack(inputs)

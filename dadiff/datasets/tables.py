"""Tables: .csv and .parquet files and data frames, one row a time step, columns by name.

Of LeRobot's episodes (`observation.state`, `action`, `episode_index`, `timestamp`) nothing needs to be said.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dadiff.errors import DataError
from dadiff.memory import available, in_words
from dadiff.outside import regular

if TYPE_CHECKING:
    import pandas as pd

STATES, INPUTS, ENDS = ("states", "observations"), ("inputs", "controls", "actions"), "episode_ends"
TIMES, STEPS = ("time", "times", "t"), ("dt", "time_step")

LEROBOT = {
    "states": ["observation.state"],
    "inputs": ["action"],
    "episode": ["episode_index"],
    "time": ["timestamp"],
}
PARTS = ("states", "inputs", "episode", "time", "target")
TARGET, START = "target_state", "initial_state"
"""What demonstrations may have besides: where they should go, and where they say that they begin."""

Columns = Mapping[str, str | Sequence[str]]
Arrays = Mapping[str, np.ndarray]


def from_table(file: Path, columns: Columns | None) -> list[Arrays]:
    """The arrays of a table, one mapping for each episode.

    Args:
        columns: which are `states` and which `inputs`; and, if there is one, the `episode`, `time` and `target`.

    Raises:
        DataError: if it is no table, or a column is not said, not there, or holds no numbers.
    """
    return arrays_of_table(_read(regular(file)), columns, str(file))


def arrays_of_table(table: pd.DataFrame, columns: Columns | None, where: str) -> list[Arrays]:
    """As `from_table`, of a data frame."""
    table = table.rename(columns=lambda name: str(name).strip().lstrip("#").strip())
    chosen = _chosen(table, columns, where)
    parts = [part for _, part in table.groupby(chosen["episode"], sort=False)] if "episode" in chosen else [table]
    return [_arrays(part, chosen, where) for part in parts]


def _chosen(table: pd.DataFrame, columns: Columns | None, where: str) -> dict[str, list[str]]:
    """Which columns are what.

    Raises:
        DataError: if that is not said, or one is not there.
    """
    if not columns and {"observation.state", "action"} <= set(table.columns):
        columns = {part: names for part, names in LEROBOT.items() if names[0] in table.columns}
    if not columns or {"states", "inputs"} - set(columns):
        raise DataError(
            f"{where}: say which columns are which: recording.columns={{states: [x, y], inputs: [u]}}, of "
            f"demonstrations dataset.columns; found {', '.join(table.columns)}"
        )
    if odd := set(columns) - set(PARTS):
        raise DataError(f"{where}: columns has '{min(odd)}'; expected {', '.join(PARTS)}")
    chosen = {part: [names] if isinstance(names, str) else list(names) for part, names in columns.items()}
    for names in chosen.values():
        if missing := [name for name in names if name not in table.columns]:
            raise DataError(f"{where}: has no column {missing[0]!r}; found {', '.join(table.columns)}")
    return chosen


def _arrays(table: pd.DataFrame, chosen: Mapping[str, Sequence[str]], where: str) -> dict[str, np.ndarray]:
    names = {"states": "states", "inputs": "inputs", "target": TARGET}
    made = {
        name: np.concatenate([_numbers(table, c, where) for c in chosen[part]], -1)
        for part, name in names.items()
        if part in chosen
    }
    return made | ({"time": _seconds(table, chosen["time"][0], where)} if "time" in chosen else {})


def _numbers(table: pd.DataFrame, name: str, where: str) -> np.ndarray:
    """A column as (rows, k): k is 1, or the length of the lists in it.

    Raises:
        DataError: naming the first row that holds no number.
    """
    import pandas as pd

    values = table[name]
    if len(values) and isinstance(values.iloc[0], list | tuple | np.ndarray):
        if len({len(row) for row in values}) > 1:
            raise DataError(f"{where}: column {name!r} holds lists of different lengths; expected one length")
        return np.stack([np.asarray(row, dtype=np.float64) for row in values])
    if values.dtype.kind not in "fiub":
        numbers = pd.to_numeric(values, errors="coerce")
        if (odd := numbers.isna() & values.notna()).any():
            row = int(np.flatnonzero(odd)[0])
            raise DataError(f"{where}: column {name!r} holds {str(values.iloc[row])!r} in row {row}; expected numbers")
        values = numbers
    return values.to_numpy(dtype=np.float64)[:, None]


def _seconds(table: pd.DataFrame, name: str, where: str) -> np.ndarray:
    """Time stamps (rows,): numbers as they are, dates as seconds."""
    import pandas as pd

    values = table[name]
    if values.dtype.kind in "fiu":
        return values.to_numpy(dtype=np.float64)
    try:
        return pd.to_datetime(values).to_numpy().astype("datetime64[ns]").astype(np.int64) / 1e9
    except (ValueError, TypeError) as error:
        raise DataError(f"{where}: column {name!r} holds no times ({' '.join(str(error).split())})") from error


def _read(file: Path) -> pd.DataFrame:
    import pandas as pd

    if (size := file.stat().st_size) > available():
        raise DataError(f"{file}: holds {in_words(size)}, {in_words(available())} of memory are there")
    try:
        if file.suffix == ".parquet":
            return pd.read_parquet(file)
        separator, decimal = _dialect(file)
        return pd.read_csv(file, sep=separator, decimal=decimal, encoding="utf-8-sig")
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"{file}: cannot be read as a table ({' '.join(str(error).split())})") from error


def _dialect(file: Path) -> tuple[str, str]:
    """Separator and decimal mark of a csv: what its header has most of; without commas there, numbers may have them."""
    with file.open(encoding="utf-8-sig", errors="replace") as stream:
        header, row = stream.readline(), stream.readline()
    separator = max(",;\t", key=header.count)
    decimal = "," if separator != "," and re.search(r"\d,\d", row) else "."
    return separator, decimal

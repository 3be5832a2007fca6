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
from dadiff.outside import check_parquet, regular

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

MOST_NAMED = 30

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
    table = table.set_axis([str(name).strip().lstrip("#").strip() for name in table.columns], axis=1)
    chosen = _chosen(table, columns, where)
    if "episode" in chosen and (lost := table[chosen["episode"]].isna().any(axis=1)).any():
        raise DataError(f"{where}: row {int(lost.argmax())} belongs to no episode; take it out, or say to which")
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
            f"demonstrations dataset.columns; found {_few(list(table.columns))}"
        )
    if odd := set(columns) - set(PARTS):
        raise DataError(f"{where}: columns has '{min(odd)}'; expected {', '.join(PARTS)}")
    chosen = {part: [names] if isinstance(names, str) else list(names) for part, names in columns.items()}
    for part, names in chosen.items():
        if not names or (part == "time" and len(names) > 1):
            expected = "one" if part == "time" else "at least one"
            raise DataError(f"{where}: columns.{part} names {len(names)} columns; expected {expected}")
        if missing := [name for name in names if name not in table.columns]:
            raise DataError(f"{where}: has no column {missing[0]!r}; found {_few(list(table.columns))}")
        if twice := [name for name in names if list(table.columns).count(name) > 1]:
            raise DataError(f"{where}: has several columns {twice[0]!r}; give each a name of its own")
    return chosen


def _few(names: Sequence[str]) -> str:
    """Names for a message, the first ones of many."""
    return ", ".join(names[:MOST_NAMED]) + (f", and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")


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
        return _lists(values, f"{where}: column {name!r}")
    if values.dtype.kind not in "fiub":
        numbers = pd.to_numeric(values, errors="coerce")
        if (odd := numbers.isna() & values.notna()).any():
            row = int(np.flatnonzero(odd)[0])
            raise DataError(f"{where}: column {name!r} holds {str(values.iloc[row])!r} in row {row}; expected numbers")
        values = numbers
    return values.to_numpy(dtype=np.float64)[:, None]


def _lists(values: pd.Series, what: str) -> np.ndarray:
    """A column of lists of numbers as (rows, k)."""
    try:
        rows = [np.asarray(row, dtype=np.float64) for row in values]
    except (ValueError, TypeError) as error:
        raise DataError(f"{what} holds lists of something else than numbers ({error})") from error
    if {row.ndim for row in rows} != {1} or len({len(row) for row in rows}) > 1:
        raise DataError(f"{what} holds lists of different lengths, or of lists; expected numbers, as many in each row")
    return np.stack(rows)


def _seconds(table: pd.DataFrame, name: str, where: str) -> np.ndarray:
    """Time stamps (rows,): numbers as they are, or dates."""
    import pandas as pd

    values = table[name]
    if values.dtype.kind in "fiu":
        return values.to_numpy(dtype=np.float64)
    try:
        return pd.to_datetime(values).to_numpy().astype("datetime64[ns]")
    except (ValueError, TypeError) as error:
        raise DataError(f"{where}: column {name!r} holds no times ({' '.join(str(error).split())})") from error


def _read(file: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        if file.suffix == ".parquet":
            check_parquet(file)
            return pd.read_parquet(file)
        if (size := file.stat().st_size) > available():
            raise DataError(f"{file}: holds {in_words(size)}, {in_words(available())} of memory are there")
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

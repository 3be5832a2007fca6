"""The record of a run, `run.json`: what was asked for, how it ended, what was measured.

`Results.write` is its one writer, `read_record` its one reader; everything else has the typed `Record`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from dadiff.store.files import read_json
from dadiff.store.typed import typed

Done = Literal["finished", "diverged", "infeasible", "refused"]
Failure = Literal["failed", "killed", "timeout", "out_of_memory", "interrupted"]
Status = Literal[Done, Failure]

DONE: tuple[Status, ...] = get_args(Done)
"""Statuses that are results (`refused`: the choices exclude one another); a run of any other is done again."""


@dataclass(frozen=True)
class Provenance:
    """Where a result comes from.

    Args:
        started: ISO 8601, in UTC.
        seconds: from its start to its end.
        device: "cpu" or "cuda"; None of a run that gave no result.
        commit: of the source; None of an installed package.
        versions: of what the numbers depend on.
    """

    host: str = ""
    started: str | None = None
    seconds: float = 0.0
    device: str | None = None
    commit: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """All that is known of a run but its tables and arrays.

    Args:
        key: 16 hexadecimal digits, from everything that can change the result.
        name: for people; two runs may share it.
        reason: why there is no result, in one line.
        diverged_step: the diffusion step at which a value left all bounds.
        config: the resolved configuration.
        axes: flat parameters; those that are None do not apply.
        metrics: headline scalars; nan where a value was not finite.
        notes: by topic, what is worth knowing beside the numbers.
        counts: of cases, samples and robots.
        links: kind -> key of what the run was made with.
        files: name -> checksum and size of what lies beside the record; filled in by its writer.
    """

    key: str
    name: str
    status: Status
    reason: str | None = None
    diverged_step: int | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    axes: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    notes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    links: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def is_done(self) -> bool:
        """Whether this is a result."""
        return self.status in DONE

    def to_json(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)


MOST_RESIDUAL = 1.5
"""Of data from files over the noise: what obeys the system has 1."""

ABOUT_DATA = {
    "recording_residual": "the recording's steps are {:.3g} times their noise off the system's",
    "offset_residual": "the recording's offset is none of the system's, whose steps are {:.3g} times their noise off",
    "demonstrations_residual": "the demonstrations' steps are {:.3g} times their noise off the system's",
    "cases_residual": "the test cases' steps are {:.3g} times their noise off the system's",
    "also_in_train": "{:.0f} test cases are also in train",
    "outside_training": "{:.0f} test cases lie far outside of what was learned from",
}
"""Metrics that say whether data can be trusted, and what they say where they are odd."""


def is_odd(metric: str, metrics: Mapping[str, float]) -> bool:
    """Whether a run's data are odd by one of `ABOUT_DATA`: residuals should be 1, counts 0."""
    return metrics.get(metric, 0) > (MOST_RESIDUAL if metric.endswith("_residual") else 0)


def read_record(path: Path) -> Record:
    """The record in a file; fields that this version does not know are left aside.

    Raises:
        DataError: if the file is missing or damaged, or a field is missing or of a wrong type.
        StoreError: if its format is newer than this version reads.
    """
    stored = read_json(path)
    metrics = stored.get("metrics")
    if isinstance(metrics, dict):
        stored["metrics"] = {name: math.nan if value is None else value for name, value in metrics.items()}
    return typed(stored, Record, path)

"""Two reports side by side: whether each number of one lies within the other's interval."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from dadiff.reporting.labels import metric_name, with_interval
from dadiff.reporting.statistics import Estimate
from dadiff.reporting.story import ratio_of

NAMED = 10
"""Numbers outside that are told; all are in the file."""


@dataclass(frozen=True)
class Comparison:
    """One metric of one method in both reports."""

    table: str
    method: str
    metric: str
    here: Estimate
    there: Estimate

    @property
    def within(self) -> bool:
        """Whether the number here lies in the interval there; without one, whether the numbers are the same."""
        if not self.there.low <= self.there.high:
            return self.here.value == self.there.value
        return self.there.low <= self.here.value <= self.there.high


NOTHING: Mapping[str, Any] = {"values": {}}


def comparisons(content: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[Comparison]:
    """Of all means that both reports have: the same table, method and metric."""
    for table, part in content["tables"].items():
        theirs = {row["label"]: row for row in other["tables"].get(table, {"content": {"rows": []}})["content"]["rows"]}
        for row in part["content"]["rows"]:
            for metric in part["content"]["metrics"]:
                here, there = (ratio_of(found, metric, "mean") for found in (row, theirs.get(row["label"], NOTHING)))
                if here and there:
                    yield Comparison(table, row["label"], metric, here, there)


def compared(content: Mapping[str, Any], other: Mapping[str, Any], path: Path) -> list[str]:
    """What to say of both, and a file with every number."""
    found = list(comparisons(content, other))
    if not found:
        return [
            f"Against {other['sweep']}: no number in common; methods there are {_named(other)}, here {_named(content)}"
        ]
    head = ["table", "method", "metric", *(f"{name}_{end}" for name in ("here", "there") for end in ENDS), "within"]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(head)
        for each in found:
            writer.writerow(
                [each.table, each.method, each.metric, *astuple(each.here), *astuple(each.there), each.within]
            )
    outside = [each for each in found if not each.within]
    told = [f"outside: {_told(each)}" for each in outside[:NAMED]]
    more = [f"and {len(outside) - NAMED} more, in {path.name}"] if len(outside) > NAMED else []
    return [
        f"Against {other['sweep']}: {len(found) - len(outside)} of {len(found)} numbers lie within its intervals.",
        *told,
        *more,
    ]


ENDS = ("value", "low", "high")


def _named(content: Mapping[str, Any]) -> str:
    """The first names of methods, for a reader to see in what they differ."""
    labels = dict.fromkeys(row["label"] for part in content["tables"].values() for row in part["content"]["rows"])
    return "; ".join([*list(labels)[:2], "…"] if len(labels) > 2 else labels) or "none"


def _told(each: Comparison) -> str:
    here, there = (with_interval(e.value, e.low, e.high) for e in (each.here, each.there))
    return f"{each.method}, {metric_name(each.metric)}: {here}, there {there}"

"""A report in memory: everything shown, gathered from the evidence before anything is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from dadiff.reporting.aggregation import Evidence, Method
from dadiff.reporting.claims import Claim, Verdict, judge
from dadiff.reporting.definitions import Definition, Item
from dadiff.reporting.sources import ReportedRun

WITHOUT_INTERVALS = ("paths", "diffusion", "chain")
"""Kinds of figures that show single plans or runs."""


@runtime_checkable
class Telling(Protocol):
    """Content of a figure that says in a sentence what was found."""

    @property
    def found(self) -> str: ...


@dataclass(frozen=True)
class Part:
    """A figure or table with its numbers, and what a reader must know of them."""

    item: Item
    content: Any
    facts: str
    notes: list[str]
    runs: list[str]

    @property
    def found(self) -> str:
        """What its numbers say, where it has a sentence for that."""
        return self.content.found if isinstance(self.content, Telling) else ""

    @property
    def empty(self) -> bool:
        """Whether no cell of the sweep has what it shows."""
        return not self.runs


@dataclass(frozen=True)
class Report:
    """What the renderers render."""

    definition: Definition
    evidence: Evidence
    command: str
    verdicts: list[Verdict]
    figures: list[Part]
    tables: list[Part]

    @property
    def again(self) -> str:
        """What a person types to make everything again."""
        return " && ".join(filter(None, (self.evidence.sweep.command, self.command)))

    @property
    def lost(self) -> dict[str, list[ReportedRun]]:
        """Cells without results, by what became of them."""
        groups: dict[str, list[ReportedRun]] = {}
        for cell in self.evidence.sweep.cells:
            if cell.status != "finished":
                groups.setdefault(cell.outcome, []).append(cell)
        return groups


def build(definition: Definition, evidence: Evidence, ledger: list[Claim], command: str) -> Report:
    """Gather the parts that a definition asks for.

    Args:
        command: what a person types to make the report again.
    """
    asked = [claim for claim in ledger if definition.claims is None or claim.id in definition.claims]
    judged = evidence.of(definition.judged)
    return Report(
        definition,
        evidence,
        command,
        [judge(claim, judged) for claim in asked],
        [_part(item, evidence) for item in definition.figures],
        [_part(item, evidence) for item in definition.tables],
    )


def _part(item: Item, evidence: Evidence) -> Part:
    content = item.collect(evidence, **item.options)
    runs = list(dict.fromkeys(content.runs))
    told = facts(evidence, runs, intervals=item.kind not in WITHOUT_INTERVALS)
    usual = getattr(content, "usual", "")
    told += f" Names leave out what most have: {usual}." if usual else ""
    return Part(item, content, told, content.notes, runs)


def facts(evidence: Evidence, runs: list[str], *, intervals: bool = True) -> str:
    """The numbers of seeds, recordings, robots, cases and plans behind a part, and what its intervals cover.

    Args:
        intervals: whether the part shows any.
    """
    shown = [Method(m.axes, [cell for cell in m.finished if cell.key in runs]) for m in evidence.all_methods]
    methods = [method for method in shown if method.cells]
    counts = [method.counts() for method in methods]
    told = [_several(unit, {count.get(name, 0) for count in counts}) for name, unit in COUNTED.items()]
    text = f"{', '.join(filter(None, told))}."
    if not methods:
        return ""
    return f"{text} {_covered(methods)}" if intervals else text


COUNTED = {"training seeds": "training seed", "seeds": "seed", "recordings": "recording", "robots": "robot",
           "cases": "case", "samples": "plan a case"}  # fmt: skip


def _several(name: str, values: set[int]) -> str:
    known = sorted(value for value in values if value)
    unit = name if known == [1] else name.replace(" a ", "s a ") if " a " in name else f"{name}s"
    return f"{' or '.join(map(str, known))} {unit}" if known else ""


def _covered(methods: list[Method]) -> str:
    """What the intervals cover: the levels that were drawn more than once."""
    varied = {level for m in methods for level, size in zip(m.runs.levels, m.runs.cells.shape, strict=True) if size > 1}
    robots = any("robots" in method.counts() for method in methods)
    units = [*sorted(varied), *["robot"] * robots, "case"]
    own = ", each run with cases of its own" if any(m.runs.nested for m in methods) else ""
    if varied & {"seed", "training seed", "run"}:
        return f"95 % intervals from an analysis of variance over {_listed([f'{unit}s' for unit in units])}{own}."
    kind = "training seed" if any("training seeds" in method.counts() for method in methods) else "seed"
    return f"95 % intervals, with one {kind}: they cover {_listed([f'{unit}s' for unit in units])} only."


def _listed(words: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))

"""A report in memory: everything shown, gathered from the evidence before anything is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dadiff.reporting.aggregation import Evidence
from dadiff.reporting.claims import Claim, Verdict, judge
from dadiff.reporting.definitions import Definition, Item
from dadiff.reporting.sources import Cell


@dataclass(frozen=True)
class Part:
    """A figure or table with its numbers, and what a reader must know of them."""

    item: Item
    content: Any
    facts: str
    notes: list[str]
    runs: list[str]

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
    def lost(self) -> list[Cell]:
        """Cells without results."""
        return [cell for cell in self.evidence.sweep.cells if cell.status != "finished"]


def build(definition: Definition, evidence: Evidence, ledger: list[Claim], command: str) -> Report:
    """Gather the parts that a definition asks for.

    Args:
        command: what a person types to make the report again.
    """
    asked = [claim for claim in ledger if definition.claims is None or claim.id in definition.claims]
    return Report(
        definition,
        evidence,
        command,
        [judge(claim, evidence) for claim in asked],
        [_part(item, evidence) for item in definition.figures],
        [_part(item, evidence) for item in definition.tables],
    )


def _part(item: Item, evidence: Evidence) -> Part:
    content = item.collect(evidence, **item.options)
    runs = list(dict.fromkeys(content.runs))
    return Part(item, content, facts(evidence, runs), content.notes, runs)


def facts(evidence: Evidence, runs: list[str]) -> str:
    """The numbers of seeds, robots, cases and plans behind a part, and what its intervals cover."""
    cells = [cell for cell in evidence.sweep.cells if cell.key in set(runs) and cell.status == "finished"]
    if not cells:
        return ""
    counts = [_several(name, {cell.record["counts"].get(key) for cell in cells}) for name, key in COUNTED.items()]
    seeds = {cell.axes.get("seed") for cell in cells}
    trained = any(cell.record["links"].get("denoiser") for cell in cells)
    recordings = {cell.record["links"].get("recording") for cell in cells} - {None}
    counts.append(f"{len(seeds)} {'training ' * trained}seed{'s' * (len(seeds) > 1)}")
    counts += [f"{len(recordings)} recording{'s' * (len(recordings) > 1)}"] if recordings else []
    units = ["robots"] if "robots" in cells[0].record["counts"] else []
    units = (["recordings"] if len(recordings) > len(seeds) else []) + units + ["cases"]
    covered = _covered(len(seeds), trained, " and ".join([", ".join(units[:-1]), units[-1]] if units[1:] else units))
    return f"{', '.join(filter(None, counts))}. {covered}"


COUNTED = {"robot": "robots", "case": "cases", "plan a case": "samples"}


def _several(name: str, values: set[int | None]) -> str:
    known = sorted(value for value in values if value)
    unit = name if known == [1] else name.replace(" ", "s ", 1) if " " in name else f"{name}s"
    return f"{' or '.join(map(str, known))} {unit}" if known else ""


def _covered(seeds: int, trained: bool, units: str) -> str:
    if seeds == 1:
        what = "training seed" if trained else "seed"
        return f"95 % intervals, with one {what}: they cover {units} only."
    few = "; with so few seeds they are rough" if seeds < 5 else ""
    return f"95 % intervals by a bootstrap over seeds, and {units} within them{few}."

"""What a multirun has to do: its cells, each key once, what is done already, and what must be built first.

Free of torch, so that `dry_run=true` answers at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dadiff.running.identity import SHARED, Artefact, Identity, identify
from dadiff.store import Cache, Results, SweptRun


@dataclass(frozen=True)
class PlannedRun:
    """One key of the sweep.

    Args:
        config: the resolved configuration of the first cell with this key.
        copies: how many cells of the sweep resolve to this key.
        status: what is stored under the key, if anything.
    """

    config: dict[str, Any]
    identity: Identity
    copies: int
    status: str | None
    is_done: bool

    def cell(self) -> SweptRun:
        """As a sweep's record names it."""
        return SweptRun(self.identity.key, self.identity.name, self.identity.axes, self.status or "waiting")


@dataclass(frozen=True)
class Preparation:
    """Something that cells share and that is not in the cache yet.

    Args:
        configs: of the cells that need it.
        needs: keys of the preparations that come before it.
    """

    artefact: Artefact
    configs: list[dict[str, Any]]
    needs: frozenset[str]

    @property
    def name(self) -> str:
        """For people."""
        return f"{'train' if self.artefact.kind == 'denoiser' else 'build'} {self.artefact.kind} {self.artefact.key}"


@dataclass(frozen=True)
class Plan:
    """The cells of a multirun in their order, and the preparations, shared ones first."""

    cells: Sequence[PlannedRun]
    preparations: Sequence[Preparation]

    @property
    def waiting(self) -> list[PlannedRun]:
        """The cells that are still to be run."""
        return [cell for cell in self.cells if not cell.is_done]

    def needs(self, cell: PlannedRun) -> frozenset[str]:
        """Keys of the preparations that must end before this cell starts."""
        return frozenset(p.artefact.key for p in self.preparations) & _keys(cell.identity)


def make_plan(configs: Sequence[Mapping[str, Any]]) -> Plan:
    """The plan for resolved configurations, one a cell of the sweep.

    Raises:
        ConfigError: if a configuration is not valid.
        StoreError: if what is stored cannot be read.
    """
    identities = [identify(config) for config in configs]
    copies = Counter(identity.key for identity in identities)
    first: dict[str, tuple[dict[str, Any], Identity]] = {}
    for config, identity in zip(configs, identities, strict=True):
        first.setdefault(identity.key, (dict(config), identity))
    cells = [_planned(*first[key], copies[key]) for key in copies]
    return Plan(cells, _preparations([cell for cell in cells if not cell.is_done]))


def _planned(config: dict[str, Any], identity: Identity, copies: int) -> PlannedRun:
    results = Results(config["output_dir"])
    is_done = results.is_done(identity.key) and not config.get("force")
    return PlannedRun(config, identity, copies, results.status(identity.key), is_done)


def _preparations(cells: Sequence[PlannedRun]) -> list[Preparation]:
    """What trainings need, trainings, test cases; each once, with the configurations of the cells that need it."""
    found: dict[str, Preparation] = {}
    for position in range(len(SHARED)):
        for cell in cells:
            artefact = _artefacts(cell.identity)[position]
            if artefact and (cell.config.get("force") or not _is_cached(cell, artefact)):
                before = {cell.identity.demonstrations.key} if artefact.kind == "denoiser" else set()
                found.setdefault(artefact.key, Preparation(artefact, [], frozenset(found) & before))
                found[artefact.key].configs.append(cell.config)
    return list(found.values())


def _is_cached(cell: PlannedRun, artefact: Artefact) -> bool:
    return Cache(cell.config["output_dir"]).contains(artefact.kind, artefact.key)


def _artefacts(identity: Identity) -> tuple[Artefact | None, ...]:
    """In the order of `SHARED`; an exact denoiser needs no demonstrations."""
    return (identity.demonstrations if identity.denoiser else None, identity.denoiser, identity.cases)


def _keys(identity: Identity) -> set[str]:
    return {artefact.key for artefact in _artefacts(identity) if artefact}


def describe(plan: Plan) -> str:
    """The plan for people: cells with their keys and state, what they share, what would be built."""
    lines = [f"{len(plan.cells)} runs, {len(plan.cells) - len(plan.waiting)} done, {len(plan.waiting)} to run"]
    lines += [f"  {cell.identity.key}  {_state(cell):<8}  {cell.identity.name}{_copies(cell)}" for cell in plan.cells]
    trainings = Counter(cell.identity.denoiser.key for cell in plan.cells if cell.identity.denoiser)
    lines += [f"denoiser {key} is shared by {count} runs" for key, count in trainings.items() if count > 1]
    lines += [f"would {preparation.name}" for preparation in plan.preparations]
    return "\n".join(lines)


def _state(cell: PlannedRun) -> str:
    return "done" if cell.is_done else f"{cell.status}, to run" if cell.status else "to run"


def _copies(cell: PlannedRun) -> str:
    return f"  ({cell.copies} times in the sweep)" if cell.copies > 1 else ""

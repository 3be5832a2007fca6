"""A multirun from its configurations to its summary, whatever runs its jobs.

plan -> store and sweep.json -> MLflow's parent run -> jobs -> failures recorded -> sweep.json, MLflow, summary
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dadiff.launching import jobs
from dadiff.launching.outcome import Outcome
from dadiff.launching.plan import Plan, PlannedCell, Preparation
from dadiff.launching.work import Work
from dadiff.running.identity import digest
from dadiff.store import DONE, Cache, Cell, Results, Sweep, Sweeps
from dadiff.tracking import Tracking, is_tracked

BUILDERS = {"demonstrations": jobs.build_demonstrations, "denoiser": jobs.train, "cases": jobs.build_cases}


@dataclass(frozen=True)
class SweepRun:
    """One start of a sweep.

    Args:
        name: under which it is stored; None makes one from the cells.
        command: what a person types to resume it.
        definition: what it ranges over.
    """

    plan: Plan
    name: str
    command: str
    definition: Mapping[str, str]
    output_dir: Path
    tracking: Tracking

    @classmethod
    def of(cls, plan: Plan, name: str | None, command: str, definition: Mapping[str, str]) -> SweepRun:
        """The run of a plan; its cells share an output folder and a store."""
        config = plan.cells[0].config
        made = f"multirun-{digest(sorted(cell.identity.key for cell in plan.cells))[:8]}"
        output_dir = Path(config["output_dir"]).absolute()
        return cls(plan, name or made, command, definition, output_dir, jobs.tracking_of(config))

    @property
    def folder(self) -> Path:
        """Where the sweep's record and logs lie."""
        return Sweeps(self.output_dir).folder(self.name)

    def is_over(self) -> bool:
        """Whether every cell is done and everything is in MLflow, so that there is nothing to do."""
        if self.plan.waiting or not (self.folder / "sweep.json").is_file():
            return False
        results, uri = Results(self.output_dir), self.tracking.uri
        folders = [self.folder, *(results.folder(cell.identity.key) for cell in self.plan.cells)]
        return not self.tracking.enabled or (
            Sweeps(self.output_dir).read(self.name).cells == self.cells() and all(is_tracked(f, uri) for f in folders)
        )

    def open(self) -> str | None:
        """Write the sweep's record, close what a killed predecessor left in MLflow, open the sweep's run there.

        Raises:
            StoreError: if results cannot be written or the MLflow store is away.
        """
        self.tracking.prepare()
        sweep = self.record(self.cells())
        Sweeps(self.output_dir).write(sweep)
        self.tracking.close_dead(self.output_dir)
        return self.tracking.open_sweep(sweep, self.output_dir)

    def works(self, parent: str | None) -> list[Work]:
        """What is to be done: data sets and trainings first, cells after what they need."""
        return [
            *(self._preparation(preparation, parent) for preparation in self.plan.preparations),
            *(self._run(cell, parent) for cell in self.plan.waiting),
        ]

    def ended(self, cell: PlannedCell, outcome: Outcome) -> None:
        """Record a cell's failure on disk, beside the results of the others."""
        if outcome.status != "finished":
            jobs.record_end(cell.identity, cell.config, outcome.status, outcome.reason or outcome.status)

    def close(self, parent: str | None, outcomes: Mapping[str, Outcome], *, interrupted: bool) -> Sweep:
        """Bring the sweep's record and MLflow up to date. Returns the record."""
        sweep = self.record(self.cells(outcomes, "interrupted" if interrupted else "waiting"))
        Sweeps(self.output_dir).write(sweep)
        self.catch_up(parent)
        self.tracking.close_dead(self.output_dir)
        ended = all(cell.status in DONE for cell in sweep.cells)
        status = "finished" if ended else "interrupted" if interrupted else "failed"
        self.tracking.close_sweep(parent, sweep, self.output_dir, status)
        return sweep

    def catch_up(self, parent: str | None) -> None:
        """Mirror what is done and not in MLflow yet."""
        results, cache, tracking = (
            Results(self.output_dir),
            Cache(self.output_dir),
            replace(self.tracking, parent=parent),
        )
        for cell in self.plan.cells:
            denoiser = cell.identity.denoiser
            if denoiser and cache.contains("denoiser", denoiser.key):
                tracking.log_training(cache.folder("denoiser", denoiser.key))
            if results.is_done(cell.identity.key):
                tracking.log_run(results.read(cell.identity.key))

    def record(self, cells: Sequence[Cell]) -> Sweep:
        """The sweep as stored."""
        return Sweep(self.name, self.command, dict(self.definition), list(cells))

    def cells(self, outcomes: Mapping[str, Outcome] | None = None, unknown: str = "waiting") -> list[Cell]:
        """How each cell stands: as its run says, unless this start of the sweep saw it fail."""
        return [self._cell(planned, outcomes or {}, unknown) for planned in self.plan.cells]

    def _cell(self, planned: PlannedCell, outcomes: Mapping[str, Outcome], unknown: str) -> Cell:
        identity = planned.identity
        outcome = outcomes.get(identity.key)
        if outcome is not None and outcome.status not in DONE:
            return Cell(identity.key, identity.name, identity.axes, outcome.status, outcome.reason)
        results = Results(self.output_dir)
        if not (results.is_done(identity.key) and (outcome is not None or planned.is_done)):
            return Cell(identity.key, identity.name, identity.axes, unknown)
        stored = results.read(identity.key)
        return Cell(identity.key, identity.name, identity.axes, stored.status, stored.record.reason)

    def _preparation(self, preparation: Preparation, parent: str | None) -> Work:
        artefact = preparation.artefact
        function = BUILDERS[artefact.kind]
        log_file = self.folder / "logs" / f"{artefact.kind}-{artefact.key}.log"
        config = _with_parent(preparation.config, parent)
        return Work(
            artefact.key,
            preparation.name,
            function,
            (config,),
            log_file,
            preparation.needs,
            artefact.kind == "denoiser",
        )

    def _run(self, cell: PlannedCell, parent: str | None) -> Work:
        key = cell.identity.key
        config = _with_parent(cell.config, parent)
        log_file = self.folder / "logs" / f"{key}.log"
        return Work(key, cell.identity.name, jobs.run, (config,), log_file, self.plan.needs(cell))


def _with_parent(config: Mapping[str, Any], parent: str | None) -> dict[str, Any]:
    return {**config, "tracking": {**config["tracking"], "parent": parent}}


def summary(sweep: Sweep, skipped: int, folder: Path) -> str:
    """A sweep's end in a few lines: how many cells ended how, and what failed why."""
    counts = Counter(cell.status for cell in sweep.cells)
    ended = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    lines = [f"{sweep.name}: {len(sweep.cells)} cells: {ended}" + (f" ({skipped} were done before)" if skipped else "")]
    lines += [f"  {cell.status}: {cell.name}: {cell.reason}" for cell in sweep.cells if cell.reason]
    if any(cell.status not in DONE for cell in sweep.cells):
        lines.append(f"the same command resumes it, leaving alone what is done: {sweep.command}")
    return "\n".join([*lines, f"record and logs: {folder}"])

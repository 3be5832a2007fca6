"""A multirun from its configurations to its summary, whatever runs its jobs.

plan -> sweep.json -> jobs; beside them MLflow's store, the sweep's mirror, and that of each as it ends -> summary
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from dadiff.launching import jobs
from dadiff.launching.outcome import Outcome
from dadiff.launching.plan import Plan, PlannedRun, Preparation
from dadiff.launching.work import Work
from dadiff.running.digest import digest
from dadiff.store import DONE, Results, StoredRun, Sweep, Sweeps, SweptRun
from dadiff.tracking import Tracking
from dadiff.tracking.client import spared
from dadiff.tracking.content import results_table
from dadiff.tracking.views import short_names


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
        return cls(plan, name or made, command, definition, output_dir, Tracking.of(config, output_dir))

    @property
    def folder(self) -> Path:
        """Where the sweep's record and logs lie."""
        return Sweeps(self.output_dir).folder(self.name)

    def begin(self) -> None:
        """Write the sweep's record, if MLflow's store is not to be refused.

        Raises:
            StoreError: if results cannot be written or the MLflow store is away.
        """
        self.tracking.look()
        Sweeps(self.output_dir).write(self.record(self.cells()))

    def open(self) -> str | None:
        """Make MLflow's store, which takes seconds, and mirror the sweep's record.

        Returns:
            The MLflow run that its runs are nested under.
        """
        with spared(self.name):
            self.tracking.prepare()
            return self.tracking.log_sweep(self.output_dir, self.name)
        return None

    def is_told(self) -> bool:
        """Whether all is done, recorded and mirrored as this start of the sweep would do it, so that nothing is left.

        Raises:
            DataError: if the sweep's record is damaged.
        """
        record = self.record(self.cells())
        if self.plan.waiting or not Sweeps(self.output_dir).holds(record):
            return False
        return self.tracking.mirrors(self.output_dir, self.stored(record), self.name)

    def works(self) -> list[Work]:
        """What is to be done: data sets and trainings first, cells after what they need."""
        return [*map(self._preparation, self.plan.preparations), *map(self._run, self.plan.waiting)]

    def ended(self, cell: PlannedRun, outcome: Outcome) -> None:
        """Record a cell's failure on disk, beside the results of the others."""
        if outcome.status != "finished":
            jobs.record_end(cell.identity, cell.config, outcome.status, outcome.reason or outcome.status)

    def mirror(self, key: str, parent: str | None) -> None:
        """Mirror what ended into MLflow: a cell or a training."""
        if any(preparation.artefact.key == key for preparation in self.plan.preparations):
            self.tracking.log_training(self.output_dir, key)
        elif (results := Results(self.output_dir)).status(key) is not None:
            self.tracking.log_run(results.read(key), parent, self._names[key])

    @cached_property
    def _names(self) -> dict[str, str]:
        """Key of a run -> what its sweep calls it in MLflow."""
        return short_names(self.record([cell.cell() for cell in self.plan.cells]))

    def close(self, outcomes: Mapping[str, Outcome], *, interrupted: bool) -> Sweep:
        """Bring the sweep's record, its table and MLflow up to date. Returns the record."""
        results, sweeps = Results(self.output_dir), Sweeps(self.output_dir)
        sweep = self.record(self.cells(outcomes, "interrupted" if interrupted else "waiting"))
        sweeps.write(sweep)
        results_table(sweep, results).to_csv(sweeps.folder(self.name) / "results.csv", index=False)
        stored = self.stored(sweep)
        with spared(self.name):
            self.tracking.catch_up(self.output_dir, stored, [self.name])
        return sweep

    def stored(self, sweep: Sweep) -> list[StoredRun]:
        """What lies on disk of a sweep's cells, failed ones among them."""
        results = Results(self.output_dir)
        return [results.read(cell.key) for cell in sweep.cells if results.status(cell.key) is not None]

    def record(self, cells: Sequence[SweptRun]) -> Sweep:
        """The sweep as stored."""
        return Sweep(self.name, self.command, dict(self.definition), list(cells))

    def cells(self, outcomes: Mapping[str, Outcome] | None = None, unknown: str = "waiting") -> list[SweptRun]:
        """How each cell stands: as its run says, unless this start of the sweep saw it fail."""
        return [self._cell(planned, outcomes or {}, unknown) for planned in self.plan.cells]

    def _cell(self, planned: PlannedRun, outcomes: Mapping[str, Outcome], unknown: str) -> SweptRun:
        identity = planned.identity
        outcome = outcomes.get(identity.key)
        if outcome is not None and outcome.status not in DONE:
            return SweptRun(identity.key, identity.name, identity.axes, outcome.status, outcome.reason)
        results = Results(self.output_dir)
        if not (results.is_done(identity.key) and (outcome is not None or planned.is_done)):
            return SweptRun(identity.key, identity.name, identity.axes, unknown)
        stored = results.read(identity.key)
        return SweptRun(identity.key, identity.name, identity.axes, stored.status, stored.record.reason)

    def _preparation(self, preparation: Preparation) -> Work:
        artefact = preparation.artefact
        log_file = self.folder / "logs" / f"{artefact.kind}-{artefact.key}.log"
        arguments, trains = (preparation.configs, artefact.kind), artefact.kind == "denoiser"
        return Work(artefact.key, preparation.name, jobs.build, arguments, log_file, preparation.needs, trains)

    def _run(self, cell: PlannedRun) -> Work:
        key = cell.identity.key
        log_file = self.folder / "logs" / f"{key}.log"
        return Work(key, cell.identity.name, jobs.run, (cell.config,), log_file, self.plan.needs(cell))


def summary(sweep: Sweep, skipped: int, folder: Path) -> str:
    """A sweep's end in a few lines: how many cells ended how, and what failed why."""
    counts = Counter(cell.status for cell in sweep.cells)
    ended = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    lines = [f"{sweep.name}: {len(sweep.cells)} runs: {ended}" + (f" ({skipped} were done before)" if skipped else "")]
    lines += [f"  {cell.status}: {cell.name}: {cell.reason}" for cell in sweep.cells if cell.reason]
    if any(cell.status not in DONE for cell in sweep.cells):
        lines.append(f"the same command resumes it, leaving alone what is done: {sweep.command}")
    output_dir = folder.parent.parent
    where = "" if output_dir == Path("outputs").absolute() else f" --output-dir {shlex.quote(str(output_dir))}"
    return "\n".join([*lines, f"record and logs: {folder}", f"report: dadiff-report {shlex.quote(sweep.name)}{where}"])

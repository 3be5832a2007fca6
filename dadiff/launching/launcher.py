"""What every launcher of multiruns does: plan, run what is to be run in its pool, record, sum up."""

from __future__ import annotations

import shlex
import signal
import sys
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from types import FrameType
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from dadiff.commands import in_one_line
from dadiff.errors import DadiffError
from dadiff.launching.composing import Composer
from dadiff.launching.outcome import Outcome
from dadiff.launching.plan import describe, make_plan
from dadiff.launching.pool import Pool
from dadiff.launching.sweep import SweepRun, summary
from dadiff.launching.table import Table
from dadiff.launching.work import Running, Work
from dadiff.running.summary import several_runs
from dadiff.store import DONE, Lease, Sweep, Sweeps, is_read_only
from dadiff.store.names import sweep_name


class SweepLauncher(Launcher):
    """A subclass says with `pool` what runs the jobs; all else is the same for every launcher.

    Attributes:
        sweep: its name; None for the one that it was chosen by, or one made from its cells.
    """

    sweep: str | None

    @abstractmethod
    def pool(self, run: SweepRun, lease: Lease) -> Pool[Any]:
        """What runs the jobs of this start of a sweep, as long as the lease is held."""

    def expect_work(self) -> None:
        """Get ready meanwhile: the first cell is to be run, and the others are not composed yet."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra before its sweeper launches."""
        self.config = config
        self.composer = Composer(hydra_context.config_loader, config)

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the cells. Leaves with exit code 1 if any failed, 130 if interrupted."""
        try:
            code = self._launch(job_overrides)
        except (DadiffError, OSError) as error:
            sys.stderr.write(f"dadiff: error: {in_one_line(error)}\n")
            code = 1
        if code:
            raise SystemExit(code)
        return [JobReturn(overrides=list(cell), status=JobStatus.COMPLETED) for cell in job_overrides]

    def _launch(self, job_overrides: Sequence[Sequence[str]]) -> int:
        configs = map(self.composer.cell, job_overrides)
        first = next(configs)
        if not first.get("dry_run") and make_plan([first]).waiting:
            self.expect_work()
        plan = make_plan([first, *configs])
        name = self._name()
        if plan.cells[0].config.get("dry_run"):
            sys.stdout.write(describe(plan) + "\n")
            return 0
        run = SweepRun.of(plan, name, "dadiff " + shlex.join(sys.argv[1:]), definition(self.config))
        if not plan.waiting and is_read_only(run.output_dir):
            sys.stderr.write(f"{summary(run.record(run.cells()), len(plan.cells), run.folder)}\n")
            return 0
        if run.is_told():
            sys.stderr.write(_said_of_done(len(plan.cells), len(plan.cells)))
            _tell(run, run.record(run.cells()), len(plan.cells))
            return 0
        with Sweeps(run.output_dir).running(run.name) as lease:
            return self._run(run, lease)

    def _name(self) -> str | None:
        """The sweep's, as given or as that of its file, which may lie in a folder; None if it has none."""
        chosen = self.config.hydra.runtime.choices.get("sweeps")
        name = self.sweep or (chosen and str(chosen).replace("/", "-"))
        return sweep_name(name) if name else None

    def _run(self, run: SweepRun, lease: Lease) -> int:
        """Run what is to be run; returns the exit code."""
        skipped = len(run.plan.cells) - len(run.plan.waiting)
        pool = self.pool(run, lease) if run.plan.waiting else None
        run.begin()
        works = run.works()
        watch = Watch(run, Table(sys.stderr, works, skipped))
        interrupted = False
        if skipped:
            sys.stderr.write(_said_of_done(skipped, len(run.plan.cells)))
        try:
            if pool is not None:
                with _terminated_as_interrupt():
                    pool.run(works, watch)
        except KeyboardInterrupt:
            interrupted = True
        watch.close()
        sweep = run.close(watch.outcomes, interrupted=interrupted)
        _tell(run, sweep, skipped)
        return 130 if interrupted else int(any(cell.status not in DONE for cell in sweep.cells))


def _tell(run: SweepRun, sweep: Sweep, skipped: int) -> None:
    """Its runs as a table, how it ended, and where to look."""
    sys.stdout.write(f"{several_runs(run.stored(sweep))}\n")
    sys.stderr.write(f"{summary(sweep, skipped, run.folder)}\n{run.tracking.how_to_look(run.name)}\n")


def _said_of_done(done: int, total: int) -> str:
    if done == total:
        return f"all {total} runs are done already (force=true makes them anew)\n"
    return f"{done} of {total} runs are done already: skipped\n"


class Watch:
    """Follows a sweep's work: draws it, records failures at once; beside it a thread opens and feeds MLflow."""

    def __init__(self, run: SweepRun, table: Table) -> None:
        self.table, self.outcomes = table, dict[str, Outcome]()
        self._run, self._cells = run, {cell.identity.key: cell for cell in run.plan.cells}
        self._uploads, self._uploader = list[Future[None]](), ThreadPoolExecutor(1, "mlflow")
        self._parent = self._uploader.submit(run.open)

    def ended(self, work: Work, outcome: Outcome) -> None:
        """Work ended."""
        self.outcomes[work.key] = outcome
        self.table.ended(work, outcome)
        if work.key in self._cells:
            self._run.ended(self._cells[work.key], outcome)
        self._uploads.append(self._uploader.submit(self._mirror, work.key))

    def _mirror(self, key: str) -> None:
        self._run.mirror(key, self._parent.result())

    def tick(self, running: Sequence[Running]) -> None:
        """Time has passed."""
        self.table.tick(running)

    def close(self) -> None:
        """Wait for what is being mirrored."""
        self.table.close()
        for upload in self._uploads:
            upload.result()
        self._uploader.shutdown()


def definition(config: DictConfig) -> dict[str, str]:
    """What the sweep ranges over and fixes: its file's parameters, and the command's on top."""
    given = (str(override).partition("=") for override in config.hydra.overrides.task)
    params = {str(name): str(value) for name, value in (config.hydra.sweeper.get("params") or {}).items()}
    return params | {name.lstrip("+~"): value for name, _, value in given}


@contextmanager
def _terminated_as_interrupt() -> Iterator[None]:
    """Treat SIGTERM, which batch systems send, as Ctrl-C."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)

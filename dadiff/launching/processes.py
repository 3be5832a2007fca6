"""The Hydra launcher `processes`: a multirun in processes on this machine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from dadiff.launching.launcher import SweepLauncher
from dadiff.launching.process_pool import ProcessPool
from dadiff.launching.sweep import SweepRun
from dadiff.store import Lease

PRELOAD = ("dadiff.launching.preloaded",)


@dataclass(eq=False)
class ProcessesLauncher(SweepLauncher):
    """One process per job; `conf/hydra/launcher/processes.yaml` explains the parameters."""

    workers: int | None = None
    threads: int = 1
    time_limit: float | None = None
    training_threads: int | None = None
    sweep: str | None = None

    def expect_work(self) -> None:
        """The server that jobs are forked from loads while the rest of the sweep is composed."""
        _ = self._pool

    def pool(self, run: SweepRun, lease: Lease) -> ProcessPool:
        """The same for all starts."""
        return self._pool

    @cached_property
    def _pool(self) -> ProcessPool:
        return ProcessPool(self.workers, self.threads, self.time_limit, PRELOAD, self.training_threads)

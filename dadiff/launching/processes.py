"""The Hydra launcher `processes`: a multirun in processes on this machine."""

from __future__ import annotations

from dataclasses import dataclass

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

    def pool(self, run: SweepRun, lease: Lease) -> ProcessPool:
        """Its server starts at once, while the sweep is opened."""
        return ProcessPool(self.workers, self.threads, self.time_limit, PRELOAD, self.training_threads)

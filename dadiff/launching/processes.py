"""The Hydra launcher `processes`: a multirun in processes on this machine."""

from __future__ import annotations

from dadiff.launching.launcher import SweepLauncher
from dadiff.launching.process_pool import ProcessPool
from dadiff.launching.sweep import SweepRun
from dadiff.store import Lease

PRELOAD = (
    *("dadiff.cli", "dadiff.running.experiment", "dadiff.tracking"),
    *("pyarrow.parquet", "pyarrow.pandas_compat", "pydantic.dataclasses"),  # which their users import late
)
"""What most jobs use; not MLflow, which the launcher alone talks to."""


class ProcessesLauncher(SweepLauncher):
    """One process per job; `conf/hydra/launcher/processes.yaml` explains the parameters."""

    def __init__(self, workers: int | None, threads: int, time_limit: float | None, sweep: str | None) -> None:
        super().__init__(sweep)
        self.workers, self.threads, self.time_limit = workers, threads, time_limit

    def pool(self, run: SweepRun, lease: Lease) -> ProcessPool:
        """Its server starts at once, while the sweep is opened."""
        return ProcessPool(self.workers, self.threads, self.time_limit, PRELOAD)

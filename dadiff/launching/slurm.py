"""The Hydra launcher `slurm`: a multirun in the jobs of a Slurm cluster, on a folder that its nodes share."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dadiff.errors import ConfigError, MissingExtraError
from dadiff.launching.launcher import SweepLauncher
from dadiff.launching.pool import GRACE_SECONDS, Pool
from dadiff.launching.sweep import SweepRun
from dadiff.launching.work import Queued, Work, environment, perform
from dadiff.store import Lease, Status
from dadiff.threads import limits

POLL_SECONDS = 1.0  # of files on a shared folder
ASK_SECONDS = 60.0  # between two questions to Slurm, which alone knows of a job that died without a word
MARGIN_MINUTES = 2  # asked for beyond the time limit, which the launcher watches; Slurm's own is the net below
DEATHS: dict[str, Status] = {"FAILED": "failed", "TIMEOUT": "timeout", "OUT_OF_MEMORY": "out_of_memory"}


@dataclass
class SlurmJob(Queued):
    """A job that was handed in: submitit's, or the reason why Slurm did not take it."""

    job: Any
    refusal: str | None = None


class SlurmPool(Pool[SlurmJob]):
    """`workers` Slurm jobs at a time, one a piece of work; `Work.trains` asks nothing of jobs that share no machine.

    Args:
        folder: where submitit keeps its files; all nodes see it.
        cluster: "slurm" or "local".
        asked: what else a job asks for, in submitit's words; None asks for nothing.
        lease: of the launcher; jobs end themselves without it.

    Raises:
        ConfigError: if a number is not positive, or there is no such cluster.
        MissingExtraError: if submitit is not installed.
    """

    def __init__(
        self,
        folder: Path,
        cluster: str,
        workers: int,
        threads: int,
        time_limit: float,
        asked: Mapping[str, Any],
        lease: Lease | None = None,
    ) -> None:
        super().__init__(workers, threads, time_limit)
        self._lease, self._asked = lease, time.monotonic()
        if cluster not in ("slurm", "local"):
            raise ConfigError(f"hydra.launcher: cluster is {cluster}; it must be slurm or local")
        if cluster == "slurm" and shutil.which("srun") is None:
            raise ConfigError("hydra.launcher: no srun on this machine; start the sweep on a node of the Slurm cluster")
        try:
            import submitit
        except ImportError as error:
            raise MissingExtraError(
                "hydra/launcher=slurm: submitit is not installed; install it with: pip install 'dadiff[slurm]'"
            ) from error
        self._executor = submitit.AutoExecutor(folder, cluster=cluster)
        minutes = math.ceil(time_limit / 60) + MARGIN_MINUTES
        step = {"slurm_srun_args": [f"--cpus-per-task={threads}"]}  # which a step does not inherit from its job
        self._executor.update_parameters(timeout_min=minutes, cpus_per_task=threads, **step, **asked)

    def _start(self, work: Work) -> SlurmJob:
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        work.log_file.unlink(missing_ok=True)
        try:
            with environment(limits(self.threads)):
                return SlurmJob(work, self._executor.submit(perform, work, self.threads, self._lease))
        except (FailedJobError, FailedSubmissionError) as error:
            return SlurmJob(work, None, refusal=f"Slurm did not take the job: {' '.join(str(error).split())}")

    def _pause(self, running: Sequence[SlurmJob]) -> None:
        time.sleep(POLL_SECONDS)
        if time.monotonic() - self._asked > ASK_SECONDS:
            self._asked = time.monotonic()
            for entry in [entry for entry in running if entry.refusal is None][:1]:
                entry.job.done(force_check=True)  # one question brings the states of all jobs

    def _end(self, entry: SlurmJob) -> tuple[Status, str | None] | None:
        from submitit.core.utils import UncompletedJobError

        if entry.refusal is not None:
            return "failed", entry.refusal
        if not entry.job.done():
            return None
        try:
            return entry.job.result()
        except UncompletedJobError:
            state = entry.job.state
            reason = f"its job ended without a word, in state {state}; submitit's log: {entry.job.paths.stderr}"
            return DEATHS.get(state, "killed"), reason

    def _stop(self, running: Sequence[SlurmJob]) -> None:
        jobs = [entry.job for entry in running if entry.refusal is None]
        for job in jobs:
            job.cancel(check=False)
        deadline = time.monotonic() + GRACE_SECONDS
        while time.monotonic() < deadline and not all(job.done() for job in jobs):
            time.sleep(POLL_SECONDS)


@dataclass(eq=False)
class SlurmLauncher(SweepLauncher):
    """One Slurm job per job; the parameters are explained in `conf/hydra/launcher/slurm.yaml`."""

    cluster: str = "slurm"
    workers: int = 16
    threads: int = 1
    time_limit: float = 14400.0
    memory: float | None = None
    gpus: int | None = None
    partition: str | None = None
    account: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    sweep: str | None = None

    def pool(self, run: SweepRun, lease: Lease) -> SlurmPool:
        """With submitit's files beside the sweep's logs."""
        asked = {
            "name": "dadiff",
            "mem_gb": self.memory,
            "gpus_per_node": self.gpus,
            "slurm_partition": self.partition,
            "slurm_account": self.account,
            "slurm_additional_parameters": dict(self.options),
        }
        folder = run.folder / "submitit"
        return SlurmPool(folder, self.cluster, self.workers, self.threads, self.time_limit, asked, lease)

"""The Hydra launcher `ray`: a multirun in the tasks of a Ray cluster, on a folder that its nodes share."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dadiff.config.trust import VARIABLE, trusted
from dadiff.errors import ConfigError, MissingExtraError
from dadiff.launching.launcher import SweepLauncher
from dadiff.launching.outcome import Outcome
from dadiff.launching.pool import GRACE_SECONDS, TICK_SECONDS, Pool, check_positive
from dadiff.launching.sweep import SweepRun
from dadiff.launching.work import Observer, Queued, Work, environment, perform
from dadiff.store import Lease, Status
from dadiff.threads import limits


@dataclass
class RayTask(Queued):
    """A task that was handed in.

    Args:
        ref: Ray's reference to its answer.
    """

    ref: Any


class RayPool(Pool[RayTask]):
    """`workers` Ray tasks at a time, each in a process of its own that Ray does not start again if it dies.

    Args:
        address: of a cluster; None starts one on this machine.
        workers: None for as many as the cluster's cores allow.
        time_limit: seconds that a job may take; None for no limit.
        lease: of the launcher; jobs end themselves without it.

    Raises:
        ConfigError: if a number is not positive, or no cluster answers at the address.
        MissingExtraError: if Ray is not installed.
    """

    def __init__(
        self,
        address: str | None,
        workers: int | None,
        threads: int,
        time_limit: float | None,
        lease: Lease | None = None,
    ) -> None:
        check_positive(workers=workers, threads=threads, time_limit=time_limit)
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError(
                "hydra/launcher=ray: Ray is not installed; install it with: pip install 'dadiff[ray]'"
            ) from error
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            with environment(limits(threads)):
                ray.init(
                    address or "local",
                    include_dashboard=False,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    runtime_env={"env_vars": {VARIABLE: ",".join(trusted())}},
                )
        except ConnectionError as error:
            raise ConfigError(f"hydra.launcher: no Ray cluster answers at address {address}") from error
        cores = int(ray.cluster_resources().get("CPU", 1))
        super().__init__(workers or max(1, cores // threads), threads, time_limit)
        self._ray, self._lease = ray, lease
        self._perform: Any = ray.remote(num_cpus=threads, max_retries=0, max_calls=1)(perform)

    def run(self, works: Sequence[Work], observer: Observer) -> dict[str, Outcome]:
        """Run everything, and leave the cluster."""
        try:
            return super().run(works, observer)
        finally:
            self._ray.shutdown()

    def _start(self, work: Work) -> RayTask:
        work.log_file.unlink(missing_ok=True)
        return RayTask(work, self._perform.remote(work, self.threads, self._lease))

    def _pause(self, running: Sequence[RayTask]) -> None:
        self._ray.wait([entry.ref for entry in running], timeout=TICK_SECONDS)

    def _end(self, entry: RayTask) -> tuple[Status, str | None] | None:
        exceptions = self._ray.exceptions
        try:
            return self._ray.get(entry.ref, timeout=0)
        except exceptions.GetTimeoutError:
            return None
        except exceptions.RayError as error:
            reason = f"{type(error).__name__}: {str(error).strip().splitlines()[0]}"
            if isinstance(error, exceptions.OutOfMemoryError):
                return "out_of_memory", reason
            return "failed" if isinstance(error, exceptions.RayTaskError) else "killed", reason

    def _stop(self, running: Sequence[RayTask]) -> None:
        left = [entry.ref for entry in running]
        for ref in left:
            self._ray.cancel(ref)
        if left:
            _, left = self._ray.wait(left, num_returns=len(left), timeout=GRACE_SECONDS)
        for ref in left:
            self._ray.cancel(ref, force=True)


@dataclass(eq=False)
class RayLauncher(SweepLauncher):
    """One Ray task per job; `conf/hydra/launcher/ray.yaml` explains the parameters."""

    address: str | None = None
    workers: int | None = None
    threads: int = 1
    time_limit: float | None = None
    sweep: str | None = None

    def pool(self, run: SweepRun, lease: Lease) -> RayPool:
        """On the cluster at the address, or a new one."""
        return RayPool(self.address, self.workers, self.threads, self.time_limit, lease)

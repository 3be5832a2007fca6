"""One job of a multirun: what it does, how a process does it, and who is told of it."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dadiff.launching.outcome import Outcome, why
from dadiff.store import Lease, Status

LEASE_SECONDS = 5.0  # between two looks at the launcher's lease


@dataclass(frozen=True)
class Work:
    """One job.

    Args:
        function: importable by name, called with `arguments`.
        log_file: where its standard output and error go.
        needs: keys of the work that must have ended well before.
        trains: it gains from threads: it has those of all workers, and so the machine to itself, or what the pool says.
    """

    key: str
    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    log_file: Path
    needs: frozenset[str] = frozenset()
    trains: bool = False


@dataclass
class Running:
    """Work that was started."""

    work: Work
    started: float = field(default_factory=time.monotonic, kw_only=True)

    @property
    def seconds(self) -> float:
        """Since its start."""
        return time.monotonic() - self.started


@dataclass
class Queued(Running):
    """Work that was handed to a cluster, where it may wait; it has begun when its log appears."""

    begun: float | None = field(default=None, kw_only=True)

    @property
    def seconds(self) -> float:
        """Since it began."""
        if self.begun is None and self.work.log_file.exists():
            self.begun = time.monotonic()
        return time.monotonic() - self.begun if self.begun is not None else 0.0


class Observer(Protocol):
    """Is told what happens; see `dadiff.launching.table`."""

    def ended(self, work: Work, outcome: Outcome) -> None:
        """Work ended."""
        ...

    def tick(self, running: Sequence[Running]) -> None:
        """Time has passed."""
        ...


def perform(work: Work, threads: int, lease: Lease | None = None) -> tuple[Status, str | None]:
    """Do the work, in a process of its own. Returns its status, and the reason if it failed.

    Args:
        lease: of the launcher, without which the process ends itself; None if it ends with its launcher anyway.
    """
    _redirect(work.log_file)
    if lease is not None:
        threading.Thread(target=_die_without, args=(lease,), daemon=True).start()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", force=True)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
    try:
        work.function(*work.arguments)
    except Exception as error:  # whatever a job raises is its outcome, and must not stop the others
        traceback.print_exc()
        return why(error)
    return "finished", None


def _die_without(lease: Lease) -> None:
    """A launcher that is killed cannot end its jobs on other machines, and its next start would do their work again."""
    looks_in_vain = 0
    while looks_in_vain < 2:
        time.sleep(LEASE_SECONDS)
        looks_in_vain = 0 if lease.is_held() else looks_in_vain + 1
    os.kill(os.getpid(), signal.SIGKILL)


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set variables for the processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _redirect(log_file: Path) -> None:
    log_file.unlink(missing_ok=True)  # where a link led, nothing is written
    descriptor = os.open(log_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.close(descriptor)

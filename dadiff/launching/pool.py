"""Runs work in processes of its own, several at a time, so that no job can take another with it.

Processes are forked from a server that has imported what takes seconds, so that each starts at once. A job that
raises, is killed, or exceeds its time ends with an `Outcome` that says why; work that needs other work waits for
it without holding a worker.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Protocol

from dadiff.errors import ConfigError
from dadiff.launching.outcome import Outcome, why
from dadiff.store.files import make_folder

GRACE_SECONDS = 5.0
TICK_SECONDS = 0.2
THREAD_LIMITS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")

QUIET = {"PYTHONWARNINGS": "ignore:resource_tracker"}  # which warns of the locks of every job that was ended


@dataclass(frozen=True)
class Work:
    """One job.

    Args:
        function: importable by name, called with `arguments`.
        log_file: where its standard output and error go.
        needs: keys of the work that must have ended well before.
        alone: it has the machine to itself, and the threads of all workers; so does a training.
    """

    key: str
    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    log_file: Path
    needs: frozenset[str] = frozenset()
    alone: bool = False


@dataclass
class Running:
    """A process at work."""

    work: Work
    process: ForkServerProcess
    answer: Connection
    started: float = field(default_factory=time.monotonic)
    timed_out: bool = False

    @property
    def seconds(self) -> float:
        """Since its start."""
        return time.monotonic() - self.started


class Observer(Protocol):
    """Is told what happens; see `dadiff.launching.table`."""

    def ended(self, work: Work, outcome: Outcome) -> None:
        """Work ended."""
        ...

    def tick(self, running: Sequence[Running]) -> None:
        """Time has passed."""
        ...


class Pool:
    """`workers` processes at a time with `threads` threads each.

    Args:
        time_limit: seconds that a job may take; None for no limit.
        preload: modules that the server imports before it forks.

    Raises:
        ConfigError: if a number is not positive.
    """

    def __init__(
        self, workers: int | None, threads: int = 1, time_limit: float | None = None, preload: Sequence[str] = ()
    ) -> None:
        for name, value in (("workers", workers), ("threads", threads), ("time_limit", time_limit)):
            if value is not None and value <= 0:
                raise ConfigError(f"hydra.launcher: {name} is {value}; it must be positive")
        self.workers = workers or max(1, cores() // threads)
        self.threads, self.time_limit = threads, time_limit
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(list(preload))
        _start_server(threads)

    def run(self, works: Sequence[Work], observer: Observer) -> dict[str, Outcome]:
        """Run everything; returns how each ended, by key. Interrupted, it stops what runs and raises again."""
        waiting, running, outcomes = list(works), list[Running](), dict[str, Outcome]()
        self._await_server()
        try:
            while waiting or running:
                waiting = _without_hopeless(waiting, outcomes, observer)
                while len(running) < self.workers and (work := _next(waiting, running, outcomes)):
                    waiting.remove(work)
                    running.append(self._start(work))
                wait([entry.process.sentinel for entry in running], TICK_SECONDS)
                for entry in [entry for entry in running if self._has_ended(entry)]:
                    running.remove(entry)
                    outcomes[entry.work.key] = self._outcome(entry)
                    observer.ended(entry.work, outcomes[entry.work.key])
                observer.tick(running)
        finally:
            stop([entry.process for entry in running])
        return outcomes

    def _await_server(self) -> None:
        """Wait until the server has imported everything, so that no job's time limit counts that."""
        probe = self._context.Process(target=int)
        probe.start()
        probe.join()

    def _start(self, work: Work) -> Running:
        make_folder(work.log_file.parent)
        receive, send = self._context.Pipe(duplex=False)
        threads = self.threads * self.workers if work.alone else self.threads
        process = self._context.Process(target=_main, args=(work, threads, send), name=work.name)
        process.start()
        send.close()
        return Running(work, process, receive)

    def _has_ended(self, entry: Running) -> bool:
        if entry.process.exitcode is None and self.time_limit is not None and entry.seconds > self.time_limit:
            entry.timed_out = True
            stop([entry.process])
        return entry.process.exitcode is not None

    def _outcome(self, entry: Running) -> Outcome:
        status, reason = _answer(entry)
        if entry.timed_out:
            status, reason = "timeout", f"took longer than the time limit of {self.time_limit:g} s"
        if status != "finished":
            reason = f"{reason}; log: {entry.work.log_file}"
        return Outcome(status, reason, entry.seconds)


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def stop(processes: Sequence[ForkServerProcess]) -> None:
    """End processes, kindly first."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + GRACE_SECONDS
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))
        if process.exitcode is None:
            process.kill()
            process.join()


def _start_server(threads: int) -> None:
    """Start the server that jobs are forked from; it inherits the limits on threads of its environment."""
    from multiprocessing import forkserver

    wanted = {**dict.fromkeys(THREAD_LIMITS, str(threads)), **QUIET}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    forkserver.ensure_running()
    for name, value in before.items():
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value


def _next(waiting: Sequence[Work], running: Sequence[Running], outcomes: Mapping[str, Outcome]) -> Work | None:
    """The first work whose needs are met, if nothing stands against starting it now."""
    ready = next((work for work in waiting if work.needs <= outcomes.keys()), None)
    crowded = ready is not None and running and (ready.alone or any(entry.work.alone for entry in running))
    return None if crowded else ready


def _without_hopeless(waiting: Sequence[Work], outcomes: dict[str, Outcome], observer: Observer) -> list[Work]:
    """Give up work that needs what has failed."""
    left = []
    for work in waiting:
        failed = [key for key in sorted(work.needs) if key in outcomes and outcomes[key].status != "finished"]
        if failed:
            outcomes[work.key] = Outcome(
                "failed", f"needs {failed[0]}, which failed: {outcomes[failed[0]].reason}", 0.0
            )
            observer.ended(work, outcomes[work.key])
        else:
            left.append(work)
    return left


def _answer(entry: Running) -> tuple[str, str | None]:
    """What the job said of its end, or what its exit code says in its place."""
    if entry.answer.poll():
        try:
            return entry.answer.recv()
        except EOFError:
            pass  # it ended without a word
    code = entry.process.exitcode or 0
    if code >= 0:
        return "failed", f"its process exited with code {code}"
    name = signal.Signals(-code).name
    memory = ", perhaps because memory ran out: take fewer hydra.launcher.workers" if name == "SIGKILL" else ""
    return "killed", f"killed by {name}{memory}"


def _main(work: Work, threads: int, answer: Connection) -> None:
    """The life of a job's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to handle
    threading.Thread(target=_die_with_launcher, daemon=True).start()
    _redirect(work.log_file)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", force=True)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
    try:
        work.function(*work.arguments)
    except Exception as error:  # whatever a job raises is its outcome, and must not stop the others
        traceback.print_exc()
        answer.send(why(error))
        raise SystemExit(1) from error
    answer.send(("finished", None))


def _die_with_launcher() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGKILL)


def _redirect(log_file: Path) -> None:
    descriptor = os.open(log_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o644)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    os.close(descriptor)

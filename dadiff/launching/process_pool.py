"""Runs work in processes of its own, so that no job can take another with it.

Processes are forked from a server that has imported what takes seconds, so that each starts at once. A job that
raises, is killed, or exceeds its time ends with an `Outcome` that says why.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess

from dadiff.errors import WorkerError
from dadiff.launching.outcome import Outcome
from dadiff.launching.pool import GRACE_SECONDS, TICK_SECONDS, Pool, check_positive
from dadiff.launching.work import Observer, Running, Work, environment, perform
from dadiff.store import Status
from dadiff.threads import cores, limits

SERVER = {
    "PYTHONWARNINGS": "ignore:resource_tracker",  # which warns of the locks of every job that was ended
    "PYTHONSAFEPATH": "1",  # what it imports is what the launcher imports, whatever lies in the current folder
}


@dataclass
class Process(Running):
    """A process at work."""

    process: ForkServerProcess
    answer: Connection


class ProcessPool(Pool[Process]):
    """`workers` processes at a time with `threads` threads each, or fewer where they would exceed the cores.

    Args:
        workers: None for as many as the cores allow.
        training_threads: of each training; None for those of all workers, so that it runs alone.
        time_limit: seconds that a job may take; None for no limit.
        preload: modules that the server imports before it forks.

    Raises:
        ConfigError: if a number is not positive.
    """

    def __init__(
        self,
        workers: int | None,
        threads: int = 1,
        time_limit: float | None = None,
        preload: Sequence[str] = (),
        training_threads: int | None = None,
    ) -> None:
        check_positive(threads=threads, training_threads=training_threads)
        threads = min(threads, max(1, cores() // (workers or 1)))
        super().__init__(cores() // threads if workers is None else workers, threads, time_limit)
        self._all = self.workers * self.threads
        self._training_threads = min(training_threads or self._all, self._all)
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(list(preload))
        _start_server(threads)

    def run(self, works: Sequence[Work], observer: Observer) -> dict[str, Outcome]:
        """Run everything once the server has imported everything, so that no job's time limit counts that."""
        probe = self._context.Process(target=int)
        _fork(probe)
        probe.join()
        return super().run(works, observer)

    def _has_room(self, work: Work, running: Sequence[Process]) -> bool:
        return sum(map(self._claim, [work, *(entry.work for entry in running)])) <= self._all

    def _claim(self, work: Work) -> int:
        """How many threads of all workers it takes."""
        return self._training_threads if work.trains else self.threads

    def _start(self, work: Work) -> Process:
        receive, send = self._context.Pipe(duplex=False)
        threads = min(self._claim(work), cores())
        process = self._context.Process(target=_main, args=(work, threads, send), name=work.name)
        _fork(process)
        send.close()
        return Process(work, process, receive)

    def _pause(self, running: Sequence[Process]) -> None:
        wait([entry.process.sentinel for entry in running], TICK_SECONDS)

    def _end(self, entry: Process) -> tuple[Status, str | None] | None:
        return None if entry.process.exitcode is None else _answer(entry)

    def _stop(self, running: Sequence[Process]) -> None:
        for entry in running:
            entry.process.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        try:
            for entry in running:
                entry.process.join(max(0.0, deadline - time.monotonic()))
        finally:  # a second interrupt does not wait
            for entry in running:
                if entry.process.exitcode is None:
                    entry.process.kill()
                    entry.process.join()


def _start_server(threads: int) -> None:
    """Start the server that jobs are forked from; it inherits the limits on threads of its environment."""
    from multiprocessing import forkserver

    with environment({**limits(threads), **SERVER}), _deaf():
        forkserver.ensure_running()


def _fork(process: ForkServerProcess) -> None:
    """Start a process.

    Raises:
        WorkerError: if the server that it is forked from has died.
    """
    try:
        process.start()
    except (EOFError, ConnectionError) as error:
        raise WorkerError(
            f"launcher: the server that jobs are forked from has died ({str(error) or type(error).__name__}): was it "
            "killed, or memory short? the same command goes on from what is stored"
        ) from error


@contextmanager
def _deaf() -> Iterator[None]:
    """What is started meanwhile ignores Ctrl-C, which is the launcher's to handle."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _answer(entry: Process) -> tuple[Status, str | None]:
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
    answer.send(perform(work, threads))


def _die_with_launcher() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGKILL)

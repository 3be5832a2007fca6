"""Runs work, several pieces at a time, in an order that keeps no worker waiting.

What runs a piece is a subclass's to say: processes of this machine, or the jobs of a cluster. Work that needs other
work waits for it without holding a worker; work that needs what has failed is given up.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Generic, TypeVar

from dadiff.errors import ConfigError
from dadiff.launching.outcome import Outcome
from dadiff.launching.work import Observer, Running, Work
from dadiff.store import Status
from dadiff.store.files import make_folder

GRACE_SECONDS = 5.0
TICK_SECONDS = 0.2

Entry = TypeVar("Entry", bound=Running)


class Pool(ABC, Generic[Entry]):
    """`workers` pieces of work at a time with `threads` threads each.

    Args:
        time_limit: seconds that a job may take; None for no limit.

    Raises:
        ConfigError: if a number is not positive.
    """

    def __init__(self, workers: int, threads: int, time_limit: float | None) -> None:
        check_positive(workers=workers, threads=threads, time_limit=time_limit)
        self.workers, self.threads, self.time_limit = workers, threads, time_limit

    def run(self, works: Sequence[Work], observer: Observer) -> dict[str, Outcome]:
        """Run everything; returns how each ended, by key. Interrupted, it stops what runs and raises again."""
        waiting, running, outcomes = list(works), list[Entry](), dict[str, Outcome]()
        try:
            while waiting or running:
                waiting = _without_hopeless(waiting, outcomes, observer)
                while (work := _ready(waiting, outcomes)) and self._has_room(work, running):
                    waiting.remove(work)
                    make_folder(work.log_file.parent)
                    running.append(self._start(work))
                if running:
                    self._pause(running)
                for entry, outcome in [(entry, outcome) for entry in running if (outcome := self._outcome(entry))]:
                    running.remove(entry)
                    outcomes[entry.work.key] = outcome
                    observer.ended(entry.work, outcome)
                observer.tick(running)
        finally:
            self._stop(running)
        return outcomes

    def _outcome(self, entry: Entry) -> Outcome | None:
        """How it ended; None while it runs. What takes too long is stopped."""
        end = self._end(entry)
        if end is None and self.time_limit is not None and entry.seconds > self.time_limit:
            self._stop([entry])
            end = "timeout", f"took longer than the time limit of {self.time_limit:g} s"
        if end is None:
            return None
        status, reason = end
        return Outcome(status, None if reason is None else f"{reason}; log: {entry.work.log_file}", entry.seconds)

    def _has_room(self, work: Work, running: Sequence[Entry]) -> bool:
        """Whether nothing stands against starting it now."""
        return len(running) < self.workers

    @abstractmethod
    def _start(self, work: Work) -> Entry:
        """Set it going; the folder of its log is there."""

    @abstractmethod
    def _pause(self, running: Sequence[Entry]) -> None:
        """Return when one of them may have ended, but soon."""

    @abstractmethod
    def _end(self, entry: Entry) -> tuple[Status, str | None] | None:
        """Its status and the reason of a failure; None while it runs."""

    @abstractmethod
    def _stop(self, running: Sequence[Entry]) -> None:
        """End them, kindly first."""


def check_positive(**values: float | None) -> None:
    """Refuse a launcher's parameters that are not positive.

    Raises:
        ConfigError: if one is not.
    """
    for name, value in values.items():
        if value is not None and value <= 0:
            raise ConfigError(f"hydra.launcher: {name} is {value}; it must be positive")


def _ready(waiting: Sequence[Work], outcomes: Mapping[str, Outcome]) -> Work | None:
    """The first work whose needs are met."""
    return next((work for work in waiting if work.needs <= outcomes.keys()), None)


def _without_hopeless(waiting: Sequence[Work], outcomes: dict[str, Outcome], observer: Observer) -> list[Work]:
    """Give up work that needs what has failed."""
    left = []
    for work in waiting:
        failed = [key for key in sorted(work.needs) if key in outcomes and outcomes[key].status != "finished"]
        if failed:
            outcomes[work.key] = _given_up(failed[0], outcomes[failed[0]])
            observer.ended(work, outcomes[work.key])
        else:
            left.append(work)
    return left


def _given_up(need: str, outcome: Outcome) -> Outcome:
    """Of work whose need has failed; a need is refused only if all that share it are."""
    if outcome.status == "refused":
        return Outcome("refused", outcome.reason, 0.0)
    return Outcome("failed", f"needs {need}, which failed: {outcome.reason}", 0.0)

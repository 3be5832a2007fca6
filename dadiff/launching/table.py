"""What a person sees of a multirun: on a terminal a table that is drawn again, elsewhere one line an event."""

from __future__ import annotations

import re
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from dadiff.launching.outcome import Outcome
from dadiff.launching.work import Running, Work
from dadiff.store import DONE
from dadiff.store.names import differences

REDRAW_SECONDS = 0.5
SILENT_SECONDS = 60.0
LEAST_NAME, MOST_PROGRESS = 12, 32


class Table:
    """Follows the work of a pool. On a terminal works are called by what differs between them.

    Args:
        works: what there is to do.
        skipped: how many runs were done before.
    """

    def __init__(self, stream: TextIO, works: Sequence[Work], skipped: int) -> None:
        self._stream, self._total, self._skipped = stream, len(works), skipped
        self._names = _names(works)
        self._ended: Counter[str] = Counter()
        self._seconds: list[float] = []
        self._started = time.monotonic()
        self._drawn_at = self._started
        self._lines = 0
        self._live = stream.isatty()

    def ended(self, work: Work, outcome: Outcome) -> None:
        """Say for good how a piece of work ended."""
        self._ended["done" if outcome.status in DONE else "failed"] += 1
        self._clear()
        if not work.trains:
            self._seconds.append(outcome.seconds)
        count = f"[{self._ended.total()}/{self._total}]"
        head = f"{count:>9} {outcome.status:<9} {clock(outcome.seconds):>7}  "
        name = shortened(self._names[work.key], _width() - len(head)) if self._live else work.name
        self._stream.write(f"{head}{name}\n")
        if outcome.reason:
            self._stream.write(f"{'':>28}{outcome.reason}\n")
        self._stream.flush()

    def tick(self, running: Sequence[Running]) -> None:
        """Draw again what runs now: often on a terminal, seldom elsewhere."""
        now = time.monotonic()
        if now - self._drawn_at < (REDRAW_SECONDS if self._live else SILENT_SECONDS):
            return
        self._drawn_at = now
        self._clear()
        lines = [self._summary(running), *map(self._row, running)] if running else []
        self._stream.write("".join(f"{line[: _width()]}\n" for line in lines))
        self._stream.flush()
        self._lines = len(lines) if self._live else 0

    def close(self) -> None:
        """Remove what is drawn for the moment only."""
        self._clear()
        self._stream.flush()

    def _summary(self, running: Sequence[Running]) -> str:
        done, failed = self._ended["done"], self._ended["failed"]
        waiting = self._total - done - failed - len(running)
        parts = {"done": done, "skipped": self._skipped, "failed": failed, "running": len(running), "waiting": waiting}
        counts = ", ".join(f"{count} {what}" for what, count in parts.items() if count)
        left = time_left(self._seconds, [entry.seconds for entry in running if not entry.work.trains], waiting)
        ahead = "" if left is None else f", about {clock(left)} left"
        return f"--- {counts} --- {clock(time.monotonic() - self._started)}{ahead}"

    def _row(self, entry: Running) -> str:
        """How long it runs, what it is, and how far it is: the name gives way."""
        progress = progress_of(last_line(entry.work.log_file))
        head = f"{clock(entry.seconds):>19}  "
        name = shortened(self._names[entry.work.key], _width() - len(head) - len(progress) - 2)
        return f"{head}{name}  {progress}"

    def _clear(self) -> None:
        if self._lines:
            self._stream.write(f"\x1b[{self._lines}A\x1b[J")
            self._lines = 0


def _names(works: Sequence[Work]) -> dict[str, str]:
    """Key -> the name without what all runs have; what is prepared for them keeps its own."""
    runs = [work for work in works if "/" in work.name]
    short = differences([work.name for work in runs]) if runs else []
    told = {work.key: name for work, name in zip(runs, short, strict=True)}
    return {work.key: told.get(work.key, work.name) for work in works}


def _width() -> int:
    return shutil.get_terminal_size().columns - 1


def shortened(name: str, width: int) -> str:
    """A name that fits, without its middle if need be.

    Example:
        >>> shortened("hankel_lowrank/S=100", 13)
        'hankel…/S=100'
    """
    if len(name) <= width:
        return name
    width = max(width, LEAST_NAME)
    return f"{name[: width // 2]}…{name[len(name) - (width - width // 2 - 1) :]}"


def time_left(ended: Sequence[float], running: Sequence[float], waiting: int) -> float | None:
    """Seconds until all is done, were every run as long as those that ended; None before one has."""
    if not ended or not running:
        return None
    mean = sum(ended) / len(ended)
    return (sum(max(0.0, mean - seconds) for seconds in running) + waiting * mean) / len(running)


STAMP = re.compile(r"^\d{4}-\d\d-\d\d [\d:,.]+ ")
BAR = re.compile(r"^(.*?):?\s+(\d+)%\|.*?\|\s*(\S+)\s+\[[\d:?]+<([\d:?]+)")


def progress_of(line: str) -> str:
    """A progress bar in a few letters; of other lines, their beginning.

    Example:
        >>> progress_of("sampling:  42%|####      | 42/100 [00:05<00:07,  8.2it/s]")
        'sampling 42 %, 00:07 left'
    """
    line = STAMP.sub("", line)
    found = BAR.match(line)
    return f"{found[1]} {found[2]} %, {found[4]} left" if found else line[:MOST_PROGRESS]


def last_line(path: Path) -> str:
    """The end of a log, where progress is."""
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 400))
        text = stream.read().decode(errors="replace")
    lines = text.replace("\r", "\n").rstrip().split("\n")
    return "".join(letter for letter in lines[-1] if letter.isprintable()).strip()


def clock(seconds: float) -> str:
    """A duration: 7.3 s, 4:05, 2:10:00."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"

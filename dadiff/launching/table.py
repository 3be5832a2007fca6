"""What a person sees of a multirun: on a terminal a table that is drawn again, elsewhere one line an event."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from dadiff.launching.outcome import Outcome
from dadiff.launching.work import Running, Work
from dadiff.store import DONE

REDRAW_SECONDS = 0.5
SILENT_SECONDS = 60.0


class Table:
    """Follows the work of a pool.

    Args:
        total: how many pieces of work there are.
        skipped: how many cells were done before.
    """

    def __init__(self, stream: TextIO, total: int, skipped: int) -> None:
        self._stream, self._total, self._skipped = stream, total, skipped
        self._ended: Counter[str] = Counter()
        self._started = time.monotonic()
        self._drawn_at = self._started
        self._lines = 0
        self._live = stream.isatty()

    def ended(self, work: Work, outcome: Outcome) -> None:
        """Say for good how a piece of work ended."""
        self._ended["done" if outcome.status in DONE else "failed"] += 1
        self._clear()
        count = f"[{self._ended.total()}/{self._total}]"
        self._stream.write(f"{count:>9} {outcome.status:<9} {clock(outcome.seconds):>7}  {work.name}\n")
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
        width = shutil.get_terminal_size().columns - 1
        lines = [self._summary(len(running)), *map(_row, running)] if running else []
        self._stream.write("".join(f"{line[:width]}\n" for line in lines))
        self._stream.flush()
        self._lines = len(lines) if self._live else 0

    def close(self) -> None:
        """Remove what is drawn for the moment only."""
        self._clear()
        self._stream.flush()

    def _summary(self, running: int) -> str:
        done, failed = self._ended["done"], self._ended["failed"]
        waiting = self._total - done - failed - running
        parts = {"done": done, "skipped": self._skipped, "failed": failed, "running": running, "waiting": waiting}
        counts = ", ".join(f"{count} {what}" for what, count in parts.items())
        return f"--- {counts} --- {clock(time.monotonic() - self._started)}"

    def _clear(self) -> None:
        if self._lines:
            self._stream.write(f"\x1b[{self._lines}A\x1b[J")
            self._lines = 0


def _row(entry: Running) -> str:
    return f"{'running':>19} {clock(entry.seconds):>7}  {entry.work.name}  {last_line(entry.work.log_file)}"


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

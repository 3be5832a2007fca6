"""How every command line ends: what a person can mend is one line, and the exit code says which end it was."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from dadiff.errors import DadiffError

FAILED, INTERRUPTED, UNHEARD = 1, 130, 141
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
COLLECTED_AFTER = 50_000
"""Objects made between two searches for garbage; Python's 700 are passed a thousand times while packages load."""


def reported(program: str, work: Callable[[], int | None]) -> int:
    """Do the work; returns the exit code, after one line for an error that the user can mend.

    A full disk, a folder without rights and a lack of memory are such errors, wherever they occur.
    """
    collect_seldom()
    try:
        have_home()
        return work() or 0
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads what would still be flushed
        return UNHEARD
    except (DadiffError, OSError, MemoryError) as error:
        sys.stderr.write(f"{program}: error: {in_one_line(error)}\n")
        return FAILED
    except KeyboardInterrupt as error:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends already
        said = f" ({error})" if str(error) else ""
        sys.stderr.write(f"{program}: interrupted{said}; the same command goes on from what is stored\n")
        return INTERRUPTED


def collect_seldom() -> None:
    """Look for garbage seldom, and not at the end, when all is given back: a third of what loading MLflow takes."""
    gc.set_threshold(COLLECTED_AFTER)
    atexit.register(gc.freeze)


def have_home() -> None:
    """Give this process a home where it has none, as a user without an entry has none: MLflow looks for one."""
    try:
        Path.home()
    except RuntimeError:
        folder = Path(tempfile.gettempdir()) / f"dadiff-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        own = folder.stat().st_uid == os.getuid() and not folder.is_symlink()
        os.environ["HOME"] = str(folder) if own else tempfile.mkdtemp(prefix="dadiff-")


def in_one_line(error: BaseException) -> str:
    """What an error says; of the system's own, the file and the reason."""
    if isinstance(error, MemoryError):
        return f"out of memory {error}".strip()
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        remedy = "; make room, and the same command goes on" if error.errno in FULL else ""
        return f"{place}{error.strerror}{remedy}"
    return " ".join(str(error).split())

"""Where a result comes from: versions, commit, machine and time."""

from __future__ import annotations

import platform
import subprocess
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dadiff import __version__

PACKAGES = ("numpy", "scipy", "torch")


def provenance(device: str, started: float) -> dict[str, Any]:
    """What goes into a run's record.

    Args:
        started: as `time.time()` gives it.
    """
    return {
        "versions": {"dadiff": __version__, "python": platform.python_version(), **{p: version(p) for p in PACKAGES}},
        "commit": commit(),
        "device": device,
        "host": platform.node(),
        "started": datetime.fromtimestamp(started, UTC).isoformat(timespec="seconds"),
        "seconds": time.time() - started,
    }


def commit() -> str | None:
    """The git commit of the source, with `+changes` if files differ from it; None for an installed package."""
    source = Path(__file__).parent.parent.parent
    if not (source / ".git").exists():
        return None
    git = ["git", "-C", str(source)]
    head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=False)
    status = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    return (head.stdout.strip() + ("+changes" if status.stdout.strip() else "")) or None

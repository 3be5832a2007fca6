"""What is recorded of a run: what it was, and where its result comes from."""

from __future__ import annotations

import platform
import shutil
import subprocess
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dadiff import __version__
from dadiff.running.identity import Identity
from dadiff.store import Provenance, Record, Status

PACKAGES = ("numpy", "scipy", "torch")


def record_of(
    identity: Identity,
    config: Mapping[str, Any],
    status: Status,
    started: float,
    device: str | None = None,
    **found: Any,
) -> Record:
    """The record of a run that ends now.

    Args:
        config: resolved.
        started: as `time.time()` gives it.
        found: further fields of the record.
    """
    return Record(
        key=identity.key,
        name=identity.name,
        status=status,
        config=dict(config),
        axes=identity.axes,
        links=identity.links,
        provenance=provenance(started, device),
        **found,
    )


def provenance(started: float, device: str | None = None) -> Provenance:
    """That of what was begun here.

    Args:
        started: as `time.time()` gives it.
    """
    return Provenance(
        host=platform.node(),
        started=datetime.fromtimestamp(started, UTC).isoformat(timespec="seconds"),
        seconds=time.time() - started,
        device=device,
        commit=commit(),
        versions={"dadiff": __version__, "python": platform.python_version(), **{p: version(p) for p in PACKAGES}},
    )


@cache
def commit() -> str | None:
    """The git commit of the source, with `+changes` if files differ from it; None of a package, or without git.

    As it was when it was first asked for, which is nearer to what was loaded than what lies there later.
    """
    source = Path(__file__).parent.parent.parent
    if not (source / ".git").exists() or shutil.which("git") is None:
        return None
    git = ["git", "-C", str(source)]
    head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=False)
    status = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=False)
    return (head.stdout.strip() + ("+changes" if status.stdout.strip() else "")) or None

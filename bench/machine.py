"""The machine that measured, in one line: what its processor is, how many cores there are, and what else it did."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from dadiff import threads

SYSTEM = Path("/proc/cpuinfo")


def described() -> str:
    """As it is now.

    Example:
        "2 cores of Intel(R) Xeon(R) Processor, load 0.1 before"
    """
    return f"{threads.cores()} cores of {processor()}, load {os.getloadavg()[0]:.1f} before"


def processor() -> str:
    """Its name, where the system tells."""
    lines = SYSTEM.read_text().splitlines() if SYSTEM.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())

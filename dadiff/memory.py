"""What fits into memory, judged before it is asked for: a size that is merely declared allocates nothing."""

from __future__ import annotations

import math
import os
from functools import cache
from pathlib import Path

from dadiff.errors import ConfigError

CONTROL_GROUP = Path("/sys/fs/cgroup")
MEMORY = Path("/proc/meminfo")


def check_fits(size: float, what: str) -> None:
    """Refuse what does not fit into the memory that is there.

    Args:
        size: in bytes, of what is surely needed.
        what: the parameters that it follows from, with their values.

    Raises:
        ConfigError: with the estimate.
    """
    if size > available():
        raise ConfigError(f"{what}: needs at least {in_words(size)} of memory, {in_words(available())} are there")


@cache
def available() -> float:
    """Bytes that this process could get, as its control group and the machine allow when first asked."""
    return min(_of_group(CONTROL_GROUP), _of_machine(MEMORY))


def in_words(size: float) -> str:
    """A number of bytes for people: "1.4 MB"."""
    if not size < 1e18:
        return "more than 1,000,000 TB"
    units = ("B", "kB", "MB", "GB", "TB", "PB")
    power = min(int(math.log(size, 1000)), len(units) - 1) if size >= 1 else 0
    return f"{size:.0f} B" if power == 0 else f"{size / 1000**power:.1f} {units[power]}"


def _of_group(group: Path) -> float:
    older = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes")
    for limit, used in (("memory.max", "memory.current"), older):
        if (group / limit).exists() and (text := (group / limit).read_text().strip()) != "max":
            return max(0.0, float(text) - _cached(group / used))
    return math.inf


def _cached(used: Path) -> float:
    """Bytes in use; the page cache, which gives way, is left out."""
    statistics = dict(line.split()[:2] for line in (used.parent / "memory.stat").read_text().splitlines())
    return float(used.read_text()) - float(statistics.get("file", statistics.get("total_cache", 0)))


def _of_machine(table: Path) -> float:
    if table.exists():
        lines = dict(line.split(":", 1) for line in table.read_text().splitlines())
        return 1024 * float(lines["MemAvailable"].split()[0])
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))

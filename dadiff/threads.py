"""How many threads, and how they wait: settled before torch loads, here and nowhere else.

A thread of a parallel region that has nothing to do either spins, which costs the processor that another process
needs, or sleeps, which costs its waking. OpenMP's default spins for long: 3 to 7 times slower beside one busy process.
2,000 rounds are at most a sixth from the best of 0 to 20,000, on an idle machine and beside one busy process, for the
training of `denoiser=mlp` on two cores; no number is nearer in both.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

SPINNING, SPINS = "GOMP_SPINCOUNT", "2000"
LIMITS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
CONTROL_GROUP = Path("/sys/fs/cgroup")


def settle() -> None:
    """Set what this process's environment does not say already. To be called before torch is imported."""
    os.environ.setdefault(SPINNING, SPINS)
    if cores() < affine_cores():  # torch knows nothing of a container's share
        os.environ.setdefault("OMP_NUM_THREADS", str(cores()))


def limits(threads: int) -> dict[str, str]:
    """The environment of processes that shall take so many threads."""
    return {**dict.fromkeys(LIMITS, str(threads)), SPINNING: os.environ.get(SPINNING, SPINS)}


def own() -> int:
    """How many threads this process may take: what its environment says, else all its cores."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(stated)) if stated.isdigit() else cores()


def cores() -> int:
    """The cores that this process may use, which a container's share of processor time may reduce."""
    return max(1, math.ceil(min(affine_cores(), share(CONTROL_GROUP))))


def affine_cores() -> int:
    """The cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share(group: Path) -> float:
    """Processor time per time that a control group (version 1 or 2) allows; infinite if it sets no limit."""
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):
        if all((group / name).exists() for name in names):
            quota, period = " ".join((group / name).read_text() for name in names).split()
            return math.inf if quota in ("max", "-1") else int(quota) / int(period)
    return math.inf

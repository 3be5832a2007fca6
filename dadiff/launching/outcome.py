"""How a job ended, and why."""

from __future__ import annotations

from dataclasses import dataclass

from dadiff.errors import DadiffError, ExcitationError, InfeasibleError, NotApplicableError
from dadiff.store import Status

LONGEST_REASON = 2000
"""Characters; the log has the rest."""


@dataclass(frozen=True)
class Outcome:
    """The end of a job.

    Args:
        status: that of its run, if it is one.
    """

    status: Status
    reason: str | None
    seconds: float


def why(error: BaseException) -> tuple[Status, str]:
    """The status and reason that an exception stands for."""
    reason = " ".join(str(error).split())[:LONGEST_REASON]
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", "interrupted"
    if isinstance(error, (ExcitationError, NotApplicableError)):
        return "refused", reason
    if isinstance(error, InfeasibleError):
        return "infeasible", reason
    out_of_memory = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    if out_of_memory or "can't allocate memory" in reason:
        return "out_of_memory", f"out of memory: {reason or type(error).__name__}"
    return "failed", reason if isinstance(error, DadiffError) else f"{type(error).__name__}: {reason}"

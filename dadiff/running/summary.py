"""A short table of runs for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from dadiff.store import StoredRun

COLUMNS = {
    "state error": "planned_state_error",
    "input error": "planned_input_error",
    "replayed": "rollout_state_error",
    "plan-replay gap": "gap",
    "cost ratio": "cost_ratio",
    "spread": "spread",
    "of the law's": "spread_ratio",
    "calls": "network_calls",
    "seconds": "sampling_seconds",
}


def summary(runs: Sequence[StoredRun]) -> str:
    """One line a run: means over cases, samples and time. A run without numbers says why."""
    width = max(len(run.name) for run in runs)
    lines = [f"{'run':<{width}}" + "".join(f"{title:>17}" for title in COLUMNS)]
    return "\n".join(lines + [_line(run, width) for run in runs])


def _line(run: StoredRun, width: int) -> str:
    if run.status != "finished":
        return f"{run.name:<{width}}  {run.status}: {run.record.reason or ''}"
    return f"{run.name:<{width}}" + "".join(f"{_number(run.metrics.get(name)):>17}" for name in COLUMNS.values())


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"

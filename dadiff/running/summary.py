"""Runs for the terminal: one as a short vertical list, several as a table, best first and as wide as the terminal."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Sequence

from rich.table import Table

from dadiff.store import StoredRun
from dadiff.store.names import differences
from dadiff.store.record import ABOUT_DATA, is_odd
from dadiff.terminal import plain_table, text

METRICS = {
    "state error": "planned_state_error",
    "input error": "planned_input_error",
    "replayed": "rollout_state_error",
    "plan-replay gap": "gap",
    "cost ratio": "cost_ratio",
    "spread": "spread",
    "of the law's": "spread_ratio",
    "calls": "network_calls",
    "seconds": "sampling_seconds",
    "seconds for one plan": "plan_latency",
    "one in a hundred": "plan_latency_p99",
    "deadlines missed": "deadlines_missed",
    "recording / noise": "recording_residual",
    "without its offset": "offset_residual",
    "demonstrations / noise": "demonstrations_residual",
    "test cases / noise": "cases_residual",
    "test cases in train": "also_in_train",
    "test cases far outside": "outside_training",
}
ODD = [title for title, metric in METRICS.items() if metric in ABOUT_DATA]
"""Of these several runs show what says that data are odd: residuals are 1 in good data, counts 0."""
COLUMNS = ("cost ratio", "state error", "replayed", "plan-replay gap", "seconds", "seconds for one plan")
"""Of several runs, which are sorted by the first of these that they have."""
EPISODES = re.compile(r"closed_loop_([a-z]+)_(\d+)")
"""The cost of episodes over that of the optimum: by controller, and steps between two plans."""
MOST_ROWS = 30
NAME_WIDTH, NUMBER_WIDTH, GAP = 34, 9, 2


def one_run(run: StoredRun) -> str:
    """Its name, and means over cases, samples and time; a run without numbers says why."""
    if run.status != "finished":
        return f"{run.name}\n  {run.status}: {run.record.reason or ''}"
    table = Table.grid(padding=(0, 2))
    for title, metric in METRICS.items():
        if metric in run.metrics:
            table.add_row(f"  {title}", _number(run.metrics[metric]))
    for metric, cost in run.metrics.items():
        if episodes := EPISODES.fullmatch(metric):
            table.add_row("  {}, planning every {}".format(*episodes.groups()), _number(cost))
    return f"{run.name}\n{text(table)}"


def several_runs(runs: Sequence[StoredRun]) -> str:
    """One row a run, called by what is not the same in all of them; runs without numbers come last."""
    if not runs:
        return ""
    odd = [title for title in ODD if any(is_odd(METRICS[title], run.metrics) for run in runs)]
    titles = _fitting([title for title in COLUMNS if any(METRICS[title] in run.metrics for run in runs)]) + odd
    table = plain_table("run", *titles)
    for column in table.columns[1:]:
        column.justify = "right"
    names = differences([run.name for run in runs])
    ranked = sorted(zip(runs, names, strict=True), key=lambda entry: _rank(entry[0]))
    for run, name in ranked[:MOST_ROWS]:
        numbers = [_number(run.metrics.get(METRICS[title])) for title in titles]
        table.add_row(name.replace("/", " "), *(numbers if run.status == "finished" else [run.status][: len(titles)]))
    more = len(ranked) - MOST_ROWS
    return text(table) + (f"\n... and {more} more" if more > 0 else "")


def _fitting(titles: Sequence[str]) -> list[str]:
    """The titles that leave a name the room it needs, the first in any case."""
    left, kept = shutil.get_terminal_size().columns - NAME_WIDTH, list[str]()
    for title in titles:
        width = max(len(title), NUMBER_WIDTH) + GAP
        if width <= left or not kept:
            kept.append(title)
            left -= width
    return kept


def _rank(run: StoredRun) -> tuple[bool, float]:
    values = (run.metrics.get(METRICS[title]) for title in COLUMNS)
    value = next((value for value in values if value is not None and math.isfinite(value)), math.inf)
    return run.status != "finished", value


def _number(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.4g}"

"""How MLflow's pages show a sweep: its runs as a table, what is sorted by and what varies as columns, and charts.

MLflow keeps such states as tags of the experiment, and opens one with `?viewStateShareKey=` in the address.
"""

from __future__ import annotations

import json
import uuid
from typing import Any
from urllib.parse import quote

from dadiff.store import Sweep

SORTED = "cost_ratio"
"""What runs are sorted by, and the one metric among the columns: MLflow shows metrics before parameters in whatever
order they are asked for, and more of them would push what varies out of a window 1,440 pixels wide."""

CURVES = ("t/planned_state_error", "t/rollout_state_error", "t/gap")
"""Charted along the horizon, on logarithmic axes."""

PLANS = "plans"
"""Key of a run's picture of its plans."""

STATE = "mlflow.sharedViewState."
TRAINING_PAGES = "workflowType=machine_learning"
"""What makes MLflow show its pages for training, not those for chats."""


def table_page(experiment: str, sweep: str) -> str:
    """The address of a sweep's table of runs, below that of the pages."""
    return f"/#/experiments/{experiment}/runs?{TRAINING_PAGES}&viewStateShareKey={quote(sweep, safe='')}"


def run_page(experiment: str, run: str) -> str:
    """The address of one run."""
    return f"/#/experiments/{experiment}/runs/{run}?{TRAINING_PAGES}"


def sweep_view(sweep: Sweep, parent: str) -> str:
    """The runs of a sweep, best first.

    Args:
        parent: id of the run that they are nested under.
    """
    columns = [f"metrics.`{SORTED}`"] + [f"params.`{name}`" for name in varying(sweep)]
    return json.dumps(
        {
            "searchFilter": f"tags.`mlflow.parentRunId` = '{parent}'",
            "orderByKey": f"metrics.`{SORTED}`",
            "orderByAsc": True,
            "selectedColumns": columns,
            **_charts(sweep.name),
        }
    )


def _charts(sweep: str) -> dict[str, Any]:
    """Curves along the horizon, a bar of costs, and the pictures of plans; ids follow from the sweep's name."""
    section = _id(sweep, "section")
    common = {"deleted": False, "isGenerated": False, "metricSectionId": section}
    lines = {"type": "LINE", "scaleType": "log", "xAxisScaleType": "linear", "xAxisKey": "step", "lineSmoothness": 0}
    lines |= {"useGlobalXaxisKey": False, "useGlobalLineSmoothing": False, "range": {}}
    charts: list[dict[str, Any]] = [{**lines, "metricKey": name, "selectedMetricKeys": [name]} for name in CURVES]
    charts += [{"type": "BAR", "metricKey": SORTED}]
    charts += [{"type": "IMAGE", "imageKeys": [PLANS], "step": 0, "showRunParams": False}]
    return {
        "compareRunSections": [{"uuid": section, "name": "dadiff", "display": True, "isReordered": True}],
        "compareRunCharts": [
            {**common, **chart, "uuid": _id(sweep, f"{chart['type']}-{chart.get('metricKey')}")} for chart in charts
        ],
        "isAccordionReordered": True,
        "runsHiddenMode": "FIRST_20_RUNS",
    }


def _id(sweep: str, what: str) -> str:
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"dadiff/{sweep}/{what}"))


def varying(sweep: Sweep) -> list[str]:
    """The axes that differ between runs; of several that always move together (the seeds) the first."""
    values: dict[tuple[str, ...], str] = {}
    for name in dict.fromkeys(name for cell in sweep.cells for name in cell.axes):
        column = tuple(str(cell.axes.get(name)) for cell in sweep.cells)
        if len(set(column)) > 1:
            values.setdefault(column, name)
    return list(values.values())


def short_names(sweep: Sweep) -> dict[str, str]:
    """Key of a run -> its name with what tells it apart from the others in front, and the rest behind."""
    words = {cell.key: cell.name.split("/") for cell in sweep.cells}
    common = set.intersection(*map(set, words.values())) if words else set()
    if len(words) < 2:
        return {cell.key: cell.name for cell in sweep.cells}
    return {key: _ordered(name, common) for key, name in words.items()}


def _ordered(words: list[str], common: set[str]) -> str:
    own, rest = [word for word in words if word not in common], [word for word in words if word in common]
    return " · ".join("/".join(part) for part in (own, rest) if part)

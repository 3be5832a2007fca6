"""The figure of closed loops: what is drawn is what runs stored."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from dadiff.reporting.aggregation import Runs
from dadiff.reporting.figures.intervals import Intervals, _costs, collect


def method(name: str, costs: dict[str, float], status: str = "finished") -> SimpleNamespace:
    cell = SimpleNamespace(metrics=costs, status=status)
    scalars = SimpleNamespace(scalars=lambda metric, group: np.full((1, 1), costs[metric]))
    return SimpleNamespace(
        axes={"projector": name}, finished=[cell] * (status == "finished"), runs=scalars, keys=[name]
    )


COSTS = {"closed_loop_receding_10": 1.5, "closed_loop_receding_1": 1.1, "closed_loop_optimal_1": 1.0, "cost_ratio": 2.0}


def test_controllers_and_intervals_are_read_from_the_names_of_metrics():
    assert _costs(method("none", COSTS)) == {"optimal": [1], "receding": [1, 10]}


@pytest.mark.parametrize(("metric", "column"), [("closed_loop_tracking_5", 2.0), ("closed_loop_same_tracking_5", 1.5)])
def test_costs_come_robot_by_robot_from_the_table_of_episodes(metric, column):
    index = [(c, k, r, s) for c in ("tracking", "optimal") for k in (5, 10) for r in range(3) for s in range(2)]
    table = pd.DataFrame(index, columns=["controller", "every", "robot", "case"])
    chosen = (table["controller"] == "tracking") & (table["every"] == 5)
    table = table.assign(cost_ratio=np.where(chosen, 2.0, 9.0), cost_ratio_same=np.where(chosen, 1.5, 9.0))
    robots = pd.DataFrame({"group": ["interpolation", "extrapolation", "interpolation"]})
    tables = {"closed_loop": table, "robots": robots}
    cell = SimpleNamespace(
        metrics={metric: column}, key="k", name="n", means={}, table=tables.get, has=tables.__contains__,
        has_column=lambda *_: False, link=lambda kind: kind,
    )  # fmt: skip
    runs = Runs(("seed",), np.array([cell], dtype=object))
    np.testing.assert_array_equal(runs.curves(metric).values, np.full((1, 3, 2), column))
    np.testing.assert_array_equal(runs.curves(metric, "interpolation").values, np.full((1, 2, 2), column))


def test_lines_are_drawn_by_controller_and_the_expert_beside(monkeypatch):
    methods = [method("none", COSTS), method("known", COSTS), method("known", {}, "diverged")]
    estimate = SimpleNamespace(value=1.0, low=math.nan, high=math.nan)
    monkeypatch.setattr("dadiff.reporting.figures.intervals.mean", lambda values, floor: estimate)
    monkeypatch.setattr("dadiff.reporting.figures.intervals.varying", lambda methods: ["projector"])
    shown = collect(SimpleNamespace(methods=lambda selector: methods))
    assert isinstance(shown, Intervals)
    assert [len(lines) for lines in shown.lines.values()] == [2]
    assert shown.lines["receding"][0].every == [1, 10]
    assert shown.expert is not None
    assert shown.runs == ["none", "known"]
    assert len(shown.draw(2).axes) == 1

"""Ranks and wins, case by case, with intervals that hold what they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dadiff.reporting import tables
from dadiff.reporting.aggregation import Evidence, Method
from dadiff.reporting.definitions import load
from dadiff.reporting.leaderboard import median, places, wins
from dadiff.reporting.naming import short_names
from dadiff.reporting.sources import read_sweeps

STORE = Path(__file__).parent / "data" / "store"
METRIC = "planned_state_error"


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    return Evidence(read_sweeps(STORE, ["lqr_made_up"]))


def test_rows_are_ordered_by_rank_and_the_best_has_the_least_error(evidence):
    table = tables.collect(evidence, cells={}, metrics=[METRIC], relative_to={"projector": "none"}, ranked_by=METRIC)
    assert table.metrics[:3] == ["rank", "wins", METRIC]
    ranked = [row for row in table.rows if row.values["rank"]]
    ranks = [row.values["rank"].mean.value for row in ranked]
    assert ranks == sorted(ranks)
    assert ranked[0].values[METRIC].mean.value == min(row.values[METRIC].mean.value for row in ranked)
    assert all(row.values["wins"] is None for row in ranked if row.label == table.baseline)
    assert ranked[0].values["wins"].mean.value == 1.0
    assert "rank" in tables.to_csv(table).splitlines()[0]


def test_a_tuned_parameter_stands_at_its_best_and_is_named(evidence):
    asked = {"cells": {"projector": "known", "denoiser": "mlp"}, "metrics": [METRIC]}
    judged = [row for row in tables.collect(evidence, **asked).rows if row.values[METRIC]]
    assert len(judged) == 2
    found = tables.collect(evidence, **asked, ranked_by=METRIC, tuned=["enforcement"]).rows
    (best,) = (row for row in found if row.values[METRIC])
    assert best.values[METRIC].mean.value == min(row.values[METRIC].mean.value for row in judged)
    assert best.label in {row.label for row in judged}
    assert len(found) == 2  # the other diverged, and stays


def test_methods_without_the_metric_have_no_place(evidence):
    methods = evidence.methods({})
    assert places(methods, "no_such_metric", None) == [None] * len(methods)
    found = places(methods, METRIC, None)
    assert all(method.finished for place, method in zip(found, methods, strict=True) if place)
    assert sum(place is not None for place in found) > 3
    assert all(place.wins is None for place in found if place)


def test_the_interval_of_a_median_holds_it_in_95_of_100_draws():
    rng, held = np.random.default_rng(0), 0
    for _ in range(400):
        found = median(rng.standard_normal(31))
        held += found.low <= 0 <= found.high
    assert 0.93 <= held / 400 <= 0.99
    assert np.isnan(median(np.array([2.0])).low)


def test_wins_are_shares_of_cases_and_ties_are_halves():
    found = wins(np.array([1.0, 2, 3, 4]), np.array([2.0, 2, 2, 5]))
    assert found.value == pytest.approx(2.5 / 4)
    assert 0 < found.low < found.value < found.high < 1


@pytest.mark.parametrize("name", ["rivals", "exact_bench", "doubted"])
def test_the_reports_of_methods_are_definitions(name):
    definition = load(name)
    assert definition.tables
    assert all(item.collect for item in (*definition.figures, *definition.tables))


def test_a_counterpart_stands_beside_its_method_and_nowhere_else(evidence):
    exact = {"denoiser": "gaussian"}
    beside = {"metrics": ["rollout_state_error", "no_such"], "of": exact, "cells": {"projector": ["known", "hankel"]}}
    table = tables.collect(evidence, cells={"denoiser": "mlp"}, metrics=[METRIC], beside=beside)
    assert table.metrics == [METRIC, "rollout_state_error"]
    (other,) = tables.collect(evidence, cells=exact | {"projector": "known"}, metrics=["rollout_state_error"]).rows
    shown = {row.label: row.values["rollout_state_error"] for row in table.rows if row.values["rollout_state_error"]}
    assert list(shown.values()) == list(other.values.values())  # the same enforcement's alone
    assert list(shown) == [
        row.label for row in table.rows if row.label.startswith("known") and "every step" in row.label
    ]


def test_claims_are_about_the_cells_that_a_report_judges(evidence):
    assert evidence.of({}) is evidence
    found = evidence.of({"denoiser": {"not": "gaussian"}}).all_methods
    assert [m.axes for m in found] == [m.axes for m in evidence.all_methods if m.axes["denoiser"] != "gaussian"]


def _methods(*axes: dict) -> list[Method]:
    return [Method({"projector": "known", **own}, []) for own in axes]


def test_names_leave_out_what_most_methods_share_and_stay_apart():
    many = [{"enforcement": f"e{k}", "denoiser": "mlp", "sampler": "ddim", "sampler.num_steps": 5} for k in range(7)]
    once = {"enforcement": "e0", "denoiser": "mlp", "sampler": "ddim", "sampler.num_steps": 1}
    other = {"enforcement": "e0", "denoiser": "gaussian", "sampler": "ddim", "sampler.num_steps": 5}
    shown = ["enforcement", "denoiser", "sampler"]
    names, usual = short_names(_methods(*many, once, other), shown)
    assert usual == "mlp, ddim"
    assert names == [*(f"e{k}" for k in range(7)), "e0, one call", "e0, exact denoiser"]
    few, nothing = short_names(_methods(*many[:3]), shown)
    assert nothing == ""
    assert few[0] == "e0, mlp, ddim"
    twice = {"enforcement": "e0", "sampler": "ddim", "sampler.num_steps": 5}
    assert short_names(_methods(*many, twice), shown)[1] == ""

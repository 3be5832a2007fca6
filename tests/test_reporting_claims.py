"""Every claim of the ledger gets the right verdict on made-up stores in which it is true, false and undecided."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up import MadeUp, chain_table, example_arrays

from dadiff.errors import ConfigError
from dadiff.folders import shipped
from dadiff.reporting.aggregation import Evidence
from dadiff.reporting.claims import Claim, Finding, Verdict, decide, judge, read_ledger, sentence
from dadiff.reporting.definitions import FOLDER, load, names
from dadiff.reporting.report import build
from dadiff.reporting.sources import read_sweeps
from dadiff.reporting.statistics import Estimate
from dadiff.reporting.story import sentences

LEDGER = {claim.id: claim for claim in read_ledger(FOLDER / "claims.yaml")}
CONF = Path(str(shipped("conf")))
TRUTHS = ("holds", "does not hold", "undecided")


def concrete(cells: dict[str, Any]) -> dict[str, Any]:
    """Axes of one cell that a selector asks for."""
    axes = {}
    for axis, wanted in cells.items():
        if isinstance(wanted, list):
            axes[axis] = wanted[-1]
        elif not isinstance(wanted, dict):
            axes[axis] = wanted
        elif "above" in wanted:
            axes[axis] = wanted["above"] + 0.01
    axes.setdefault("projector", "known")
    return {name.replace(".", "__"): value for name, value in axes.items()}


def target(rule: dict[str, float], truth: str) -> float:
    """Where a statistic must lie for a verdict."""
    bound = next(iter(rule.values()))
    if len(rule) == 2:
        inside, outside = math.sqrt(rule["above"] * rule["below"]), 5 * rule["below"]
    else:
        inside, outside = (bound * 5, bound / 5) if "above" in rule else (bound / 2, bound * 5)
    return {"holds": inside, "does not hold": outside, "undecided": rule.get("below", bound)}[truth]


def baseline_axes(claim: Claim, axes: dict[str, Any]) -> dict[str, Any]:
    against = claim.options["against"]
    rest = {k: v for k, v in axes.items() if k not in ("projector", "enforcement")}
    if against.get("projector") == "none":
        return {**rest, "projector": "none"}
    return {**axes, **{name.replace(".", "__"): value for name, value in against.items()}}


def judged(store: MadeUp, claim: Claim) -> Verdict:
    store.sweep()
    return judge(claim, Evidence(read_sweeps(store.folder, [store.name])))


def level_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store = MadeUp(folder, cases=200 if len(claim.rule) == 2 else 6)
    bound = target(claim.rule, truth)
    metric = claim.options["metric"]
    far = {"holds": 0.1}.get(truth, 1) if len(claim.rule) == 1 else 0.9
    value = 1 + (bound - 1) * far if metric.endswith("cost_ratio") else bound * far
    for seed in range(3):
        off = {"undecided": (0.3, 1.0, 1.7)[seed]}.get(truth, 1)
        scaled = 1 + (value - 1) * off if metric.endswith("cost_ratio") else value * off
        store.run(levels={metric: scaled}, per_plan={metric: scaled}, seed=seed, spread=0.1, **concrete(claim.cells))
    return store


def ratio_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, axes = MadeUp(folder), concrete(claim.cells)
    for seed in range(3):
        off = {"undecided": (0.6, 1.0, 1.4)[seed]}.get(truth, 1)
        value, exact = target(claim.rule, truth) * off, claim.options.get("exact", False)
        store.run(
            1.0, seed=seed, metrics={claim.options["metric"]: 1.0} if exact else None, **baseline_axes(claim, axes)
        )
        store.run(value, seed=seed, metrics={claim.options["metric"]: value} if exact else None, **axes)
    return store


def time_course_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, axes = MadeUp(folder, cases=30), concrete(claim.cells)
    store.run(1.0, spread=0.3, **baseline_axes(claim, axes))
    store.run({"holds": 0.3, "does not hold": 3.0, "undecided": 1.0}[truth], spread=0.3, **axes)
    return store


def dip_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, at = MadeUp(folder, cases=30, horizon=40), np.isin(np.arange(41), claim.options["times"])
    shape = 1 + {"holds": -0.7, "does not hold": 2.0, "undecided": 0.0}[truth] * at
    store.run(1.0, shape=shape, spread=0.1 if truth != "undecided" else 0.5, **concrete(claim.cells))
    return store


def length_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, axes = MadeUp(folder), concrete(claim.cells)
    ratio = {"holds": 0.3, "does not hold": 3.0, "undecided": 1.0}[truth]
    for length, level in ((100, 1.0), (300, math.sqrt(ratio)), (1000, ratio)):
        for recording in range(3):
            value = level * (0.8, 1.0, 1.2)[recording if length < 1000 else 2 - recording]
            store.run(value, metrics={"projector_distance": value}, recording__length=length,
                      recording__seed=recording, **axes)  # fmt: skip
    return store


def chain_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, grows = MadeUp(folder), truth == "does not hold"
    table = chain_table(20, grows=grows)
    if grows:
        table[["growth", "step_growth"]] = 5.0
    store.run(1.0, chain=table, **concrete(claim.cells))
    return store


def time_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store, bound = MadeUp(folder), target(claim.rule, truth)
    for seed in range(3):
        share = bound * {"undecided": (0.5, 1.0, 1.5)[seed]}.get(truth, 1)
        times = {"projection_seconds": share / 100, "projection_calls": 100, "sampling_seconds": 1.0}
        store.run(1.0, metrics=times, seed=seed, **concrete(claim.cells))
    return store


def schedule_store(folder: Path, claim: Claim, truth: str) -> MadeUp:
    store = MadeUp(folder)
    conditions = {"C1": truth == "holds", "C2": True, "C3": True}
    store.run(1.0, notes={"schedule": conditions}, **concrete(claim.cells))
    return store


STORES = {
    "level": level_store,
    "ratio_to": ratio_store,
    "at_every_time": time_course_store,
    "dip": dip_store,
    "longest_over_shortest": length_store,
    "steps_grew": chain_store,
    "projection_share": time_store,
    "schedule_conditions": schedule_store,
}
EXACT = ("steps_grew", "schedule_conditions")
"""Counted, not estimated: they are never undecided."""


@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize("claim", LEDGER.values(), ids=LEDGER)
def test_verdicts(claim, truth, tmp_path):
    if truth == "undecided" and (claim.statistic in EXACT or claim.options.get("exact")):
        pytest.skip("counted exactly, so it is never undecided")
    verdict = judged(STORES[claim.statistic](tmp_path, claim, truth), claim)
    assert verdict.word == truth, verdict.lines
    assert verdict.runs
    assert verdict.effect is not None
    assert sum(verdict.counts.values()) == len(verdict.findings)
    word = {"holds": "so: ", "does not hold": "not so: ", "undecided": "open: "}[truth]
    assert any(line.startswith(word) for line in verdict.lines)


@pytest.mark.parametrize("claim", LEDGER.values(), ids=LEDGER)
def test_nothing_is_said_without_cells(claim, tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0, task="another", projector="another", schedule="another")
    assert judged(store, claim).verdict == "not tested here"


def test_the_condition_of_a_claim_is_the_axis_that_decides(tmp_path):
    store, claim = MadeUp(tmp_path), LEDGER["fig2_state"]
    for noise, level in ((True, 0.2), (False, 3.0)):
        for projector in ("none", "known", "hankel"):
            store.run(1.0 if projector == "none" else level, projector=projector, sampler__last_step_noise=noise,
                      enforcement=None if projector == "none" else "normalised")  # fmt: skip
    verdict = judged(store, claim)
    assert verdict.verdict == "holds only if with last-step noise (2 of 4)"
    assert verdict.counts == {"so": 2, "open": 0, "not": 2}


def test_a_diverged_method_is_not_below_anything(tmp_path):
    store, claim = MadeUp(tmp_path), LEDGER["printed_operator"]
    store.run(1.0)
    store.run(status="diverged", step=312, projector="known", enforcement="literal")
    verdict = judged(store, claim)
    assert verdict.verdict == "does not hold"
    assert "diverged at step 312" in verdict.lines[0]
    store.run(status="diverged", step=312, projector="known", enforcement="normalised")
    aside = judged(store, LEDGER["fig2_state"])
    assert aside.verdict == "not tested here"
    assert aside.aside == {"known FF†": "diverged at step 312"}


def test_a_projector_that_is_the_identity_counts_for_nothing_and_is_named(tmp_path):
    store, claim = MadeUp(tmp_path), LEDGER["longer_recording_plans"]
    size = 4 * 11 + 2 * 10
    for length, level, rank in ((100, 1.0, 30), (300, 3.0, 30), (1000, 0.1, size)):
        store.run(level, metrics={"rank": rank}, arrays=example_arrays(10, 0.1), recording__length=length,
                  recording__process_noise=0.01, projector="hankel", enforcement="normalised")  # fmt: skip
    verdict = judged(store, claim)
    assert verdict.verdict == "does not hold"
    assert "S = 300 and S = 100" in verdict.lines[0]
    assert verdict.aside == {"Hankel HH†, S = 1000": "the projector is the identity"}


def test_failed_and_missing_cells_decide_nothing_and_are_named(tmp_path):
    store, claim = MadeUp(tmp_path), LEDGER["fig2_state"]
    store.run(1.0)
    store.run(0.2, projector="known", enforcement="normalised")
    store.run(status="failed", reason="out of memory", projector="hankel", enforcement="normalised")
    verdict = judged(store, claim)
    assert verdict.verdict == "holds"
    assert verdict.aside == {"Hankel HH†": "failed: out of memory"}


def test_a_verdict_from_a_part_of_the_seeds_says_so(tmp_path):
    store, claim = MadeUp(tmp_path, cases=40), LEDGER["fig2_significantly"]
    for seed in range(3):
        store.run(1.0, seed=seed)
    store.run(0.2, seed=0, projector="known", enforcement="normalised")
    store.run(status="failed", reason="out of memory", seed=1, projector="known", enforcement="normalised")
    store.run(stored=False, seed=2, projector="known", enforcement="normalised")
    verdict = judged(store, claim)
    assert "(1 of 3 runs: failed: out of memory; missing)" in verdict.lines[0]
    assert len(verdict.runs) == 2  # the pair that was compared


def test_more_seeds_that_say_the_same_leave_a_verdict_decided(tmp_path):
    """Nested stores: each holds the runs of the one before and two seeds more."""
    store, claim = MadeUp(tmp_path, cases=20), LEDGER["fig2_significantly"]
    for seed, level in enumerate((0.30, 0.27, 0.33, 0.29, 0.31)):
        store.run(1.0, seed=seed)
        store.run(level, seed=seed, projector="known", enforcement="normalised")
        if seed in (0, 2, 4):
            verdict = judged(store, claim)
            assert verdict.word == "holds", (seed, verdict.lines)
            assert len(verdict.findings) == 1


def test_runs_of_different_seeds_are_not_compared(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0, seed=0)
    store.run(0.2, seed=1, projector="known", enforcement="normalised")
    assert judged(store, LEDGER["fig2_state"]).verdict == "not tested here"
    for name in names():
        report = build(load(name), Evidence(read_sweeps(store.folder, [store.name])), list(LEDGER.values()), "")
        for part in report.figures:
            assert not part.runs or part.content.draw(2)


def test_one_case_decides_nothing(tmp_path):
    store = MadeUp(tmp_path, cases=1)
    store.run(1.0)
    store.run(0.2, projector="known", enforcement="normalised")
    assert judged(store, LEDGER["fig2_significantly"]).verdict == "undecided"


def test_a_single_timing_is_said_to_be_one(tmp_path):
    store = MadeUp(tmp_path)
    times = {"projection_seconds": 1e-3, "projection_calls": 20, "sampling_seconds": 1.0}
    store.run(metrics=times, projector="known", enforcement="normalised")
    verdict = judged(store, LEDGER["projection_is_cheap"])
    assert verdict.verdict == "holds"
    assert verdict.lines == ["so: known FF†: 2 % of the sampling time of one run"]


def test_a_chain_without_half_steps_says_nothing(tmp_path):
    store = MadeUp(tmp_path)
    store.run(chain=chain_table(20, grows=False).head(0), **concrete(LEDGER["theorem1_step"].cells))
    assert judged(store, LEDGER["theorem1_step"]).verdict == "not tested here"


def found(*said: tuple[str, dict[str, Any], bool | None]) -> list[Finding]:
    return [Finding(label, axes, Estimate(1.0, 1.0, 1.0), true, "", []) for label, axes, true in said]


A, B, C, D = (("a", {"projector": "known"}), ("b", {"projector": "hankel"}), ("c", {"projector": "rollout"}),
              ("d", {"projector": "known"}))  # fmt: skip


@pytest.mark.parametrize(
    ("findings", "words"),
    [
        ([(*A, True)], "holds"),
        ([(*A, True), (*B, True)], "holds for 2 of 2"),
        ([(*A, False)], "does not hold"),
        ([(*A, False), (*B, False)], "does not hold for any of 2"),
        ([(*A, None)], "undecided"),
        ([(*A, True), (*B, False)], "holds only if known FF† (1 of 2)"),
        ([(*A, True), (*B, None)], "holds for 1 of 2; open: 1"),
        ([(*A, True), (*B, None), (*C, False)], "holds for 1 of 3; not: roll-out; open: 1"),
        ([(*A, True), (*D, False), (*B, True)], "holds for 2 of 3; not: d"),
        ([(*A, False), (*B, None)], "does not hold for 1 of 2; open: 1"),
        ([], "not tested here"),
    ],
)
def test_a_verdict_says_so_and_open_and_not(findings, words):
    assert sentence(found(*findings)) == words


def test_only_hides_no_true_finding_without_the_axis():
    said = [("vanilla", {"projector": "none"}, True), ("fixed", {"projector": "known", "initial_state": "fixed"}, True),
            ("free", {"projector": "known", "initial_state": "free"}, False)]  # fmt: skip
    assert sentence(found(*said)) == "holds only if without initial state or x(0) fixed (2 of 3)"
    said.append(("other", {"projector": "known", "initial_state": "fixed"}, False))
    assert sentence(found(*said)) == "holds for 2 of 4; not: free; other"


def test_selectors_are_told_in_words(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0)
    verdict = judged(store, LEDGER["printed_operator"])
    assert verdict.lines == ["no cell of this sweep has projector other than vanilla, enforcement as printed"]


def test_a_comparison_without_its_baseline_is_not_made(tmp_path):
    store = MadeUp(tmp_path)
    store.run(0.2, projector="known", enforcement="normalised")
    verdict = judged(store, LEDGER["fig2_state"])
    assert verdict.verdict == "not tested here"
    assert verdict.lines == ["set aside (no finished run of vanilla to compare with): known FF†"]


@pytest.mark.parametrize(
    ("low", "high", "truth"), [(0.1, 0.4, True), (0.6, 0.9, False), (0.4, 0.6, None), (math.nan, math.nan, None)]
)
def test_rules_ask_where_the_interval_lies(low, high, truth):
    assert decide(Estimate(0.5, low, high), {"below": 0.5}) is truth


def test_the_ledger_names_what_is_wrong(tmp_path):
    path = tmp_path / "claims.yaml"
    entry = "{id: a, claim: b, place: c, statistic: %s, cells: {}, rule: {%s: 1}}"
    for text, message in (
        ("- " + entry % ("levle", "below"), "claim a: unknown statistic 'levle'"),
        ("- " + entry % ("level", "under"), "claim a: rule is"),
        ("- {id: a}", "missing"),
        ("- " + entry % ("level", "below") + "\n- " + entry % ("level", "below"), "an id comes twice"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            read_ledger(path)


def test_reports_ask_for_claims_that_exist_and_every_claim_is_asked_for():
    asked = {claim for name in names() for claim in load(name).claims or []}
    assert asked == set(LEDGER)


def chosen(selector: dict[str, Any]) -> list[tuple[str, str]]:
    """The components that a selector names, by group."""
    plain = {axis: wanted.get("not", []) if isinstance(wanted, dict) else wanted for axis, wanted in selector.items()}
    lists = {axis: wanted if isinstance(wanted, list) else [wanted] for axis, wanted in plain.items()}
    return [(axis, name) for axis, wanted in lists.items() if (CONF / axis).is_dir() for name in wanted if name]


@pytest.mark.parametrize("claim", LEDGER.values(), ids=LEDGER)
def test_a_claim_names_components_as_runs_do(claim):
    for group, name in chosen(claim.cells) + chosen(claim.options.get("against", {})):
        preset = CONF / group / f"{name}.yaml"
        assert name == "none" or "_target_:" in preset.read_text(), f"{preset} varies another component"


def test_a_table_without_a_baseline_says_who_has_least_and_who_has_most():
    def row(label: str, value: float) -> dict[str, object]:
        return {"label": label, "values": {"exact_distance": {"mean": Estimate(value, value, value), "ratio": None}}}

    rows = [row("a", 2.0), row("b", 1e-12), row("c", 3.5), {"label": "d", "values": {"exact_distance": None}}]
    table = {"runs": ["k"], "content": {"baseline": "", "metrics": ["rank", "exact_distance"], "rows": rows}}
    told = "Of 3 methods the lowest distance to the right law is that of b, exact; the highest that of c, 3.50."
    assert sentences({"tables": {"t": table}}, []) == [told]

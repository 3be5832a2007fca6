"""What a report found, in words: read from the content of `report.json`, of this version or the one before.

The same functions serve the page, the published pages, the README's table and the end of the command, so that no two
places say different things.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import Any

from dadiff.reporting.claims import Claim, Finding, conclude, decide
from dadiff.reporting.labels import column_name, column_value, method_name, metric_name, number, with_interval
from dadiff.reporting.measures import IDENTITY
from dadiff.reporting.statistics import Estimate

DOUBLE_INTEGRATOR = {"n": 4, "m": 2}
"""Of all systems in reports of format 1, which do not say where a projector was the identity."""

TWINS = {"worst_difference": "at_every_time"}
"""Statistics of format 1 whose verdicts mean what another's do; their effects are in other units."""


@dataclass(frozen=True)
class Line:
    """One claim and what a report says to it.

    Args:
        unit: what the effect is, in words.
        points: the effect of each method, with what it says: True, False, or None for open.
        bound: the rule's bound on the effect, where it is one number.
        older: whether the intervals are those of format 1 (a bootstrap).
    """

    claim: Claim
    verdict: str
    word: str
    counts: dict[str, int]
    effect: Estimate | None
    unit: str
    points: list[tuple[str, Estimate, bool | None]]
    bound: float | None
    details: list[str]
    runs: list[str]
    older: bool = False

    @property
    def effect_words(self) -> str:
        """The effect of the method in the middle, and how far those of the others reach."""
        if self.effect is None:
            return ""
        middle = with_interval(self.effect.value, self.effect.low, self.effect.high)
        values = [effect.value for _, effect, _ in self.points]
        among = f"; {number(min(values))} to {number(max(values))} over {len(values)}" if len(values) > 1 else ""
        return middle + among


def ledger(content: Mapping[str, Any], claims: list[Claim]) -> list[Line]:
    """The claims that a report judged. Those of format 1 are judged anew where its stored numbers allow."""
    if content["format"] > 1:
        return [_line(entry) for entry in content["claims"]]
    stored = {entry["claim"]["id"]: entry for entry in content["claims"]}
    found = [(claim, _source(claim, stored)) for claim in claims]
    return [_older(claim, entry) for claim, entry in found if entry]


def _line(entry: Mapping[str, Any]) -> Line:
    claim = Claim(**entry["claim"])
    effects = [(f["label"], _estimate(f["effect"]), f["true"]) for f in entry["findings"]]
    return Line(
        claim, entry["verdict"], entry["word"], entry["counts"], _estimate(entry["effect"]), unit(claim),
        [(label, effect, true) for label, effect, true in effects if effect], bound(claim), entry["lines"],
        list(dict.fromkeys(run for f in entry["findings"] for run in f["runs"])),
    )  # fmt: skip


def _source(claim: Claim, stored: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The entry of a report of format 1 that asked the same of the same cells, whatever its bound."""
    for entry in stored.values():
        asked = entry["claim"]
        statistic = TWINS.get(asked["statistic"], asked["statistic"])
        if (statistic, asked["options"], asked["cells"]) == (claim.statistic, claim.options, claim.cells):
            return entry
    return None


def _older(claim: Claim, entry: Mapping[str, Any]) -> Line:
    """Findings of format 1 under today's rule; of a statistic in other units they keep what they said."""
    twin = entry["claim"]["statistic"] in TWINS
    findings: list[Finding] = []
    aside = dict(entry["unavailable"])
    for found in entry["findings"]:
        estimate = _estimate(found["estimate"])
        if _identity(found["axes"]):
            aside[found["label"]] = IDENTITY
        elif estimate is None and not claim.diverging:
            aside[found["label"]] = "diverged"
        else:
            true = found["true"] if twin or estimate is None else decide(estimate, claim.rule)
            effect = None if twin else estimate
            findings.append(Finding(found["label"], found["axes"], effect, true, found["text"], found["runs"]))
    verdict = conclude(claim, findings, aside)
    points = [(f.label, f.effect, f.true) for f in findings if f.effect]
    return Line(
        claim, verdict.verdict, verdict.word, verdict.counts, verdict.effect, unit(claim), points, bound(claim),
        verdict.lines, verdict.runs, older=True,
    )  # fmt: skip


def _identity(axes: Mapping[str, Any]) -> bool:
    """Whether H H† of a noisy recording fills all of R^d, in a report that compares lengths, at its longest."""
    if axes.get("projector") != "hankel" or not axes.get("recording.process_noise"):
        return False
    n, m, T = *DOUBLE_INTEGRATOR.values(), axes["task.horizon"]
    columns = axes.get("recording.length", float("inf")) - T + 1
    return bool(columns >= n * (T + 1) + m * T)


def _estimate(value: Any) -> Estimate | None:
    """Of a report or a published one; nan is null in json."""
    if value is None or isinstance(value, Estimate):
        return value
    ends = value if isinstance(value, list) else [value[end] for end in ("value", "low", "high")]
    return Estimate(*(float("nan") if end is None else end for end in ends))


def unit(claim: Claim) -> str:
    """What the effect of a claim is, in words."""
    metric = metric_name(claim.options["metric"]) if "metric" in claim.options else ""
    if "against" in claim.options:
        against = claim.options["against"]
        return f"{column_name(claim.options['metric'])} over that of {method_name(against, against)}"
    words = {
        "dip": "over that three steps before and after",
        "longest_over_shortest": "at the longest over that at the shortest",
        "steps_grew": "share of steps in which the mean distance grew",
        "projection_share": "share of the sampling time",
        "schedule_conditions": "conditions that hold",
    }
    return " ".join(filter(None, (metric, words.get(claim.statistic, ""))))


def bound(claim: Claim) -> float | None:
    """Where the effect must lie above or below; None of a range."""
    return next(iter(claim.rule.values())) if len(claim.rule) == 1 else None


def sentences(content: Mapping[str, Any], lines: list[Line]) -> list[str]:
    """What helps, what does not, and how the claims fared: three sentences made from the numbers."""
    return [*_compared(content), *_fared(lines)]


def _compared(content: Mapping[str, Any]) -> list[str]:
    """Of the first metric of the main table."""
    found = main_table(content)
    if found is None:
        return []
    table = found[1]["content"]
    metric, baseline = next(name for name in table["metrics"] if name not in PLACES), table["baseline"]
    if not baseline:
        return _extremes(table, metric)
    rows = [(row["label"], ratio_of(row, metric)) for row in table["rows"]]
    compared = [(label, ratio) for label, ratio in rows if ratio and label.split(",")[0] != baseline and ratio != SAME]
    if not compared:
        return _extremes(table, metric)
    name = column_name(metric).split(" ‖")[0]
    better = sorted((found for found in compared if found[1].high < 1), key=lambda found: found[1].value)
    worse = sorted((found for found in compared if found[1].low > 1), key=lambda found: -found[1].value)
    return [_better(name, baseline, better, len(compared)), _worse(name, worse, table["rows"])]


SAME = Estimate(1.0, 1.0, 1.0)
"""What a baseline is to itself."""


def _extremes(table: Mapping[str, Any], metric: str) -> list[str]:
    """Of a table without a baseline: who has least and who has most of a metric."""
    means = {row["label"]: found for row in table["rows"] if (found := ratio_of(row, metric, "mean"))}
    if len(means) < 2:
        return []
    least, most = (choose(means, key=lambda label: means[label].value) for choose in (min, max))
    told = [f"{label}, {column_value(metric, *astuple(means[label]))}" for label in (least, most)]
    name = column_name(metric).split(" ‖")[0]
    return [f"Of {len(means)} methods the lowest {name} is that of {told[0]}; the highest that of {told[1]}."]


PLACES = ("rank", "wins")
"""Columns of a ranked table that are no metric of a run."""


def main_table(content: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]] | None:
    """The first table with numbers, those with a baseline before others, and its name."""
    tables = [(name, part) for name, part in content["tables"].items() if part["runs"] and part["content"]["metrics"]]
    return min(tables, key=lambda found: not found[1]["content"]["baseline"], default=None)


def main_columns(table: Mapping[str, Any]) -> list[tuple[str, bool]]:
    """Four columns beside the method: the first metric, its ratio to a baseline, and those that say most of use."""
    first, *others = table["metrics"]
    told = sorted(others, key=lambda metric: OF_USE.index(metric) if metric in OF_USE else len(OF_USE))
    compared = table["baseline"] and any(ratio_of(row, first) for row in table["rows"])
    ratio = [(first, True)] if compared else []
    return [(first, False), *ratio, *((metric, False) for metric in told[: 3 - len(ratio)])]


OF_USE = (
    "wins",
    "cost_ratio",
    "collision_rollout",
    "exact_distance",
    "rollout_state_error",
    "gap",
    "dynamics_residual",
)


def ratio_of(row: Mapping[str, Any], metric: str, part: str = "ratio") -> Estimate | None:
    """A row's ratio to the baseline, or its mean; None where it has none."""
    value = row["values"].get(metric)
    return _estimate(value[part]) if value else None


def _better(name: str, baseline: str, better: list[tuple[str, Estimate]], count: int) -> str:
    if not better:
        return f"Helps: none of {count} methods has a {name} clearly below that of {baseline}."
    label, ratio = better[0]
    return (
        f"Helps: {len(better)} of {count} methods have a {name} clearly below that of {baseline}, the lowest with "
        f"{label}: {_times(ratio)}."
    )


def _worse(name: str, worse: list[tuple[str, Estimate]], rows: list[Any]) -> str:
    lost = [row["label"] for row in rows if not row["runs"]]
    gone = f" {len(lost)} gave no result ({'; '.join(lost[:3])}{'; …' if len(lost) > 3 else ''})." if lost else ""
    if not worse:
        return f"Harms: none is clearly above it.{gone}"
    label, ratio = worse[0]
    return f"Harms: {len(worse)} have a {name} clearly above it, the highest with {label}: {_times(ratio)}.{gone}"


def _times(ratio: Estimate) -> str:
    return f"{with_interval(ratio.value, ratio.low, ratio.high)} times"


def _fared(lines: list[Line]) -> list[str]:
    tested = [line for line in lines if line.word != "not tested here"]
    if not tested:
        return []
    counts = {word: sum(line.word == word for line in tested) for word in FARED}
    told = [f"{count} {FARED[word][count > 1]}" for word, count in counts.items() if count]
    if len(tested) == 1:
        return [f"The one claim tested here {_listed(told).removeprefix('1 ')}."]
    return [f"Of {len(tested)} claims tested here {_listed(told)}."]


FARED = {"holds": ("holds", "hold"), "holds in part": ("holds in part", "hold in part"),
         "does not hold": ("does not hold", "do not hold"), "undecided": ("is undecided", "are undecided")}  # fmt: skip


def _listed(words: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))

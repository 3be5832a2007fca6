"""The ledger: what the paper claims, and what the stored runs say to it.

A claim names cells, a statistic and a rule. The statistic gives a finding for each method that it tests; the rule asks
where the finding's 95 % interval lies: so, not so, or open where it lies across. The verdict is a sentence made from
the findings alone: a word, how many are so, open and not so, and the exceptions.

    all so                 holds (for 26 of 26)
    so and not so          holds only if <what sets them apart>, or holds for 22 of 26; not: <which>
    so and open            holds for 22 of 26; open: 4
    all three              holds for 22 of 26; not: <which>; open: 3
    none so                does not hold, undecided, or both by their numbers; the word is that of more
    nothing to test        not tested here

"Only" is said where nothing is open. Methods whose projector is the identity, which diverged or were refused, and those
that failed or are missing, are set aside: they are named, and count for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dadiff.errors import ConfigError
from dadiff.reporting.aggregation import Evidence, Method, in_order, varying
from dadiff.reporting.labels import axis_name, axis_value, number
from dadiff.reporting.measures import MEASURES, Measured
from dadiff.reporting.selection import described
from dadiff.reporting.statistics import Estimate

NAMED = 3
"""Methods that a verdict names, if no axis sets them apart."""

BOUNDS = ("above", "below", "at_least", "at_most")
WORDS = ("holds", "holds in part", "does not hold", "undecided", "not tested here")


@dataclass(frozen=True)
class Claim:
    """One line of the ledger.

    Args:
        id: short, for links.
        claim: what is said, in our words.
        place: where the paper says it, or that we ask it.
        statistic: a name in `MEASURES`, with its options.
        cells: the methods that test it.
        rule: bounds on the statistic: above, below, at_least, at_most.
        paper: the paper's words or figure.
        note: how we read the claim.
        diverging: whether a method that diverged refutes the claim; else it is set aside.
        short: the claim in a few words, of those that the README lists.
    """

    id: str
    claim: str
    place: str
    statistic: str
    cells: dict[str, Any]
    rule: dict[str, float]
    options: dict[str, Any] = field(default_factory=dict)
    paper: str = ""
    note: str = ""
    diverging: bool = False
    short: str = ""

    def __post_init__(self) -> None:
        if self.statistic not in MEASURES:
            raise ConfigError(f"claim {self.id}: unknown statistic {self.statistic!r}; expected {', '.join(MEASURES)}")
        if not self.rule or set(self.rule) - set(BOUNDS):
            raise ConfigError(f"claim {self.id}: rule is {self.rule}; expected bounds of {', '.join(BOUNDS)}")


@dataclass(frozen=True)
class Finding:
    """What one method says to a claim: True, False, or None where the interval does not decide.

    Args:
        effect: what a reader wants to know of it; the rule was asked of it, or of the worst of it.
    """

    label: str
    axes: dict[str, Any]
    effect: Estimate | None
    true: bool | None
    text: str
    runs: list[str]


@dataclass(frozen=True)
class Verdict:
    """A claim with its findings, and why methods that were set aside count for nothing."""

    claim: Claim
    verdict: str
    word: str
    counts: dict[str, int]
    effect: Estimate | None
    lines: list[str]
    findings: list[Finding]
    aside: dict[str, str]

    @property
    def runs(self) -> list[str]:
        """Keys of the runs that the findings rest on."""
        return list(dict.fromkeys(key for finding in self.findings for key in finding.runs))


def read_ledger(path: Path) -> list[Claim]:
    """The claims of a yaml file.

    Raises:
        ConfigError: if an entry has unknown or missing keys, or an id comes twice.
    """
    entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    try:
        claims = [Claim(**entry) for entry in entries]
    except TypeError as error:
        raise ConfigError(f"{path}: {str(error).replace('Claim.__init__() ', 'a claim ')}") from None
    if len({claim.id for claim in claims}) < len(claims):
        raise ConfigError(f"{path}: an id comes twice; every claim needs its own")
    return claims


def judge(claim: Claim, evidence: Evidence) -> Verdict:
    """The verdict on one claim."""
    findings: list[Finding] = []
    aside: dict[str, str] = {}
    for measured in _measure(claim, evidence, evidence.methods(claim.cells)):
        if measured.estimate is None and not (measured.diverged and claim.diverging):
            aside[measured.label] = measured.text
        else:
            findings.append(_finding(claim, measured))
    return conclude(claim, findings, aside)


def conclude(claim: Claim, findings: list[Finding], aside: dict[str, str]) -> Verdict:
    """The verdict that findings add up to."""
    counts = {name: sum(f.true is true for f in findings) for name, true in SAID.items()}
    lines = _lines(claim, findings, aside)
    return Verdict(claim, sentence(findings), word(counts), counts, typical(findings), lines, findings, aside)


SAID: dict[str, bool | None] = {"so": True, "open": None, "not": False}


def _measure(claim: Claim, evidence: Evidence, methods: list[Method]) -> list[Measured]:
    measure: Callable[..., list[Measured]] = MEASURES[claim.statistic]
    return measure(evidence, methods, varying(methods), **claim.options)


def _finding(claim: Claim, measured: Measured) -> Finding:
    true = False if measured.estimate is None else decide(measured.estimate, claim.rule)
    text = f"{measured.label}: {measured.text}"
    return Finding(measured.label, measured.axes, measured.effect or measured.estimate, true, text, measured.runs)


def decide(estimate: Estimate, rule: Mapping[str, float]) -> bool | None:
    """Whether the interval lies within the rule's bounds (True), outside of them (False), or across (None)."""
    low, high = estimate.low, estimate.high
    inside = {
        "above": lambda bound: low > bound,
        "below": lambda bound: high < bound,
        "at_least": lambda bound: low >= bound,
        "at_most": lambda bound: high <= bound,
    }
    outside = {
        "above": lambda bound: high <= bound,
        "below": lambda bound: low >= bound,
        "at_least": lambda bound: high < bound,
        "at_most": lambda bound: low > bound,
    }
    if all(inside[name](bound) for name, bound in rule.items()):
        return True
    return False if any(outside[name](bound) for name, bound in rule.items()) else None


def typical(findings: list[Finding]) -> Estimate | None:
    """The effect of the method in the middle; None where no method has one."""
    effects = sorted((f.effect for f in findings if f.effect is not None), key=lambda effect: effect.value)
    return effects[(len(effects) - 1) // 2] if effects else None


def word(counts: Mapping[str, int]) -> str:
    """The verdict without its numbers, one of `WORDS`: for colours and sums."""
    so, open_, no = counts["so"], counts["open"], counts["not"]
    if not so + open_ + no:
        return "not tested here"
    if so:
        return "holds in part" if open_ + no else "holds"
    return "does not hold" if no > open_ else "undecided"


def sentence(findings: list[Finding]) -> str:
    """The verdict in words.

    Example:
        >>> known, hankel = (Finding(p, {"projector": p}, None, p == "known", "", []) for p in ("known", "hankel"))
        >>> sentence([known, hankel]), sentence([known])
        ('holds only if known FF† (1 of 2)', 'holds')
    """
    so, undecided, no = ([f for f in findings if f.true is true] for true in SAID.values())
    count = len(findings)
    if not findings:
        return "not tested here"
    if count in (len(so), len(no), len(undecided)):
        verb = "holds" if so else "does not hold" if no else "undecided"
        return verb if count == 1 else f"{verb} for any of {count}" if no else f"{verb} for {count} of {count}"
    parts = [f"holds for {len(so)} of {count}"] if so else [f"does not hold for {len(no)} of {count}"]
    if so and no:
        where = shared(so, [*no, *undecided])
        if where and not undecided:
            return f"holds only if {where} ({len(so)} of {count})"
        parts.append(f"not: {shared(no, [*so, *undecided]) or named(no)}")
    return "; ".join(parts + ([f"open: {len(undecided)}"] if undecided else []))


def shared(inside: list[Finding], outside: list[Finding]) -> str:
    """The axis that tells some findings from others, in words; empty if none does."""
    for axis in in_order(name for finding in (*inside, *outside) for name in finding.axes):
        these, those = ({repr(f.axes.get(axis)): f.axes.get(axis) for f in group} for group in (inside, outside))
        if not these.keys() & those.keys() and not any(isinstance(value, list) for value in these.values()):
            return _one_of(axis, list(these.values()))
    return ""


def _one_of(axis: str, values: list[Any]) -> str:
    """Few values by name, many numbers by their range."""
    if len(values) > NAMED and all(isinstance(value, (int, float)) for value in values):
        return f"{axis_name(axis)} from {number(min(values))} to {number(max(values))}"
    return " or ".join(_value(axis, value) for value in values)


def named(findings: list[Finding]) -> str:
    """A few findings by name, many by their number."""
    if len(findings) > NAMED:
        return f"{len(findings)}, named in the details"
    return "; ".join(finding.label for finding in findings)


def _value(axis: str, value: Any) -> str:
    return f"without {axis_name(axis)}" if value is None else axis_value(axis, value)


def _lines(claim: Claim, findings: list[Finding], aside: dict[str, str]) -> list[str]:
    """What was found, a line a method; generated from the numbers."""
    words = {True: "so", False: "not so", None: "open"}
    lines = [f"{words[finding.true]}: {finding.text}" for finding in findings]
    for reason in dict.fromkeys(aside.values()):
        labels = [label for label, text in aside.items() if text == reason]
        lines.append(f"set aside ({reason}): {'; '.join(labels)}")
    return lines or [f"no cell of this sweep has {described(claim.cells)}"]

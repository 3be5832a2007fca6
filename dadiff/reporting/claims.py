"""The ledger: what the paper claims, and what the stored runs say to it.

A claim names cells, a statistic and a rule. The statistic gives a finding for each method that it tests; the rule asks
where the finding's 95 % interval lies. The verdict follows from the findings alone, and so does its text:

    all true               holds
    some false, none true  does not hold
    some true, some false  holds only if ...
    none false, some open  undecided
    nothing to test        not tested here

A method that diverged counts as false. One that is missing or failed counts as nothing and is named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dadiff.errors import ConfigError
from dadiff.reporting.aggregation import Evidence, Method, varying
from dadiff.reporting.labels import axis_name, axis_value
from dadiff.reporting.measures import MEASURES, Measured
from dadiff.reporting.selection import described
from dadiff.reporting.statistics import Estimate

NAMED = 3
"""Methods that a verdict names, if no axis sets them apart."""

BOUNDS = ("above", "below", "at_least", "at_most")


@dataclass(frozen=True)
class Claim:
    """One line of the ledger.

    Args:
        id: short, for links.
        claim: what is said, in our words.
        place: where the paper says it.
        statistic: a name in `MEASURES`, with its options.
        cells: the methods that test it.
        rule: bounds on the statistic: above, below, at_least, at_most.
        note: how we read the claim.
    """

    id: str
    claim: str
    place: str
    statistic: str
    cells: dict[str, Any]
    rule: dict[str, float]
    options: dict[str, Any] = field(default_factory=dict)
    note: str = ""

    def __post_init__(self) -> None:
        if self.statistic not in MEASURES:
            raise ConfigError(f"claim {self.id}: unknown statistic {self.statistic!r}; expected {', '.join(MEASURES)}")
        if not self.rule or set(self.rule) - set(BOUNDS):
            raise ConfigError(f"claim {self.id}: rule is {self.rule}; expected bounds of {', '.join(BOUNDS)}")


@dataclass(frozen=True)
class Finding:
    """What one method says to a claim: True, False, or None where the interval does not decide."""

    label: str
    axes: dict[str, Any]
    estimate: Estimate | None
    true: bool | None
    text: str
    runs: list[str]


@dataclass(frozen=True)
class Verdict:
    """A claim with its findings, and why methods without one have none."""

    claim: Claim
    verdict: str
    lines: list[str]
    findings: list[Finding]
    unavailable: dict[str, str]

    @property
    def runs(self) -> list[str]:
        """Keys of the runs that the findings rest on."""
        return list(dict.fromkeys(key for finding in self.findings for key in finding.runs))

    @property
    def word(self) -> str:
        """The verdict without its condition: for colours and counts."""
        return "holds only if" if self.verdict.startswith("holds only if") else self.verdict


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
    methods = evidence.methods(claim.cells)
    findings: list[Finding] = []
    unavailable: dict[str, str] = {}
    for measured in _measure(claim, evidence, methods):
        if measured.estimate is None and not measured.diverged:
            unavailable[measured.label] = measured.text
        else:
            findings.append(_finding(claim, measured))
    return Verdict(claim, _verdict(findings), _lines(claim, findings, unavailable), findings, unavailable)


def _measure(claim: Claim, evidence: Evidence, methods: list[Method]) -> list[Measured]:
    measure: Callable[..., list[Measured]] = MEASURES[claim.statistic]
    return measure(evidence, methods, varying(methods), **claim.options)


def _finding(claim: Claim, measured: Measured) -> Finding:
    true = False if measured.estimate is None else decide(measured.estimate, claim.rule)
    text = f"{measured.label}: {measured.text}"
    return Finding(measured.label, measured.axes, measured.estimate, true, text, measured.runs)


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


def _verdict(findings: list[Finding]) -> str:
    said = {finding.true for finding in findings}
    if not said:
        return "not tested here"
    if False in said:
        return f"holds only if {condition(findings)}" if True in said else "does not hold"
    return "undecided" if None in said else "holds"


def condition(findings: list[Finding]) -> str:
    """The axis that tells true findings from all others, if one does; else the true ones by name, or their number."""
    true, others = ([f for f in findings if bool(f.true) is wanted] for wanted in (True, False))
    for axis in dict.fromkeys(name for finding in findings for name in finding.axes):
        inside, outside = ({repr(f.axes.get(axis)): f.axes.get(axis) for f in group} for group in (true, others))
        if not inside.keys() & outside.keys() and not any(isinstance(value, list) for value in inside.values()):
            return " or ".join(_value(axis, value) for value in inside.values())
    if len(true) > NAMED:
        return f"the method is one of {len(true)} of {len(findings)} (named in the claim's details)"
    return "; ".join(finding.label for finding in true)


def _value(axis: str, value: Any) -> str:
    return f"without {axis_name(axis)}" if value is None else axis_value(axis, value)


def _lines(claim: Claim, findings: list[Finding], unavailable: dict[str, str]) -> list[str]:
    """What was found, a line a method; generated from the numbers."""
    words = {True: "so", False: "not so", None: "open"}
    lines = [f"{words[finding.true]}: {finding.text}" for finding in findings]
    for reason in dict.fromkeys(unavailable.values()):
        labels = [label for label, text in unavailable.items() if text == reason]
        lines.append(f"no result ({reason}): {'; '.join(labels)}")
    return lines or [f"no cell of this sweep has {described(claim.cells)}"]

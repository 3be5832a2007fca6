"""Selectors: which cells of a sweep a table, figure or claim is about.

A selector maps axes to conditions that must all hold:

    {projector: [none, known], recording.length: {above: 93}, system.process_noise: 0.01, sampler: {not: ddim}}

An axis that a cell does not have counts as null.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dadiff.errors import ConfigError
from dadiff.reporting.labels import axis_name, value_name

Selector = Mapping[str, Any]

COMPARISONS = {
    "above": lambda value, bound: value is not None and value > bound,
    "below": lambda value, bound: value is not None and value < bound,
    "not": lambda value, bound: value not in (bound if isinstance(bound, list) else [bound]),
}


def matches(axes: Mapping[str, Any], selector: Selector) -> bool:
    """Whether a cell's axes meet every condition.

    Raises:
        ConfigError: if a comparison is not one of above, below, not.
    """
    return all(_meets(axes.get(axis), condition) for axis, condition in selector.items())


def described(selector: Selector) -> str:
    """A selector in words.

    Example:
        >>> described({"projector": {"not": "none"}, "enforcement": ["literal"], "recording.length": {"above": 93}})
        'projector other than vanilla, enforcement as printed, S above 93'
    """
    return ", ".join(f"{axis_name(axis)} {_condition(axis, condition)}" for axis, condition in selector.items())


def _condition(axis: str, condition: Any) -> str:
    if isinstance(condition, Mapping):
        words = {"not": "other than"}
        return " and ".join(f"{words.get(name, name)} {_condition(axis, bound)}" for name, bound in condition.items())
    if isinstance(condition, list):
        return " or ".join(_condition(axis, value) for value in condition)
    return "none" if condition is None else value_name(axis, condition)


def _meets(value: Any, condition: Any) -> bool:
    if isinstance(condition, list):
        return value in condition
    if not isinstance(condition, Mapping):
        return bool(value == condition)
    unknown = sorted(set(condition) - set(COMPARISONS))
    if unknown:
        raise ConfigError(f"selector: unknown comparison {unknown[0]!r}; expected {', '.join(COMPARISONS)}")
    return all(COMPARISONS[name](value, bound) for name, bound in condition.items())

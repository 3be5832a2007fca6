"""Names of many methods, without what most of them share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from dadiff.reporting.aggregation import Method
from dadiff.reporting.labels import axis_value, method_name


def short_names(methods: list[Method], shown: Sequence[str]) -> tuple[list[str], str]:
    """Names of methods without the denoiser, training and sampler that most share; and which those are, in words.

    Nothing is left out of few methods, or where two would have one name.
    """
    whole = [method_name(method.axes, shown) for method in methods]
    common = {axis: _most_common(methods, axis) for axis in ("denoiser", "training", "sampler") if axis in shown}
    left_out = {axis: value for axis, value in common.items() if value is not None}
    short = [method_name(_without(method.axes, left_out), shown) for method in methods]
    if len(methods) < MANY or not left_out or len(set(short)) < len(set(whole)):
        return whole, ""
    return short, ", ".join(axis_value(axis, value) for axis, value in left_out.items())


MANY = 8


def _most_common(methods: list[Method], axis: str) -> Any:
    """The value that more than half of the methods that say theirs have, else None."""
    told = [method.axes.get(axis) for method in methods if axis != "sampler" or not _once(method.axes)]
    value, count = Counter(told).most_common(1)[0] if told else (None, 0)
    return value if 2 * count > len(told) else None


def _once(axes: Mapping[str, Any]) -> bool:
    """Whether a sampler asks once, and goes by that."""
    return bool(axes.get("sampler.num_steps") == 1)


def _without(axes: Mapping[str, Any], left_out: Mapping[str, Any]) -> dict[str, Any]:
    """Axes but for those that have these values."""
    return {
        axis: value
        for axis, value in axes.items()
        if axis not in left_out or left_out[axis] != value or (axis == "sampler" and _once(axes))
    }

"""How methods, metrics and numbers are called in print: the same words everywhere in a report."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

PROJECTORS = {
    "none": "vanilla",
    "known": "known FF†",
    "known_converged": "known, ten sweeps",
    "hankel": "Hankel HH†",
    "hankel_lowrank": "Hankel, truncated",
    "identified": "identified (A, B)",
    "identified_soft": "identified, trusted by direction",
    "identified_sparse": "identified, few terms",
    "identified_sparse_soft": "few terms, trusted by their errors",
    "identified_family": "identified within its family",
    "known_bounded": "known, within bounds",
    "known_tightened": "known, within tightened bounds",
    "known_clipped": "known, then clipped",
    "known_clipped_replayed": "known, then clipped and replayed",
    "known_clear": "known, clear of discs",
    "inpainting": "x(0) alone",
    "rollout": "roll-out",
}
ENFORCEMENTS = {
    "none": "vanilla",
    "post_hoc": "once at the end",
    "post_hoc_repeated": "at the end",
    "normalised": "every step",
    "convex": "convex",
    "clean_estimate": "on the clean estimate",
    "conditional": "conditional",
    "qp_filter": "conditional, bounds once at the end",
    "barrier": "conditional, barrier filter",
    "constricting_tube": "conditional, constricting tube",
    "literal": "as printed",
}
WORDS: dict[str, dict[str, str]] = {
    "projector": PROJECTORS,
    "enforcement": ENFORCEMENTS,
    "initial_state": {"fixed": "x(0) fixed", "free": "x(0) free"},
    "sampler.last_step_noise": {"True": "with last-step noise", "False": "without last-step noise"},
    "denoiser": {"gaussian": "exact denoiser", "moment_matched": "linear regression"},
    "enforcement.spread": {"True": "drawn from its law", "False": ""},
    "task": {"manoeuvre_pendulums": "pendulums", "manoeuvre_reachers": "reachers"},
    "projector.bounds": {"ignored": "bounds ignored", "enforced": "within bounds"},
    "projector.replay": {"True": "replayed", "False": ""},
    "evaluation": {"default": "", "closed_loop": "in closed loop", "exact": "exact"},
    "training": {"penalised": "told of the dynamics"},
    "training.projects": {"True": "projected in its loss", "False": ""},
    "projector.features": {
        "[]": "",
        "['trigonometric']": "sin, cos",
        "['constant', 'identity', 'trigonometric', 'control_affine']": "sin, cos times u",
    },
    "enforcement.metric": {
        "estimate": "metric of the estimate",
        "measured": "metric as measured",
        "diagonal": "diagonal metric",
        "standardised": "standardised metric",
        "physical": "physical metric",
    },
}
CHOICES = (*WORDS, "sampler", "schedule", "training", "system")
SYMBOLS = {
    "recording.length": "S",
    "task.robots": "robots in training",
    "dataset.train_size": "demonstrations",
    "dataset.test_ranges": "ranges of the cases",
    "training.steps": "gradient steps",
    "sampler.num_steps": "steps",
    "recording.process_noise": "σ_Γ",
    "system.process_noise": "σ_w",
}
METRICS = {
    "planned_state_error": "state error ‖x(t) − x*(t)‖²",
    "planned_input_error": "control error ‖u(t) − u*(t)‖²",
    "rollout_state_error": "state error after replay",
    "gap": "gap of plan and replay, squared",
    "gap_nrmse": "replay off its plan [deviations]",
    "dynamics_residual": "dynamics residual, squared",
    "singular_steps": "singular steps of the replay",
    "initial_state_error": "error of x(0), squared",
    "median_cost_ratio": "median cost / optimal cost",
    "robots_served": "share of robots served",
    "cost_ratio": "cost / optimal cost",
    "bounded_cost_ratio": "cost / optimal cost within bounds",
    "violation": "largest violation of bounds",
    "rollout_violation": "largest violation of bounds after replay",
    "violating": "share of plans that violate bounds",
    "largest_violation": "largest violation of bounds of all plans",
    "unconverged": "plans without a projection",
    "infeasible": "plans proven to have none within limits",
    "prediction_error": "prediction error over T [deviations]",
    "model_cost_ratio": "cost of optima of the model / optimal cost",
    "recording_residual": "residual / noise of the recording",
    "offset_residual": "residual / noise of the recording without its offset",
    "demonstrations_residual": "residual / noise of the demonstrations",
    "cases_residual": "residual / noise of the test cases",
    "also_in_train": "test cases in train",
    "outside_training": "test cases far outside of training",
    "principal_angle": "largest principal angle [rad]",
    "sampling_seconds": "sampling time [s]",
    "projection_seconds": "time per projection [s]",
    "projector_setup_seconds": "projector set-up [s]",
    "network_calls": "network calls",
    "spread": "spread of a case's plans, trace of the covariance",
    "spread_ratio": "spread / spread of the demonstrations' law",
    "state_spread_ratio": "spread of states / that of the expert's runs",
    "rank": "median rank over cases",
    "wins": "share of cases better than the baseline",
    "energy_distance": "energy distance to fresh runs of the expert",
    "coverage": "fresh runs of the expert within the plans' range, over its expectation",
    "exact_distance": "distance to the right law",
    "exact_mean_distance": "distance of the means",
    "exact_spread": "spread / spread of the right law",
    "plan_latency": "time of one plan [s]",
    "success": "share of success after replay",
    "success_chosen": "success of the chosen plan",
    "collision_chosen": "collision of the chosen plan",
    "state_error_chosen": "state error of the chosen plan",
    "cost_ratio_chosen": "cost / optimal cost of the chosen plan",
    "cost_ratio_successful": "cost / optimal cost of successes",
    "successful_plans": "number of successes",
    "collision_rollout": "share in collision after replay",
    "collision_planned": "share in collision, as planned",
    "waypoint_distance_1_planned": "distance to waypoint 1, as planned [m]",
    "waypoint_distance_2_planned": "distance to waypoint 2, as planned [m]",
    "waypoint_distance_1_rollout": "distance to waypoint 1 after replay [m]",
    "waypoint_distance_2_rollout": "distance to waypoint 2 after replay [m]",
    "waypoint_distance_target_rollout": "distance to the target after replay [m]",
    "collision_at_samples_rollout": "share in collision at samples, after replay",
    "depth_rollout": "depth of collision after replay [m]",
    "clearance_rollout": "clearance after replay [m]",
    "side_agreement_rollout": "same side as the expert, after replay",
}
ROUNDING = 1e-18
"""Below this a squared error is that of the arithmetic."""


def rounding(metric: str) -> float:
    """Below this a metric is that of the arithmetic: of squares `ROUNDING`, of distances its root."""
    return math.sqrt(ROUNDING) if metric.endswith("_distance") else ROUNDING


FLOORS = {"cost_ratio": 1.0, "median_cost_ratio": 1.0}
"""What metrics cannot go below, where it is not 0: a cost over the optimal cost."""

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


EPISODES = re.compile(r"closed_loop_(?P<what>|same_|time_)(?P<controller>[a-z]+)_(?P<every>\d+)")
OVER = {"": "", "same_": " / the expert's", "time_": ": time / the expert's"}


def metric_name(metric: str) -> str:
    """A metric in words."""
    if match := EPISODES.fullmatch(metric):
        return f"{match['controller']}, every {match['every']}{OVER[match['what']]}"
    return METRICS.get(metric, metric.replace("_", " "))


def column_name(metric: str) -> str:
    """A metric as the head of a column, where what lies above its floor is shown."""
    return f"{metric_name(metric)} − 1" if metric in FLOORS else metric_name(metric)


def column_value(metric: str, value: float, low: float, high: float) -> str:
    """A metric and its interval in a column: above its floor, and `exact` where it is rounding.

    Example:
        >>> column_value("cost_ratio", 1.25, 1.125, 1.5), column_value("gap", 1e-30, 0, 1e-29)
        ('0.250 [0.125, 0.500]', 'exact')
    """
    floor = FLOORS.get(metric, 0.0)
    if metric.endswith(("_error", "gap", "_residual", "_distance")) and value < rounding(metric):
        return "exact"
    return with_interval(value - floor, low - floor, high - floor)


def axis_name(axis: str) -> str:
    """An axis as a short symbol, or its last name."""
    return SYMBOLS.get(axis, axis.split(".")[-1].replace("_", " "))


def method_name(axes: Mapping[str, Any], shown: Iterable[str] = ()) -> str:
    """A method by its projector, and by those of the axes in `shown` that it has.

    Where enforcements are told apart and projectors are not, it goes by its enforcement.

    Example:
        >>> method_name({"projector": "hankel", "recording.length": 100}, ["recording.length"])
        'Hankel HH†, S = 100'
        >>> method_name({"projector": "known", "enforcement": "none", "sampler.num_steps": 1}, ["enforcement"])
        'vanilla'
    """
    shown = list(shown)
    projector = value_name("projector", axes.get("projector", "?"))
    by_enforcement = "enforcement" in shown and "projector" not in shown and axes.get("enforcement") is not None
    words = [] if by_enforcement or (shown and "projector" not in axes) else [projector]
    words += [_axis_word(axis, axes, shown) for axis in shown if axes.get(axis) is not None and axis != "projector"]
    return ", ".join(filter(None, words))


def _axis_word(axis: str, axes: Mapping[str, Any], shown: list[str]) -> str:
    """One condition of a method in words; a sampler of one step goes by that."""
    if axis in ("sampler", "sampler.num_steps") and axes.get("sampler.num_steps") == 1:
        return "one call" if axis == "sampler" or "sampler" not in shown else ""
    return axis_value(axis, axes[axis])


def axis_value(axis: str, value: Any) -> str:
    """One condition in words, for example `S = 100` or `every step`."""
    return value_name(axis, value) if axis in CHOICES else f"{axis_name(axis)} = {value_name(axis, value)}"


def value_name(axis: str, value: Any) -> str:
    """What an axis is set to, in words."""
    return WORDS.get(axis, {}).get(str(value), format(value, "g") if isinstance(value, float) else str(value))


def number(value: float | None, digits: int = 3) -> str:
    """A number to three significant digits; very large and very small ones with a power of ten.

    Example:
        >>> number(0.123456), number(1.5e-7), number(float("nan"))
        ('0.123', '1.50·10⁻⁷', '–')
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == round(value) and abs(value) < 1e4:
        return f"{value:.0f}".replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")  # rounded before its decimals are counted
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:.{max(digits - 1 - int(exponent), 0)}f}".replace("-", "−")
    return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPT)}".replace("-", "−")


def with_interval(value: float, low: float, high: float) -> str:
    """A value and its 95 % interval, if it has any width, with as many digits as tell its ends apart.

    Example:
        >>> with_interval(1.0058, 1.0041, 1.0079)
        '1.0058 [1.0041, 1.0079]'
    """
    if math.isnan(low) or math.isclose(low, high, rel_tol=1e-6):
        return number(value)
    digits = _telling(value, low, high)
    return f"{number(value, digits)} [{number(low, digits)}, {number(high, digits)}]"


def _telling(value: float, low: float, high: float) -> int:
    """Significant digits that show the width of an interval with two of its own; 3 to 6."""
    if not (math.isfinite(high) and value > 0):
        return 3
    return min(max(3, math.floor(math.log10(value)) - math.floor(math.log10(high - low)) + 2), 6)


def joint(one: str, other: str) -> str:
    """A name for two methods that are drawn as one; what they share in front is said once.

    Example:
        >>> joint("vanilla", "known FF†, ddpm"), joint("known FF†, x(0) free, ddpm", "known FF†, x(0) free, ddim")
        ('vanilla = known FF†, ddpm', 'known FF†, x(0) free, ddpm = ddim')
    """
    words, rest = one.split(" = ")[0].split(", "), other.split(", ")
    while len(rest) > 1 and words and words[0] == rest[0]:
        words, rest = words[1:], rest[1:]
    return f"{one} = {', '.join(rest)}"

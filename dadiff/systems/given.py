"""Systems that are handed in: matrices from yaml, and state-space systems of python-control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems.integrators import discretise
from dadiff.systems.linear import Linear, stacked
from dadiff.systems.system import Bounds, Limits

if TYPE_CHECKING:
    from control import StateSpace


def inline(
    A: Sequence[Sequence[float]],
    B: Sequence[Sequence[float]],
    c: Sequence[float] | None = None,
    process_noise: float | Sequence[float] = 0.0,
    time_step: float | None = None,
    bounds: Limits | None = None,
    state_names: Sequence[str] = (),
    input_names: Sequence[str] = (),
    state_units: Sequence[str] = (),
    input_units: Sequence[str] = (),
) -> Linear:
    """x(t+1) = A x(t) + B u(t) + c + w(t) from lists of rows: what `conf/system/inline.yaml` names.

    Args:
        A, B, c, process_noise, time_step: see `Linear`.
        bounds: any of input_low, input_high, state_low, state_high.
        state_names, input_names, state_units, input_units: for figures and tables; one for each, or none.

    Example:
        >>> inline([[1, 0.1], [0, 1]], [[0], [0.1]], bounds={"input_high": 2}).bounds.input_high.item()
        2.0
    """
    return Linear(
        stacked(A, "A"),
        stacked(B, "B"),
        np.zeros(len(A)) if c is None else stacked(c, "c"),
        process_noise=process_noise,
        time_step=time_step,
        bounds=Bounds.of(bounds),
        state_names=tuple(state_names),
        input_names=tuple(input_names),
        state_units=tuple(state_units),
        input_units=tuple(input_units),
    )


def from_control(
    ss: StateSpace,
    time_step: float | None = None,
    method: Literal["euler", "zoh"] = "zoh",
    process_noise: float | Sequence[float] = 0.0,
    bounds: Limits | None = None,
) -> Linear:
    """The states and inputs of a python-control system; its outputs are left aside, states are taken as measured.

    Args:
        ss: continuous (dt = 0), which is discretised, or discrete.
        time_step: in seconds; may be left out where the system is discrete and states it.
        method: of discretisation.
        process_noise, bounds: see `inline`.

    Raises:
        ConfigError: if it is no StateSpace, a continuous one comes without a time step, or a discrete one has another.
    """
    import control

    if not isinstance(ss, control.StateSpace):
        raise ConfigError(
            f"system: from_control takes a StateSpace, found a {type(ss).__name__}; convert it by control.ss"
        )
    step, (A, B) = _step_of(ss, time_step), (ss.A, ss.B)
    if ss.dt == 0:
        A, B = discretise(A, B, step, method)
    return inline(
        A,
        B,
        process_noise=process_noise,
        time_step=step,
        bounds=bounds,
        state_names=_own(ss.state_labels, "x"),
        input_names=_own(ss.input_labels, "u"),
    )


def _step_of(ss: StateSpace, time_step: float | None) -> float:
    """The time step that both agree on; dt is True where a discrete system does not say."""
    stated = None if ss.dt is None or ss.dt is True or ss.dt == 0 else float(ss.dt)
    if ss.dt is None:
        raise ConfigError("system: the ss says not whether it is continuous (dt = 0) or discrete; set its dt")
    if stated is not None and time_step is not None and not np.isclose(stated, time_step, rtol=1e-9, atol=0):
        raise ConfigError(
            f"system: the ss is discrete with dt = {stated} s, time_step is {time_step}; leave time_step out, "
            "or hand in the continuous system"
        )
    step = time_step if stated is None else stated
    if step is None:
        kind = "continuous" if ss.dt == 0 else "discrete without a stated step"
        raise ConfigError(f"system: the ss is {kind} and time_step is missing; give it (seconds)")
    return step


def _own(labels: Sequence[str], default: str) -> tuple[str, ...]:
    """The labels, unless they are those that python-control makes up: x[0], x[1], ..."""
    made_up = [f"{default}[{k}]" for k in range(len(labels))]
    return () if list(labels) == made_up else tuple(labels)

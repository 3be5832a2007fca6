"""A system of which nothing is known but its sizes: what learns from data plans for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems.system import Bounds, Limits, System, Times

LEARNED = (
    "use dataset=npz for demonstrations, and a projector that learns from recording=npz or from them "
    "(such as projector=identified), or projector=none"
)


@dataclass(frozen=True, kw_only=True)
class Unknown(System):
    """n states and m inputs, without dynamics: nothing can be simulated, replayed or solved.

    Args:
        states: n.
        inputs: m.
    """

    states: int
    inputs: int

    def __post_init__(self) -> None:
        for name in ("states", "inputs"):
            if getattr(self, name) < 1:
                raise ConfigError(f"system: {name} is {getattr(self, name)}; it must be at least 1")
        self.check()

    @property
    def state_dim(self) -> int:
        """n."""
        return self.states

    @property
    def input_dim(self) -> int:
        """m."""
        return self.inputs

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> NoReturn:
        """None.

        Raises:
            NotApplicableError: always.
        """
        raise NotApplicableError(f"system: it is unknown, so that nothing can be simulated with it; {LEARNED}")

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> NoReturn:
        """None; see `step`."""
        self.step(x, u, t)


def unknown(
    states: int,
    inputs: int,
    time_step: float | None = None,
    bounds: Limits | None = None,
    state_names: Sequence[str] = (),
    input_names: Sequence[str] = (),
    state_units: Sequence[str] = (),
    input_units: Sequence[str] = (),
) -> Unknown:
    """An unknown system: what `conf/system/unknown.yaml` names.

    Args:
        states, inputs: how many there are.
        time_step: seconds, which files are held against.
        bounds: any of input_low, input_high, state_low, state_high.
        state_names, input_names, state_units, input_units: for figures and tables; one for each, or none.
    """
    return Unknown(
        states=states,
        inputs=inputs,
        time_step=time_step,
        bounds=Bounds.of(bounds),
        state_names=tuple(state_names),
        input_names=tuple(input_names),
        state_units=tuple(state_units),
        input_units=tuple(input_units),
    )

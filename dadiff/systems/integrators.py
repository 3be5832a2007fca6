"""Integrators: the double integrator of the paper's experiments (Section IV-A)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError
from dadiff.memory import check_fits
from dadiff.systems.linear import Linear
from dadiff.systems.system import Bounds, Limits


def discretise(
    A: np.ndarray, B: np.ndarray, time_step: float, method: Literal["euler", "zoh"]
) -> tuple[np.ndarray, np.ndarray]:
    """Discrete (A, B) of dx/dt = A x + B u: forward Euler, or zero-order hold by python-control.

    Args:
        time_step: in seconds.
    """
    if not time_step > 0:
        raise ConfigError(f"system: time_step is {time_step}; it must be positive (seconds)")
    if method == "euler":
        return np.eye(len(A)) + time_step * A, time_step * B
    import control  # which takes longer to load than most cells to plan

    continuous = control.ss(A, B, np.eye(len(A)), np.zeros_like(B))
    discrete = control.c2d(continuous, time_step, method=method)
    return discrete.A, discrete.B


def double_integrator(
    axes: int = 2,
    time_step: float = 0.1,
    discretisation: Literal["euler", "zoh"] = "euler",
    process_noise: float | Sequence[float] = 0.01,
    bounds: Limits | None = None,
) -> Linear:
    """Positions and velocities driven by accelerations: n = 2 axes, m = axes.

    With two axes, forward Euler and a time step of 0.1 s these are the A, B of the paper's Section IV-A.

    Args:
        axes: number of spatial axes.
        time_step: in seconds.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: any of input_low, input_high, state_low, state_high; a number, or one for each entry.
    """
    if axes < 1:
        raise ConfigError(f"system: axes is {axes}; it must be at least 1")
    check_fits(2 * 8 * (2 * axes) ** 2, f"system: axes={axes}")
    zero, one = np.zeros((axes, axes)), np.eye(axes)
    A, B = np.block([[zero, one], [zero, zero]]), np.vstack([zero, one])
    A, B = discretise(A, B, time_step, discretisation)
    names = "xyz" if axes <= 3 else ()
    return Linear(
        A,
        B,
        process_noise=process_noise,
        time_step=time_step,
        bounds=Bounds.of(bounds),
        state_names=(*names[:axes], *(f"v{name}" for name in names[:axes])),
        input_names=tuple(f"a{name}" for name in names[:axes]),
        state_units=("m",) * axes + ("m/s",) * axes,
        input_units=("m/s²",) * axes,
    )

"""Linear time-invariant systems x(t+1) = A x(t) + B u(t) + w(t), eq. (1) of the paper."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.response import layout_of, simulate, trajectory_map


@dataclass(frozen=True)
class LinearSystem:
    """One system, or a fleet of them along leading dimensions.

    Args:
        A: (*robots, n, n).
        B: (*robots, n, m).
        process_noise: standard deviation of w(t) per state and step, in the units of the state; a number, or (n,).

    Raises:
        ShapeError: if A is not square, B has another number of rows, or their leading dimensions differ.
        ConfigError: if an entry is not finite or the noise is negative.
    """

    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    process_noise: float | np.ndarray = 0.0

    def __post_init__(self) -> None:
        A, B = _stacked(self.A, "A"), _stacked(self.B, "B")
        object.__setattr__(self, "A", A)
        object.__setattr__(self, "B", B)
        if A.ndim < 2 or A.shape[-1] != A.shape[-2] or B.ndim < 2 or B.shape[:-1] != A.shape[:-1]:
            raise ShapeError(f"system: A has shape {A.shape} and B {B.shape}; expected (..., n, n) and (..., n, m)")
        if not (np.isfinite(A).all() and np.isfinite(B).all()):
            raise ConfigError("system: A or B holds a value that is not finite")
        if not ((noise := np.asarray(self.process_noise)) >= 0).all() or np.isinf(noise).any():
            raise ConfigError(
                f"system: process_noise is {self.process_noise}; a standard deviation is finite and not negative"
            )

    @property
    def state_dim(self) -> int:
        """n."""
        return self.A.shape[-1]

    @property
    def input_dim(self) -> int:
        """m."""
        return self.B.shape[-1]

    @property
    def robots(self) -> tuple[int, ...]:
        """Leading dimensions: () for a single system."""
        return self.A.shape[:-2]

    def layout(self, horizon: int) -> TrajectoryLayout:
        """The layout of this system's trajectories over T inputs."""
        return layout_of(self.A, self.B, horizon)

    def trajectory_map(self, horizon: int) -> np.ndarray:
        """F of shape (*robots, d, n + mT), eq. (4)."""
        return trajectory_map(self.A, self.B, horizon)

    def simulate(self, x_init: np.ndarray, inputs: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """States (*robots, ..., T+1, n) of a roll-out; without noise unless it is given."""
        return simulate(self.A, self.B, x_init, inputs, noise)


def _stacked(matrices: object, name: str) -> np.ndarray:
    """One array from a matrix, an array of them, or a list of one a robot."""
    shapes = {np.shape(M) for M in matrices} if isinstance(matrices, list | tuple) else set()
    if len(shapes) > 1:
        raise ShapeError(f"system: the robots' {name} have shapes {sorted(shapes)}; all robots must share n and m")
    return np.asarray(matrices, dtype=np.float64)

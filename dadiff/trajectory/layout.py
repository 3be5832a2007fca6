"""The layout of a flat trajectory: the one place that knows the order of states and inputs.

A trajectory is tau = [x(0); ...; x(T); u(0); ...; u(T-1)] in R^d with d = n(T+1) + mT (Section II).
Works on numpy arrays and torch tensors alike; leading dimensions are batch dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dadiff.errors import ShapeError

Array = Any  # numpy.ndarray or torch.Tensor


def _concatenate(parts: list[Array]) -> Array:
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts, axis=-1)
    import torch

    return torch.cat(parts, dim=-1)


@dataclass(frozen=True)
class Layout:
    """Sizes of a trajectory and the maps between its flat and its structured form.

    Args:
        state_dim: n.
        input_dim: m.
        horizon: T, the number of inputs; there are T + 1 states.

    Example:
        >>> layout = Layout(state_dim=4, input_dim=2, horizon=30)
        >>> layout.size, layout.rank
        (184, 64)
    """

    state_dim: int
    input_dim: int
    horizon: int

    def __post_init__(self) -> None:
        for name in ("state_dim", "input_dim", "horizon"):
            if (value := getattr(self, name)) < 1:
                raise ShapeError(f"layout: {name} is {value}; it must be at least 1")

    @property
    def size(self) -> int:
        """d = n(T+1) + mT, the length of a flat trajectory."""
        return self.num_state_entries + self.input_dim * self.horizon

    @property
    def rank(self) -> int:
        """n + mT, the degrees of freedom of an admissible trajectory: x(0) and the inputs."""
        return self.state_dim + self.input_dim * self.horizon

    @property
    def num_state_entries(self) -> int:
        """n(T+1): the first entries of tau are states, the rest are inputs."""
        return self.state_dim * (self.horizon + 1)

    @property
    def initial_state(self) -> slice:
        """Where x(0) lies in tau."""
        return slice(0, self.state_dim)

    @property
    def all_states(self) -> slice:
        """Where x(0:T) lies in tau."""
        return slice(0, self.num_state_entries)

    @property
    def all_inputs(self) -> slice:
        """Where u(0:T-1) lies in tau."""
        return slice(self.num_state_entries, self.size)

    def states(self, tau: Array) -> Array:
        """x(0:T) of shape (..., T+1, n)."""
        self.check(tau)
        return tau[..., self.all_states].reshape(*tau.shape[:-1], self.horizon + 1, self.state_dim)

    def inputs(self, tau: Array) -> Array:
        """u(0:T-1) of shape (..., T, m)."""
        self.check(tau)
        return tau[..., self.all_inputs].reshape(*tau.shape[:-1], self.horizon, self.input_dim)

    def split(self, tau: Array) -> tuple[Array, Array]:
        """(states, inputs) of shapes (..., T+1, n) and (..., T, m)."""
        return self.states(tau), self.inputs(tau)

    def flatten(self, states: Array, inputs: Array) -> Array:
        """tau of shape (..., d) from states (..., T+1, n) and inputs (..., T, m).

        Raises:
            ShapeError: if either shape disagrees with the layout.
        """
        for what, array, expected in (
            ("states", states, (self.horizon + 1, self.state_dim)),
            ("inputs", inputs, (self.horizon, self.input_dim)),
        ):
            if tuple(array.shape[-2:]) != expected:
                raise ShapeError(
                    f"{what} have shape {tuple(array.shape)}; expected (..., {', '.join(map(str, expected))})"
                )
        return _concatenate(
            [
                states.reshape(*states.shape[:-2], self.num_state_entries),
                inputs.reshape(*inputs.shape[:-2], self.input_dim * self.horizon),
            ]
        )

    def check(self, tau: Array) -> None:
        """Raise `ShapeError` unless tau is (..., d)."""
        if tau.shape[-1] != self.size:
            raise ShapeError(
                f"trajectory has {tau.shape[-1]} entries; n = {self.state_dim}, m = {self.input_dim}, "
                f"T = {self.horizon} need n(T+1) + mT = {self.size}"
            )

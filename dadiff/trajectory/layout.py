"""Layouts of flat vectors: the one place that knows the order of what lies in them.

A `Layout` is an ordered list of named channels. A trajectory is one, tau = [x(0); ...; x(T); u(0); ...; u(T-1)] in R^d
with d = n(T+1) + mT (Section II): channels x over 0..T and u over 0..T-1. The condition E is another: x_init, target
and whatever else a task tells the network.
Works on numpy arrays and torch tensors alike; leading dimensions are batch dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dadiff.errors import ShapeError

Array = Any  # numpy.ndarray or torch.Tensor


def concatenate(parts: Sequence[Array]) -> Array:
    """Arrays side by side along the last axis; numpy with numpy, torch with torch."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts, axis=-1)
    import torch

    return torch.cat(list(parts), dim=-1)


@dataclass(frozen=True)
class Channel:
    """A named vector, or one at each of the steps first..last.

    Args:
        name: by which it is read.
        dim: its length at one step.
        first, last: its steps, both included; `last=None` is a vector that stands outside of time.
        labels, units: a name and a unit for each entry, or none; layouts that differ in these only are equal.
    """

    name: str
    dim: int
    first: int = 0
    last: int | None = None
    labels: tuple[str, ...] = field(default=(), compare=False)
    units: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        if self.dim < 0 or (self.last is not None and self.last < self.first - 1):
            raise ShapeError(f"channel {self.name}: dim is {self.dim}, steps {self.first}..{self.last}; not a size")
        for what in ("labels", "units"):
            if (found := getattr(self, what)) and len(found) != self.dim:
                raise ShapeError(f"channel {self.name}: {len(found)} {what} for {self.dim} entries; give one for each")

    @property
    def shape(self) -> tuple[int, ...]:
        """(dim,) outside of time, else (steps, dim)."""
        return (self.dim,) if self.last is None else (self.last - self.first + 1, self.dim)

    @property
    def size(self) -> int:
        """How many entries it takes."""
        return int(np.prod(self.shape))


@dataclass(frozen=True)
class Layout:
    """Named channels, one after the other.

    Args:
        channels: in their order; within one, time runs slowest.

    Example:
        >>> layout = Layout((Channel("x_init", 4), Channel("target", 2)))
        >>> layout.size, layout.where("target")
        (6, slice(4, 6, None))
    """

    channels: tuple[Channel, ...]

    def __post_init__(self) -> None:
        if len(set(self.names)) < len(self.channels):
            raise ShapeError(f"layout: channels {', '.join(self.names)}; every name may stand once")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the channels, in their order."""
        return tuple(channel.name for channel in self.channels)

    @cached_property
    def size(self) -> int:
        """d, the length of a flat vector."""
        return sum(channel.size for channel in self.channels)

    @cached_property
    def _places(self) -> dict[str, tuple[slice, Channel]]:
        ends = np.cumsum([0, *(channel.size for channel in self.channels)]).tolist()
        return {c.name: (slice(ends[k], ends[k + 1]), c) for k, c in enumerate(self.channels)}

    def _find(self, name: str) -> tuple[slice, Channel]:
        if name not in self._places:
            raise ShapeError(f"layout: has no channel '{name}'; found {', '.join(self.names) or 'none'}")
        return self._places[name]

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def channel(self, name: str) -> Channel:
        """The channel of this name."""
        return self._find(name)[1]

    def where(self, name: str) -> slice:
        """Where a channel lies in a flat vector.

        Raises:
            ShapeError: if there is none of this name.
        """
        return self._find(name)[0]

    def get(self, flat: Array, name: str) -> Array:
        """A channel of flat vectors (..., d): (..., dim) outside of time, else (..., steps, dim)."""
        self.check(flat)
        where, channel = self._find(name)
        return flat[..., where].reshape(*flat.shape[:-1], *channel.shape)

    def unpack(self, flat: Array) -> dict[str, Array]:
        """All channels by name, see `get`."""
        return {name: self.get(flat, name) for name in self.names}

    def pack(self, **arrays: Array) -> Array:
        """Flat vectors (..., d) from one array for each channel; `unpack` undoes it.

        Raises:
            ShapeError: if a channel is missing, not known, or has another shape.
        """
        if unknown := [name for name in arrays if name not in self]:
            raise ShapeError(f"layout: has no channel '{unknown[0]}'; expected {', '.join(self.names)}")
        parts = []
        for channel in self.channels:
            if channel.name not in arrays:
                raise ShapeError(f"layout: '{channel.name}' is missing; expected {', '.join(self.names)}")
            parts.append(_flat(arrays[channel.name], channel))
        return concatenate(parts)

    def check(self, flat: Array) -> None:
        """Raise `ShapeError` unless flat is (..., d)."""
        if flat.shape[-1] != self.size:
            sizes = ", ".join(f"{channel.name} ({channel.size})" for channel in self.channels)
            raise ShapeError(f"layout: found {flat.shape[-1]} entries; {sizes} make {self.size}")


def _flat(array: Array, channel: Channel, name: str | None = None) -> Array:
    """(..., *shape) to (..., size)."""
    rank = len(channel.shape)
    if tuple(array.shape[-rank:]) != channel.shape:
        raise ShapeError(
            f"{name or channel.name} have shape {tuple(array.shape)}; expected "
            f"(..., {', '.join(map(str, channel.shape))})"
        )
    return array.reshape(*array.shape[:-rank], channel.size)


class TrajectoryLayout(Layout):
    """Trajectories of n states over 0..T and m inputs over 0..T-1.

    Args:
        state_dim: n.
        input_dim: m.
        horizon: T, the number of inputs; there are T + 1 states.
        state_names, input_names, state_units, input_units: one for each, or none.

    Example:
        >>> layout = TrajectoryLayout(state_dim=4, input_dim=2, horizon=30)
        >>> layout.size, layout.rank
        (184, 64)
    """

    def __init__(
        self,
        state_dim: int,
        input_dim: int,
        horizon: int,
        *,
        state_names: tuple[str, ...] = (),
        input_names: tuple[str, ...] = (),
        state_units: tuple[str, ...] = (),
        input_units: tuple[str, ...] = (),
    ) -> None:
        for name, value in (("state_dim", state_dim), ("input_dim", input_dim), ("horizon", horizon)):
            if value < 1:
                raise ShapeError(f"layout: {name} is {value}; it must be at least 1")
        states = Channel("x", state_dim, 0, horizon, state_names, state_units)
        inputs = Channel("u", input_dim, 0, horizon - 1, input_names, input_units)
        super().__init__((states, inputs))

    def __repr__(self) -> str:
        return f"TrajectoryLayout(n={self.state_dim}, m={self.input_dim}, T={self.horizon})"

    @property
    def state_dim(self) -> int:
        """n."""
        return self.channels[0].dim

    @property
    def input_dim(self) -> int:
        """m."""
        return self.channels[1].dim

    @property
    def horizon(self) -> int:
        """T, the number of inputs."""
        return self.channels[1].shape[0]

    @property
    def state_names(self) -> tuple[str, ...]:
        """One for each state, or none."""
        return self.channels[0].labels

    @property
    def input_names(self) -> tuple[str, ...]:
        """One for each input, or none."""
        return self.channels[1].labels

    @property
    def state_units(self) -> tuple[str, ...]:
        """One for each state, or none."""
        return self.channels[0].units

    @property
    def input_units(self) -> tuple[str, ...]:
        """One for each input, or none."""
        return self.channels[1].units

    @property
    def rank(self) -> int:
        """n + mT, the degrees of freedom of an admissible trajectory: x(0) and the inputs."""
        return self.state_dim + self.channels[1].size

    @property
    def initial_state(self) -> slice:
        """Where x(0) lies in tau."""
        return slice(0, self.state_dim)

    @property
    def all_states(self) -> slice:
        """Where x(0:T) lies in tau."""
        return self.where("x")

    @property
    def all_inputs(self) -> slice:
        """Where u(0:T-1) lies in tau."""
        return self.where("u")

    def states(self, tau: Array) -> Array:
        """x(0:T) of shape (..., T+1, n)."""
        return self.get(tau, "x")

    def inputs(self, tau: Array) -> Array:
        """u(0:T-1) of shape (..., T, m)."""
        return self.get(tau, "u")

    def split(self, tau: Array) -> tuple[Array, Array]:
        """(states, inputs) of shapes (..., T+1, n) and (..., T, m)."""
        return self.states(tau), self.inputs(tau)

    def flatten(self, states: Array, inputs: Array) -> Array:
        """tau of shape (..., d) from states (..., T+1, n) and inputs (..., T, m).

        Raises:
            ShapeError: if either shape disagrees with the layout.
        """
        x, u = self.channels
        return concatenate([_flat(states, x, "states"), _flat(inputs, u, "inputs")])

    def check(self, flat: Array) -> None:
        """Raise `ShapeError` unless flat is (..., d)."""
        if flat.shape[-1] != self.size:
            raise ShapeError(
                f"trajectory has {flat.shape[-1]} entries; n = {self.state_dim}, m = {self.input_dim}, "
                f"T = {self.horizon} need n(T+1) + mT = {self.size}"
            )

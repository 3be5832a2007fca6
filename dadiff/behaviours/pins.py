"""Pins: entries of tau that are given plan by plan, such as x(0), a measured past or a terminal state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.trajectory.layout import TrajectoryLayout


@dataclass(frozen=True)
class Pin:
    """tau[where] = values.

    Args:
        where: a slice of tau, or indices (k,).
        values: (*robots, plans..., k) in physical units, one row for each plan, or a single one for all.

    Example:
        >>> pin = Pin.initial_state(TrajectoryLayout(4, 2, 30), np.zeros((100, 4)))
    """

    where: slice | np.ndarray
    values: np.ndarray = field(repr=False)

    @classmethod
    def initial_state(cls, layout: TrajectoryLayout, x_init: np.ndarray) -> Pin:
        """x(0) = x_init (*robots, plans..., n)."""
        return cls(layout.initial_state, x_init)

    @classmethod
    def terminal_state(cls, layout: TrajectoryLayout, x: np.ndarray) -> Pin:
        """x(T) = x (*robots, plans..., n)."""
        return cls(np.arange(layout.size)[layout.all_states][-layout.state_dim :], x)


@dataclass(frozen=True)
class Pinned:
    """All pins of a projection in one.

    Args:
        places: indices (k,), none twice.
        values: (*robots, plans, k); plans is 1 where one row serves all.
    """

    places: np.ndarray
    values: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, pins: Sequence[Pin], layout: TrajectoryLayout, robots: tuple[int, ...]) -> Pinned:
        """Several pins as one.

        Raises:
            ShapeError: if a pin's values disagree with its places or with the robots.
            ConfigError: if two pins hold the same entry.
        """
        if not pins:
            return cls(np.zeros(0, dtype=np.int64), np.zeros((*robots, 1, 0)))
        places = [np.arange(layout.size)[pin.where] for pin in pins]
        values = [_rows(pin.values, len(place), robots) for pin, place in zip(pins, places, strict=True)]
        plans = max(rows.shape[-2] for rows in values)
        together = np.concatenate(places)
        if len(np.unique(together)) < len(together):
            raise ConfigError("projection: two pins hold the same entry of tau; give each entry to one pin")
        return cls(together, np.concatenate([np.broadcast_to(v, (*robots, plans, v.shape[-1])) for v in values], -1))


def _rows(values: np.ndarray, count: int, robots: tuple[int, ...]) -> np.ndarray:
    if values.shape[-1:] != (count,) or values.shape[: len(robots)] != robots:
        raise ShapeError(
            f"projection: a pin of {count} entries has values of shape {values.shape}; "
            f"expected {(*robots, '...', count)}, robots first"
        )
    return values.reshape(*robots, -1, count)

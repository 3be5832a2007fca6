"""The coordinates in which diffusion and projection act: z = (tau - mean) / scale, entry by entry.

The paper works in physical units. In scaled coordinates the admissible set im F becomes the affine set
D^-1 (im F - mean), and the orthogonal projection minimises |D^-1 (tau - tau')| in physical units:
the metric is a choice, and this is where it is made.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import ConfigError
from dadiff.trajectory.layout import Array, TrajectoryLayout


@dataclass(frozen=True)
class Coordinates:
    """z = (tau - mean) / scale.

    Args:
        mean: (d,), in physical units.
        scale: (d,), in physical units, positive.
    """

    mean: np.ndarray = field(repr=False)
    scale: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        if not ((self.scale > 0).all() and np.isfinite(self.scale).all() and np.isfinite(self.mean).all()):
            raise ConfigError("coordinates: every scale must be positive and finite, every mean finite")

    def to_scaled(self, tau: Array) -> Array:
        """z from tau (..., d); numpy or torch."""
        return (tau - _like(self.mean, tau)) / _like(self.scale, tau)

    def to_physical(self, z: Array) -> Array:
        """tau from z (..., d); numpy or torch."""
        return z * _like(self.scale, z) + _like(self.mean, z)


def _like(vector: np.ndarray, array: Array) -> Array:
    return vector if isinstance(array, np.ndarray) else array.new_tensor(vector)


def physical(layout: TrajectoryLayout) -> Coordinates:
    """The identity: z = tau, as in the paper."""
    return Coordinates(np.zeros(layout.size), np.ones(layout.size))


def standardised(layout: TrajectoryLayout, trajectories: np.ndarray) -> Coordinates:
    """Mean 0 and deviation 1 per state and input channel, over trajectories (N, d) and time alike.

    One scale a channel, not an entry: entries that never vary, such as u(T-1) = 0, would have none.
    """
    channels = [x.reshape(-1, x.shape[-1]) for x in layout.split(trajectories)]
    mean = [x.mean(axis=0) for x in channels]
    # The deviation of a constant is 0 up to rounding only; its range is exactly 0.
    scale = [np.where(np.ptp(x, axis=0) > 0, x.std(axis=0), 1.0) for x in channels]
    steps = (layout.horizon + 1, layout.horizon)

    def spread(values: list[np.ndarray]) -> np.ndarray:
        return layout.flatten(*(np.tile(v, (k, 1)) for v, k in zip(values, steps, strict=True)))

    return Coordinates(spread(mean), spread(scale))

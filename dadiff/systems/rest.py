"""Where a system rests, f(x, u) = x, with some leading states held; and a feedback that brings it there."""

from __future__ import annotations

import numpy as np

from dadiff.errors import ConfigError
from dadiff.systems.system import System

RESTS = 1e-9
"""By how much an entry may move in a step of a system that rests."""

_STEPS = 20


def at_rest(system: System, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and u with f(x, u) = x, the leading states as held and the others near 0: Newton's method from there.

    Args:
        held: (*robots, ..., p) with p <= n.

    Returns:
        x (*robots, ..., n) and u (*robots, ..., m).

    Raises:
        ConfigError: if there is no such point.
    """
    lead, p, n = held.shape[:-1], held.shape[-1], system.state_dim
    x, u = np.zeros((*lead, n)), np.zeros((*lead, system.input_dim))
    x[..., :p] = held
    for _ in range(_STEPS):
        moved = system.step(x, u) - x
        if np.abs(moved).max() <= RESTS:
            return x, u
        A, B, _ = system.linearise(x, u)
        J = np.concatenate([(A - np.eye(n))[..., p:], B], axis=-1)
        change = -(np.linalg.pinv(J, rcond=1e-10) @ moved[..., None])[..., 0]
        x[..., p:] += change[..., : n - p]
        u += change[..., n - p :]
    raise ConfigError(
        f"system: with its {p} leading states held it rests nowhere near {np.round(held.reshape(-1, p)[0], 3).tolist()}"
    )

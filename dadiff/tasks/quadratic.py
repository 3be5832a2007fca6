"""Quadratic costs and ranges from the numbers of a configuration.

A weight is one number for all entries (times I), a list with one for each (a diagonal), or the rows of a full matrix.
A range is one number a for all entries, U[-a, a], or a list with one item for each: a, or [low, high].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dadiff.errors import ConfigError

Weight = float | Sequence[float | Sequence[float]]
Range = float | Sequence[float | Sequence[float]]


@dataclass(frozen=True)
class QuadraticCost:
    """sum_{t<T} |x(t) - x_target|_Q^2 + |u(t)|_R^2  +  |x(T) - x_target|_{Q_T}^2.

    Args:
        Q: (n, n).
        R: (m, m).
        terminal: Q_T, (n, n).
    """

    Q: np.ndarray = field(repr=False)
    R: np.ndarray = field(repr=False)
    terminal: np.ndarray = field(repr=False)

    def __call__(self, states: np.ndarray, inputs: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The cost (...) of states (..., T+1, n), inputs (..., T, m) and targets (..., n)."""
        deviation = states - target[..., None, :]
        running = squared(deviation[..., :-1, :], self.Q).sum(-1) + squared(inputs, self.R).sum(-1)
        return running + squared(deviation[..., -1, :], self.terminal)


def squared(vectors: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """v' W v of vectors (..., k): (...)."""
    return ((vectors @ weight) * vectors).sum(axis=-1)


def check_weight(value: Weight, name: str, *, positive: bool) -> None:
    """Refuse a weight that is not symmetric, not positive (semi)definite or not finite.

    Raises:
        ConfigError: naming the parameter and what it holds.
    """
    kind = "positive" if positive else "not negative"
    weight = _numbers(value, name)
    if weight.ndim == 2 and (weight.shape[0] != weight.shape[1] or not np.allclose(weight, weight.T)):
        raise ConfigError(f"task: {name} is {weight.tolist()}; a matrix must be square and symmetric")
    if not np.isfinite(weight).all():
        raise ConfigError(f"task: {name} is {weight.tolist()}; every number must be finite")
    values = np.linalg.eigvalsh(weight) if weight.ndim == 2 else np.atleast_1d(weight)
    rounding = values.size * np.finfo(float).eps * np.abs(values).max(initial=0)
    if (values < -rounding).any() or (positive and not (values > rounding).all()):
        found = f"its eigenvalues are {np.round(values, 6).tolist()}" if weight.ndim == 2 else str(weight.tolist())
        raise ConfigError(f"task: {name} must be {kind}, found {found}")


def weight_matrix(value: Weight, size: int, name: str, entries: str) -> np.ndarray:
    """W of shape (size, size).

    Args:
        entries: what the vector consists of, for the message.

    Raises:
        ConfigError: if it has another size.
    """
    weight = _numbers(value, name)
    if weight.ndim and len(weight) != size:
        one = entries.rstrip("s")
        raise ConfigError(
            f"task: {name} has {len(weight)} entries, the system {size} {entries}; give one weight for each {one}"
        )
    return weight if weight.ndim == 2 else np.diag(np.broadcast_to(weight, size).astype(np.float64))


def check_range(value: Range, name: str) -> None:
    """Refuse a range that is negative, empty or not finite."""
    items = value if isinstance(value, Sequence) else [value]
    for item in items:
        pair = np.asarray(item, dtype=np.float64)
        low, high = (-pair, pair) if pair.ndim == 0 else (pair if len(pair) == 2 else (np.inf, -np.inf))
        if not -np.inf < low <= high < np.inf:
            raise ConfigError(
                f"task: {name} is {value}; expected a number that is finite and not negative, or one item for each "
                "state: such a number, or [low, high]"
            )


def stretched(value: Range, factor: float) -> Range:
    """The range times `factor`; an item [low, high] about its middle."""
    if not isinstance(value, Sequence):
        return value * factor
    return [_stretched_item(item, factor) for item in value]


def _stretched_item(item: float | Sequence[float], factor: float) -> float | list[float]:
    if not isinstance(item, Sequence):
        return item * factor
    middle, half = (item[0] + item[1]) / 2, (item[1] - item[0]) / 2
    return [middle - factor * half, middle + factor * half]


def is_zero(value: Range | Weight) -> bool:
    """Whether every number in it is 0."""
    items = value if isinstance(value, Sequence) else [value]
    return not any(np.any(item) for item in items)


def limits(value: Range, size: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """(low, high), each (size,).

    Raises:
        ConfigError: if it has another size.
    """
    items = list(value) if isinstance(value, Sequence) else [value] * size
    if len(items) != size:
        raise ConfigError(f"task: {name} has {len(items)} items, the system {size} states; give one for each state")
    pairs = [(-item, item) if isinstance(item, float | int) else item for item in items]
    low, high = np.array(pairs, dtype=np.float64).reshape(size, 2).T
    return low, high


def _numbers(value: Weight, name: str) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except ValueError as error:
        raise ConfigError(f"task: {name} is {value}; expected a number, one for each entry, or equal rows") from error
    return array

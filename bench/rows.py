"""What a measurement says: one row of the table, and how times are taken."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Row:
    """One figure, beside a peer's or a floor's from the same run.

    Args:
        name: what was measured.
        value, unit: of ours.
        against: what it is compared with.
        other: the peer's value, in the same unit.
        higher_is_slower: False where the value is a rate.
        points: (size, value) where a cost is followed over sizes; its slope in log-log is the exponent.
    """

    name: str
    value: float
    unit: str
    against: str = ""
    other: float | None = None
    points: list[tuple[float, float]] = field(default_factory=list)

    @property
    def ratio(self) -> float | None:
        """The peer's time over ours: how many times faster ours is; below 1 where the peer is a floor."""
        return None if self.other is None else self.other / self.value


def seconds(action: Callable[[], object]) -> float:
    """Of one call."""
    begun = time.perf_counter()
    action()
    return time.perf_counter() - begun


def least(*actions: Callable[[], object], repeats: int = 5) -> list[float]:
    """The least seconds of each action, taken in turn: what else the machine does only adds, and meets all alike."""
    taken = [[seconds(action) for action in actions] for _ in range(repeats)]
    return [min(column) for column in zip(*taken, strict=True)]

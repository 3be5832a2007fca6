"""What a run needs at least, from its configuration alone, so that what cannot fit is told before anything is made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from dadiff.memory import check_fits
from dadiff.systems import Family
from dadiff.tasks.robots import ManyRobots

if TYPE_CHECKING:
    from dadiff.running.parts import Parts

DOUBLE = 8
"""Bytes."""


@runtime_checkable
class Sized(Protocol):
    """A dataset that says how large it is; None stands for all that there is."""

    train_size: int | None
    test_size: int | None


def check_sizes(parts: Parts) -> None:
    """Refuse a run whose data or plans do not fit into memory.

    Raises:
        ConfigError: naming the parameters, with the estimate.
    """
    for what, numbers in _numbers(parts).items():
        check_fits(DOUBLE * numbers, what)


def _numbers(parts: Parts) -> dict[str, float]:
    """How many floating-point numbers there are at least at one time, by what they follow from."""
    task, dataset, samples = parts.task, parts.dataset, parts.evaluation.samples
    train, test = (dataset.train_size or 1, dataset.test_size or 1) if isinstance(dataset, Sized) else (1, 1)
    trained, tested = (task.robots, task.interpolation + task.extrapolation) if isinstance(task, ManyRobots) else (1, 1)
    size = _trajectory_size(parts)
    horizon = f"task.horizon={task.horizon}"
    return {
        horizon: 3 * size,
        f"dataset.train_size={train}, {horizon}": 2 * train * trained * size,
        f"dataset.test_size={test}, evaluation.samples={samples}, {horizon}": 4 * test * tested * samples * size,
    }


def _trajectory_size(parts: Parts) -> int:
    system = parts.system
    one = system.inside(1, np.random.default_rng(0)) if isinstance(system, Family) else system
    return one.layout(parts.task.horizon).size

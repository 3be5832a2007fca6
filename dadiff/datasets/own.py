"""Own environments of the obstacle task as test cases; what is learned from is generated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dadiff.datasets.environments import load_environments
from dadiff.datasets.generated import Generated, Part
from dadiff.errors import ConfigError, DataError
from dadiff.experts.obstacles.problem import time_step_of
from dadiff.outside import digest_of
from dadiff.systems import System
from dadiff.tasks import Cases, Demonstrations, Task
from dadiff.tasks.obstacles import Obstacles


@dataclass(frozen=True)
class OwnEnvironments:
    """Plans for the environments of a file; the expert solves them for reference.

    A training on generated demonstrations of the same size and seed is shared, not repeated.

    Args:
        path: a yaml or npz file, see `dadiff.datasets.environments`.
        train_size: number of generated demonstrations.
        seed: of the demonstrations.
    """

    path: str
    train_size: int = 10_000
    seed: int = 0

    @property
    def generated(self) -> Generated:
        """The training part."""
        return Generated(train_size=self.train_size, seed=self.seed)

    def determined_by(self, part: Part) -> dict[str, Any]:
        """The training part's size and seed; what the file holds, in place of where it lies."""
        if part == "train":
            return self.generated.determined_by("train")
        if not (file := Path(self.path)).is_file():
            raise DataError(f"{file}: no such file; set dataset.path to a yaml or npz file of environments")
        return {"content": digest_of([file])}

    def train(self, task: Task, system: System) -> Demonstrations:
        """Generated demonstrations."""
        return self.generated.train(task, system)

    def test(self, task: Task, system: System) -> Cases:
        """The file's environments, with the expert's solutions as references."""
        if not isinstance(task, Obstacles):
            raise ConfigError(
                "dataset: environments are planned for by task=obstacles; use dataset=npz for other tasks"
            )
        return task.solve(system, load_environments(self.path, task, time_step_of(system)))

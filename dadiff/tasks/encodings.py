"""Encodings: what a network is told of the environment E, and the trajectory from which it predicts the difference.

    Plain       E as it is, and the whole trajectory (the paper's)
    PathFrame   obstacles as seen from the obstacle-free optimum, and the difference to that optimum

An `Encoding` is the component that `conf/encoding/*.yaml` names; an `Encoder` is what it makes for a task and a system.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from dadiff.errors import ConfigError
from dadiff.experts.obstacles.problem import ObstacleProblem, time_step_of
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.systems import System
from dadiff.tasks.obstacles import Obstacles
from dadiff.tasks.task import Task
from dadiff.trajectory.layout import Channel, Layout, TrajectoryLayout


class Encoder(Protocol):
    """Features of E and a reference that follow from E alone. A frozen dataclass, stored with what is trained."""

    @property
    def layout(self) -> Layout:
        """Of the features."""
        ...

    def encode(self, environment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (N, f) and references (N, d), in physical units, of E (N, c)."""
        ...


class Encoding(Protocol):
    """A component: makes the encoder of a task."""

    def encoder(self, task: Task, system: System) -> Encoder | None:
        """The encoder for a task and what its `target` returned; None where E is told as it is."""
        ...


@dataclass(frozen=True)
class Plain:
    """E as it is."""

    def encoder(self, task: Task, system: System) -> Encoder | None:
        """None."""
        return None


@dataclass(frozen=True)
class PathFrame:
    """Discs as seen from the obstacle-free optimum, whose difference to the optimum is learned.

    Args:
        reach: metres from a disc's rim over which it fades from sight.
    """

    reach: float = 0.3

    def __post_init__(self) -> None:
        if not self.reach > 0:
            raise ConfigError(f"encoding path_frame: reach is {self.reach}; it must be positive (metres)")

    def encoder(self, task: Task, system: System) -> PathFrameEncoder:
        """The encoder.

        Raises:
            ConfigError: if the task has no obstacles.
        """
        if not isinstance(task, Obstacles):
            raise ConfigError(
                f"encoding path_frame: task {type(task).__name__} has no obstacle-free optimum; use task=obstacles, or "
                "encoding=plain"
            )
        return PathFrameEncoder(task, time_step_of(system), self.reach)


@dataclass(frozen=True)
class PathFrameEncoder:
    """With p the obstacle-free optimum, d_j(t) = r_j + margin - |p(t) - o_j| the depth of disc j, n_j(t) the unit
    vector from its centre to p(t) and w_j(t) = exp(min(d_j, 0) / reach), the network is told at each t = 2..T

        sum_j w_j,   sum_j w_j n_j,   sum_j max(d_j, 0),   sum_j max(d_j, 0) n_j

    beside p, x_init, target and waypoints. Sums know no order of the discs, and a disc far away is as good as none.

    Args:
        task: whose costs, margin and slots count.
        time_step: in seconds.
        reach: in metres.
    """

    task: Obstacles
    time_step: float
    reach: float

    @cached_property
    def layout(self) -> Layout:
        """Start, target and waypoints as in E; p, and what is seen from it."""
        T = self.task.horizon
        told = tuple(self.task.condition().channel(name) for name in ("x_init", "target", "waypoints"))
        seen = (("path", 2), ("near", 1), ("near_normal", 2), ("depth", 1), ("depth_normal", 2))
        return Layout((*told, *(Channel(name, dim, 2, T) for name, dim in seen)))

    def encode(self, environment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (N, f) and the obstacle-free optima (N, d) of E (N, c)."""
        problem = self.task.problem(self.task.decode(environment), self.time_step)
        path = obstacle_free(problem)
        E = self.task.condition().unpack(environment)
        told = {name: E[name] for name in ("x_init", "target", "waypoints")}
        features = self.layout.pack(**told, path=path[:, 2:], **self._seen(problem, path))
        return features, _trajectory(problem, path)

    def _seen(self, problem: ObstacleProblem, path: np.ndarray) -> dict[str, np.ndarray]:
        """The sums over discs along the path (N, T+1, 2), each (N, T-1, 1) or (N, T-1, 2)."""
        offset = path[:, 2:, None] - problem.centre[:, None]
        depth, there = problem.penetration(path)[..., None], problem.radius[:, None, :, None] > 0
        normal = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-12)
        near, inside = there * np.exp(np.minimum(depth, 0) / self.reach), there * np.maximum(depth, 0)
        measures = {"near": near, "near_normal": near * normal, "depth": inside, "depth_normal": inside * normal}
        return {name: values.sum(axis=2) for name, values in measures.items()}


def _trajectory(problem: ObstacleProblem, path: np.ndarray) -> np.ndarray:
    """tau (N, d) of positions (N, T+1, 2) of a double integrator by forward Euler."""
    velocity = np.diff(path, axis=1) / problem.time_step
    states = np.concatenate([path, np.concatenate([velocity, velocity[:, -1:]], axis=1)], axis=-1)
    return TrajectoryLayout(4, 2, problem.horizon).flatten(states, problem.inputs(path))

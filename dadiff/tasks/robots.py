"""What tasks of many robots share: which are trained on and which tested, and what the network is told of a robot.

Demonstrations come from robots inside a family's ranges; plans are made for others, some of them from outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError
from dadiff.randomness import numpy_generator
from dadiff.systems import Family, GaussianExcitation, Recording, Robots
from dadiff.systems.families import Drawn
from dadiff.tasks.task import Scores
from dadiff.trajectory import Channel, Layout

SERVED = 1.05
"""A robot counts as served if its mean cost is within this factor of the optimum."""


@dataclass(frozen=True, kw_only=True)
class ManyRobots:
    """E is what the task says of start and end, followed by what the network is told of the robot.

    Args:
        robots: number of robots in the training set.
        interpolation: number of test robots inside the family's ranges.
        extrapolation: number of test robots outside of them.
        extrapolation_factor: by which the ranges are stretched to draw those.
        condition_on: `nothing` of the robot; the `robot_parameters` that it was drawn with; or a short `recording`
            of it from rest, as transitions (x(t), u(t), x(t+1) - x(t)).
        recording_length: number of these transitions.
        alone: k restricts training and test to test robot k: what its own demonstrations would give.
        seed: of the test robots.
    """

    robots: int = 200
    interpolation: int = 20
    extrapolation: int = 20
    extrapolation_factor: float = 1.5
    condition_on: Literal["nothing", "robot_parameters", "recording"] = "nothing"
    recording_length: int = 30
    alone: int | None = None
    seed: int = 0

    def check_robots(self) -> None:
        """Raise `ConfigError` unless there are robots to train on and to test."""
        tested = self.interpolation + self.extrapolation
        if self.robots < 1 or min(self.interpolation, self.extrapolation) < 0 or tested < 1:
            raise ConfigError(
                f"task: robots is {self.robots}, interpolation {self.interpolation}, extrapolation "
                f"{self.extrapolation}; need at least one robot to train on and one to test"
            )
        if not self.extrapolation_factor > 1:
            raise ConfigError(f"task: extrapolation_factor is {self.extrapolation_factor}; it must exceed 1")
        if self.recording_length < 1:
            raise ConfigError(f"task: recording_length is {self.recording_length}; it must be at least 1")
        if self.alone is not None and not 0 <= self.alone < tested:
            raise ConfigError(f"task: alone is {self.alone}; the test robots are 0 to {tested - 1}")

    def tested(self, family: Family[Drawn]) -> Drawn:
        """The test robots: those inside the ranges, then those outside."""
        inside = family.ranges.inside(self.interpolation, numpy_generator(self.seed, "robots inside"))
        rng = numpy_generator(self.seed, "robots outside")
        outside = family.ranges.outside(self.extrapolation, self.extrapolation_factor, rng)
        robots = family.robots(np.concatenate([inside, outside]))
        return robots if self.alone is None else robots.take([self.alone])

    def trained(self, family: Family[Drawn], rng: np.random.Generator) -> Drawn:
        """The robots of the training set."""
        return family.inside(self.robots, rng) if self.alone is None else self.tested(family)

    def with_robot(self, ends: Layout, robots: Robots) -> Layout:
        """The channels `ends`, and `parameters` (p,) or `recording` (S, 2n + m) where these are told."""
        parameters = Channel("parameters", len(robots.parameters), labels=tuple(robots.parameters))
        transition = 2 * robots.state_dim + robots.input_dim
        recording = Channel("recording", transition, 0, self.recording_length - 1)
        told = {"nothing": (), "robot_parameters": (parameters,), "recording": (recording,)}
        return Layout((*ends.channels, *told[self.condition_on]))

    def told(
        self, ends: Layout, environment: np.ndarray, robots: Robots, count: int, rng: np.random.Generator
    ) -> np.ndarray:
        """E from its part (robots, ..., c) without the robot.

        Args:
            count: recordings a robot, one for each environment or one for all.
        """
        told = {}
        if self.condition_on == "robot_parameters":
            told["parameters"] = robots.parameter_table[..., None, :]
        elif self.condition_on == "recording":
            excitation = GaussianExcitation(self.recording_length, count=count, seed=int(rng.integers(2**31)))
            told["recording"] = transitions(excitation.record(robots))
        condition = self.with_robot(ends, robots)
        lead = environment.shape[:-1]
        told = {name: np.broadcast_to(v, (*lead, *condition.channel(name).shape)) for name, v in told.items()}
        return condition.pack(**ends.unpack(environment), **told)


def scores_of(robots: Robots, cost_ratio: np.ndarray) -> Scores:
    """Of cost ratios (robots, cases, samples). Headline: the median robot's mean, and the share of robots served."""
    mean = cost_ratio.mean(axis=(-2, -1))
    headline = {"median_cost_ratio": float(np.median(mean)), "robots_served": float((mean <= SERVED).mean())}
    return Scores(per_plan={"cost_ratio": cost_ratio}, headline=headline, tables={"robots": robot_table(robots)})


def robot_table(robots: Robots) -> dict[str, np.ndarray]:
    """Per robot: its group, its distance from the training ranges (in their widths), its parameters."""
    return {
        "robot": np.arange(len(robots.distance)),
        "group": np.where(robots.distance > 0, "extrapolation", "interpolation"),
        "distance": robots.distance,
        **robots.parameters,
    }


def transitions(recording: Recording) -> np.ndarray:
    """(x(t), u(t), x(t+1) - x(t)) for t = 0..S-1: (*robots, count, S, 2n + m)."""
    x, u = recording.states, recording.inputs
    return np.concatenate([x[..., :-1, :], u, np.diff(x, axis=-2)], axis=-1)


def joined(array: np.ndarray) -> np.ndarray:
    """(robots, count, ...) to (robots * count, ...)."""
    return array.reshape(-1, *array.shape[2:])

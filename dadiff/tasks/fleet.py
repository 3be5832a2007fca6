"""The fleet: demonstrations of many robots, and plans for robots that are not among them.

The network sees trajectories of all training robots and is told (x_init, x_target), not the robot; what it draws
becomes a plan of one robot through that robot's projector. Cost, environments and expert are those of the LQR task,
each robot solved by its own optimum. Every test robot is given the same cases.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError
from dadiff.randomness import numpy_generator
from dadiff.systems import Family, GaussianExcitation, Recording, Robots
from dadiff.tasks.lqr import LQR, ends_layout
from dadiff.tasks.task import Cases, Demonstrations, Scores, encoded
from dadiff.trajectory import Channel, Layout

SERVED = 1.05
"""A robot counts as served if its mean cost is within this factor of the optimum."""


@dataclass(frozen=True)
class Fleet:
    """E = [x_init; x_target], followed by what the network is told of the robot.

    Args:
        horizon, state_cost, input_cost, init_range, target_range: as for `LQR`, the same for all robots.
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

    horizon: int = 30
    state_cost: Sequence[float] = (10.0, 10.0, 1.0, 1.0)
    input_cost: float = 1.0
    init_range: float = 1.0
    target_range: float = 4.0
    robots: int = 200
    interpolation: int = 20
    extrapolation: int = 20
    extrapolation_factor: float = 1.5
    condition_on: Literal["nothing", "robot_parameters", "recording"] = "nothing"
    recording_length: int = 30
    alone: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
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
        _ = self.lqr

    @cached_property
    def lqr(self) -> LQR:
        """The task of each robot."""
        return LQR(self.horizon, self.state_cost, self.input_cost, self.init_range, self.target_range)

    def target(self, system: Family) -> Robots:
        """The test robots: those inside the ranges, then those outside.

        Raises:
            ConfigError: if the system is no family.
        """
        if not isinstance(system, Family):
            raise ConfigError(
                "task: fleet draws robots from a family, found a single system; "
                "choose system=damped_integrators or another family"
            )
        inside = system.ranges.inside(self.interpolation, numpy_generator(self.seed, "robots inside"))
        rng = numpy_generator(self.seed, "robots outside")
        outside = system.ranges.outside(self.extrapolation, self.extrapolation_factor, rng)
        robots = system.robots(np.concatenate([inside, outside]))
        return robots if self.alone is None else robots.take([self.alone])

    def condition(self, system: Robots) -> Layout:
        """E = [x_init; target], and `parameters` (p,) or `recording` (S, 2n + m) where these are told."""
        parameters = Channel("parameters", len(system.parameters), labels=tuple(system.parameters))
        transition = 2 * system.state_dim + system.input_dim
        recording = Channel("recording", transition, 0, self.recording_length - 1)
        told = {"nothing": (), "robot_parameters": (parameters,), "recording": (recording,)}
        return Layout((*ends_layout(system).channels, *told[self.condition_on]))

    def environment(self, system: Robots, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from its fields, each of them checked."""
        return encoded(self.condition(system), given)

    def demonstrations(self, system: Family, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` noisy runs of its expert for each training robot, each in an environment of its own."""
        robots = system.inside(self.robots, rng) if self.alone is None else self.target(system)
        environment = self.lqr.sample_environments(robots, (*robots.robots, count), rng)
        trajectories = self.lqr.realise(robots, environment, rng)
        condition = self._condition(environment, robots, count, rng)
        notes = {"robots": float(robots.robots[0]), "demonstrations a robot": float(count)}
        return Demonstrations(_joined(trajectories), _joined(condition), notes)

    def cases(self, system: Robots, count: int, rng: np.random.Generator) -> Cases:
        """`count` cases, the same for every robot, each with the robot's own optimum and one recording a robot."""
        environment = self.lqr.sample_environments(system, (count,), rng)
        environment = np.broadcast_to(environment, (*system.robots, *environment.shape))
        reference = self.lqr.law(system).mean(environment)
        condition = self._condition(environment, system, 1, rng)
        return Cases(self.condition(system), condition, reference)

    def score(self, system: Robots, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """The cost after replay, relative to each robot's own optimum.

        In the headline, of the robots' mean cost ratios: their median, and the share within 5 % of the optimum.
        """
        scores = self.lqr.score(system, cases, planned, rollout)
        ratio = scores.per_plan["cost_ratio"].mean(axis=(-2, -1))
        headline = {"median_cost_ratio": float(np.median(ratio)), "robots_served": float((ratio <= SERVED).mean())}
        return replace(scores, headline=headline, tables={"robots": robot_table(system)})

    def _condition(self, environment: np.ndarray, robots: Robots, count: int, rng: np.random.Generator) -> np.ndarray:
        """E with what is told of the robot; `count` recordings a robot, one for each environment or one for all."""
        ends, told = ends_layout(robots).unpack(environment), {}
        if self.condition_on == "robot_parameters":
            told["parameters"] = robots.parameter_table[..., None, :]
        elif self.condition_on == "recording":
            excitation = GaussianExcitation(self.recording_length, count=count, seed=int(rng.integers(2**31)))
            told["recording"] = transitions(excitation.record(robots))
        condition = self.condition(robots)
        lead = environment.shape[:-1]
        told = {name: np.broadcast_to(v, (*lead, *condition.channel(name).shape)) for name, v in told.items()}
        return condition.pack(**ends, **told)


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


def _joined(array: np.ndarray) -> np.ndarray:
    """(robots, count, ...) to (robots * count, ...)."""
    return array.reshape(-1, *array.shape[2:])

"""The fleet: demonstrations of many robots, and plans for robots that are not among them.

The network sees trajectories of all training robots and is told (x_init, x_target), not the robot; what it draws
becomes a plan of one robot through that robot's projector. Cost, environments and expert are those of the LQR task,
each robot solved by its own optimum. Every test robot is given the same cases.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from dadiff.errors import ConfigError
from dadiff.experts.lqr import GaussianLaw
from dadiff.systems import AffineSystem
from dadiff.systems.families import LinearFamily, LinearRobots
from dadiff.tasks.lqr import LQR, ends_layout
from dadiff.tasks.quadratic import Range, Weight, stretched
from dadiff.tasks.robots import ManyRobots, joined, scores_of
from dadiff.tasks.task import Cases, Demonstrations, Scores, encoded
from dadiff.trajectory import Layout


@dataclass(frozen=True, kw_only=True)
class Fleet(ManyRobots):
    """E = [x_init; x_target], followed by what the network is told of the robot; see `ManyRobots`.

    Args:
        horizon, state_cost, input_cost, terminal_cost, init_range, target_range: as for `LQR`, the same for all robots.
    """

    version: ClassVar[str] = "fleet-v1"

    horizon: int = 30
    state_cost: Weight = (10.0, 10.0, 1.0, 1.0)
    input_cost: Weight = 1.0
    terminal_cost: Weight = 0.0
    init_range: Range = 1.0
    target_range: Range = 4.0

    def __post_init__(self) -> None:
        self.check_robots()
        _ = self.lqr

    @cached_property
    def lqr(self) -> LQR:
        """The task of each robot."""
        costs = (self.state_cost, self.input_cost, self.terminal_cost)
        return LQR(self.horizon, *costs, self.init_range, self.target_range)

    def stretched(self, factor: float) -> Fleet:
        """The same task with the ranges of starts and targets times `factor`."""
        init, target = (stretched(given, factor) for given in (self.init_range, self.target_range))
        return replace(self, init_range=init, target_range=target)

    def target(self, system: LinearFamily) -> LinearRobots:
        """The test robots: those inside the ranges, then those outside.

        Raises:
            ConfigError: if the system is no family of linear robots.
        """
        if not isinstance(system, LinearFamily):
            raise ConfigError(
                "task: fleet draws linear robots from a family, found another system; "
                "choose system=damped_integrators or another such family (task=manoeuvre has nonlinear ones)"
            )
        return self.tested(system)

    def condition(self, system: LinearRobots) -> Layout:
        """E = [x_init; target], and `parameters` (p,) or `recording` (S, 2n + m) where these are told."""
        return self.with_robot(ends_layout(system), system)

    def environment(self, system: LinearRobots, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from its fields, each of them checked."""
        return encoded(self.condition(system), given)

    def demonstrations(self, system: LinearFamily, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` noisy runs of its expert for each training robot, each in an environment of its own."""
        return self._demonstrations(system, count, rng, along=False)

    def demonstrations_along(self, system: LinearFamily, count: int, rng: np.random.Generator) -> Demonstrations:
        """As `demonstrations`, each from a state that the robot's expert passes on its way."""
        return self._demonstrations(system, count, rng, along=True)

    def _demonstrations(
        self, system: LinearFamily, count: int, rng: np.random.Generator, *, along: bool
    ) -> Demonstrations:
        robots = self.trained(system, rng)
        environment = self.lqr.sample_environments(robots, (*robots.robots, count), rng)
        if along:
            environment = self.lqr.on_the_way(robots, environment, rng)
        trajectories = self.lqr.realise(robots, environment, rng)
        condition = self.told(ends_layout(robots), environment, robots, count, rng)
        notes = {"robots": float(robots.robots[0]), "demonstrations a robot": float(count)}
        return Demonstrations(joined(trajectories), joined(condition), notes)

    def cases(self, system: LinearRobots, count: int, rng: np.random.Generator) -> Cases:
        """`count` cases, the same for every robot, each with the robot's own optimum and one recording a robot."""
        environment = self.lqr.sample_environments(system, (count,), rng)
        environment = np.broadcast_to(environment, (*system.robots, *environment.shape))
        reference = self.lqr.mean(system, environment)
        condition = self.told(ends_layout(system), environment, system, 1, rng)
        return Cases(self.condition(system), condition, reference)

    def score(self, system: LinearRobots, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """The cost after replay, relative to each robot's own optimum, and to that within bounds; see `scores_of`."""
        ratios = self.lqr.score(system, cases, planned, rollout).per_plan
        scores = scores_of(system, ratios["cost_ratio"])
        bounded = {name: ratios[name] for name in ("bounded_cost_ratio",) if name in ratios}
        return replace(scores, per_plan=scores.per_plan | bounded)

    def solve(
        self,
        system: LinearRobots,
        environment: np.ndarray,
        model: AffineSystem | None = None,
        start: np.ndarray | None = None,
        sweeps: int | None = None,
    ) -> np.ndarray:
        """Each robot's optimum tau (robots, ..., d) without process noise for E (robots, ..., c); see `LQR.solve`."""
        return self.lqr.solve(system, self._ends(system, environment), model)

    def of_runs(self, system: LinearRobots, environment: np.ndarray) -> tuple[GaussianLaw, np.ndarray]:
        """The law of each robot's own expert with process noise, and [x_init; target]: no network is told the robot."""
        return self.lqr.law(system), self._ends(system, environment)

    def _ends(self, system: LinearRobots, environment: np.ndarray) -> np.ndarray:
        ends = {name: self.condition(system).get(environment, name) for name in ("x_init", "target")}
        return ends_layout(system).pack(**ends)

    def goal(self, system: LinearRobots, environment: np.ndarray) -> np.ndarray:
        """The target (robots, ..., n)."""
        return self.condition(system).get(environment, "target")

    def weights(self, system: LinearRobots) -> tuple[np.ndarray, np.ndarray]:
        """Q and R, the same for all robots."""
        return self.lqr.weights(system)

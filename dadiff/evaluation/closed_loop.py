"""Closed loop: episodes in which plans are made anew from where the robot is, under disturbances.

Every controller meets the same disturbances and is held against the expert that knows the robot and plans at the
shortest interval, and against it at the same interval. What separates methods is how seldom they may plan: the interval
between plans is the axis.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import pandas as pd

from dadiff.behaviours import model_of
from dadiff.control import Cloned, Controller, Episode, OpenLoop, RecedingHorizon, Tracking, run
from dadiff.control.controllers import Trajectories, tracking_gains
from dadiff.errors import ConfigError
from dadiff.evaluation.settings import ClosedLoop, ControllerChoice
from dadiff.planning import Planner, Plans
from dadiff.randomness import numpy_generator
from dadiff.systems import System
from dadiff.tasks.task import Cases, Demonstrations, Steering

TIMED_PLANS, TIMED_SECONDS = 100, 1.0  # plans of one case, one at a time, for the latency


@dataclass(frozen=True)
class Bench:
    """Episodes of one planner's system and cases, for any controller.

    Args:
        planner: what is tested; its system is the robot.
        cases: start, goal, and what else E holds.
        evaluation: how.
        demonstrations: what the controller `cloned` is regressed on; else None.
    """

    planner: Planner
    cases: Cases
    evaluation: ClosedLoop
    demonstrations: Demonstrations | None = None

    @property
    def task(self) -> Steering:
        """See `ClosedLoop.steered`."""
        return self.evaluation.steered(self.planner.task, self.planner.system)

    @property
    def steps(self) -> int:
        """K."""
        return self.evaluation.steps or self.planner.layout.horizon

    @cached_property
    def model(self) -> System:
        """What the planner takes for the robot's dynamics: the robot itself where its set says nothing of them."""
        return model_of(self.planner.behaviour) or self.planner.system

    def table(self) -> pd.DataFrame:
        """A row for each controller, interval, robot and case.

        cost_ratio is against the expert at the shortest interval, cost_ratio_same against it at the same one; distance
        is |x(K) - goal|, largest_input max |u|, seconds the processor time that a plan took in the batch, time_share it
        over the expert's, nan where that was over before the clock moved. An episode that left float range has
        cost_ratio inf.
        """
        intervals, rows = sorted(self.evaluation.replan_every), []
        yardsticks = {every: self._driven("optimal", every) for every in intervals}
        best = self._cost(yardsticks[intervals[0]][0])
        for every, (same, seconds) in yardsticks.items():
            for kind in self.evaluation.controllers:
                episode, spent = (same, seconds) if kind == "optimal" else self._driven(kind, every)
                rows.append(self._rows(episode, best, self._cost(same)).assign(
                    controller=kind, every=every, seconds=spent, time_share=spent / (seconds or np.nan)
                ))  # fmt: skip
        return pd.concat(rows, ignore_index=True)

    def _rows(self, episode: Episode, best: np.ndarray, same: np.ndarray) -> pd.DataFrame:
        cost = self._cost(episode)
        away = episode.states[..., -1, :] - self.task.goal(self.planner.system, self.cases.environment)
        values = {
            "cost_ratio": cost / best,
            "cost_ratio_same": cost / same,
            "distance": np.linalg.norm(away, axis=-1),
            "largest_input": np.abs(episode.inputs).max(axis=(-2, -1)),
        }
        index = np.indices(cost.shape, dtype=np.int32).reshape(cost.ndim, -1)
        names = ("robot", "case")[-cost.ndim :]
        return pd.DataFrame(
            dict(zip(names, index, strict=True))
            | {name: np.where(np.isfinite(v), v, np.inf).ravel() for name, v in values.items()}
        )

    def episode(self, kind: ControllerChoice, every: int) -> Episode:
        """One controller on all cases."""
        return self._driven(kind, every)[0]

    def _driven(self, kind: ControllerChoice, every: int) -> tuple[Episode, float]:
        """The episode, and the processor seconds that each of its plans took."""
        x_init, controller = self.cases.x_init, self.controller(kind, every)
        episode = run(self.planner.system, controller, x_init, self.steps, self._disturbance(),
                      delay=self.evaluation.delay)  # fmt: skip
        return episode, float(np.mean(controller.seconds)) / (x_init.size // x_init.shape[-1])

    def controller(self, kind: ControllerChoice, every: int) -> RecedingHorizon | Cloned:
        """See `ClosedLoop.controllers`."""
        if kind == "cloned":
            return self._cloned()
        if kind in ("optimal", "modelled", "realtime"):
            model = self.model if kind == "modelled" else self.planner.system
            return RecedingHorizon(partial(self._optimal_plan, model, 1 if kind == "realtime" else None), every)
        follow = self._tracked if kind == "tracking" else (lambda states, inputs: OpenLoop(inputs))
        return RecedingHorizon(self._planned(), every, follow)

    def _optimal_plan(
        self, model: System, sweeps: int | None, x: np.ndarray, start: Trajectories | None
    ) -> Trajectories:
        layout, system = self.planner.layout, self.planner.system
        begin = layout.flatten(*start) if start is not None and self.evaluation.warm_start else None
        return layout.split(self.task.solve(system, self._from(x), model, begin, None if begin is None else sweeps))

    def _cloned(self) -> Cloned:
        shown = self.demonstrations
        if shown is None:
            raise ConfigError("evaluation: controller cloned needs demonstrations, and none are given")
        goals = [
            np.concatenate([E[..., where] for where in self._goal_channels], axis=-1)
            for E in (shown.environment, self.cases.environment)
        ]
        return Cloned.of(self.planner.layout, shown.trajectories, *goals)

    @property
    def _goal_channels(self) -> list[slice]:
        """Where E holds something else than the start."""
        condition = self.planner.condition
        return [condition.where(name) for name in condition.names if name != "x_init"]

    def _planned(self) -> PlanAnew:
        return PlanAnew(self.planner, self._from, self.evaluation.seed, warm=self.evaluation.warm_start)

    def _tracked(self, states: np.ndarray, inputs: np.ndarray) -> Controller:
        gains = tracking_gains(self.model, states, inputs, *self.task.weights(self.planner.system))
        return Tracking(states, inputs, gains)

    def _from(self, x: np.ndarray) -> np.ndarray:
        """E with the present state as its start."""
        return moved(self.planner, self.cases.environment, x)

    def _disturbance(self) -> np.ndarray:
        """w (*robots, cases, K, n), the same for every controller."""
        rng = numpy_generator(self.evaluation.seed, "disturbance")
        system, std = self.planner.system, self.evaluation.disturbance
        unit = rng.standard_normal((*self.cases.x_init.shape[:-1], self.steps, system.state_dim))
        return unit * (system.process_noise if std is None else std)

    def _cost(self, episode: Episode) -> np.ndarray:
        """sum_t |x(t) - goal|_Q^2 + |u(t)|_R^2, (*robots, cases)."""
        Q, R = self.task.weights(self.planner.system)
        goal = self.task.goal(self.planner.system, self.cases.environment)
        away, u = episode.states[..., :-1, :] - goal[..., None, :], episode.inputs
        with np.errstate(over="ignore", invalid="ignore"):
            return ((away @ Q) * away).sum(axis=(-2, -1)) + ((u @ R) * u).sum(axis=(-2, -1))


@dataclass
class PlanAnew:
    """Asks a planner for one plan from each present state; fresh noise each time, the same for all methods."""

    planner: Planner
    environment_from: Callable[[np.ndarray], np.ndarray]
    seed: int
    warm: bool
    asked: int = 0

    def __call__(self, x: np.ndarray, start: Trajectories | None) -> Trajectories:
        """States and inputs of the new plans."""
        layout = self.planner.layout
        begin = Plans(layout, layout.flatten(*start)[..., None, :], 0) if start is not None and self.warm else None
        plans = self.planner.plan(self.environment_from(x), seed=self.seed + self.asked, start=begin)
        self.asked += 1
        return plans.states[..., 0, :, :], plans.inputs[..., 0, :, :]


def moved(planner: Planner, environment: np.ndarray, x: np.ndarray) -> np.ndarray:
    """E (..., c) with x_init replaced by x (..., n)."""
    E = environment.copy()
    E[..., planner.condition.where("x_init")] = x
    return E


def latencies(planner: Planner, environment: np.ndarray, count: int = TIMED_PLANS, share: float = 1.0) -> np.ndarray:
    """Seconds that each of several plans for one E (*robots, c) took, one after the other; the first is not counted.

    At most a share of TIMED_SECONDS in all, and at least three plans.
    """
    seconds: list[float] = []
    planner.plan(environment)
    begun = time.perf_counter()
    while len(seconds) < count and (len(seconds) < 3 or time.perf_counter() - begun < share * TIMED_SECONDS):
        start = time.perf_counter()
        planner.plan(environment, seed=len(seconds))
        seconds.append(time.perf_counter() - start)
    return np.array(seconds)


MEANS = {"": "cost_ratio", "same_": "cost_ratio_same", "time_": "time_share"}
"""What of the table of episodes becomes a metric of the run."""


def means(table: pd.DataFrame) -> dict[str, float]:
    """Means over robots and cases for each controller and interval.

    `closed_loop_<controller>_<every>` of the cost ratio, `closed_loop_same_...` of that at the same interval,
    `closed_loop_time_...` of the processor time that a plan took over the expert's.
    """
    found = table.groupby(["controller", "every"], as_index=False)[list(MEANS.values())].mean()
    return {
        f"closed_loop_{what}{controller}_{every}": float(value)
        for what, column in MEANS.items()
        for controller, every, value in zip(found["controller"], found["every"], found[column], strict=True)
    }

"""How plans are drawn for evaluation, and which episodes are run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError
from dadiff.systems import System, TimeVarying
from dadiff.tasks.task import Steering, Task

ControllerChoice = Literal["receding", "tracking", "optimal", "modelled", "realtime", "cloned"]


@dataclass(frozen=True)
class Evaluation:
    """How many plans are drawn, from which noise, and when a chain counts as diverged.

    Args:
        samples: plans for each test case.
        divergence_bound: a chain is stopped as diverged once a value exceeds it, in the sampler's coordinates.
        examples: number of cases whose plans are stored for figures.
        seed: of the initial and step noise, which is the same for every projector.
        theorem1: follow the distance of Theorem 1 along the chain, where the law of demonstrations is known. It takes a
            singular value decomposition of the size of tau, which for large systems takes longer than all else.
    """

    samples: int = 10
    divergence_bound: float = 1e6
    examples: int = 4
    seed: int = 0
    theorem1: bool = True

    def __post_init__(self) -> None:
        if self.samples < 1 or self.examples < 0 or not self.divergence_bound > 0:
            raise ConfigError(
                f"evaluation: samples is {self.samples}, examples {self.examples}, divergence_bound "
                f"{self.divergence_bound}; need at least 1, at least 0 and a positive number"
            )


@dataclass(frozen=True, kw_only=True)
class ClosedLoop(Evaluation):
    """Plans as in `Evaluation`, and episodes.

    Args:
        replan_every: intervals between two plans, in steps.
        steps: length of an episode; None is the horizon.
        disturbance: standard deviation of the disturbance per state and step; None is the system's process noise.
        controllers: `receding` follows its plan open loop between two plans, `tracking` with LQR gains about the
            plan; `optimal` is the expert planning at the same interval, and `modelled` the expert that takes the
            planner's model for the robot: what the model costs, whoever plans with it. `realtime` is `optimal` with one
            sweep from its last plan each time, the first apart: real-time iteration (Diehl et al. 2005). `cloned` plans
            nothing: its inputs are regressed on the state and E from the demonstrations, at every step.
        warm_start: begin the chain, and an expert that iterates, from the last plan, moved on.
        delay: steps by which inputs come late.
        rate: plans a second that the robot asks for; slower ones miss their deadline.
    """

    replan_every: Sequence[int] = (1, 10, 30)
    steps: int | None = None
    disturbance: float | None = None
    controllers: Sequence[ControllerChoice] = ("receding", "tracking", "optimal")
    warm_start: bool = True
    delay: int = 0
    rate: float = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.replan_every or min(self.replan_every) < 1:
            raise ConfigError(
                f"evaluation: replan_every is {list(self.replan_every)}; name intervals of 1 or more steps"
            )
        if (self.steps is not None and self.steps < 1) or self.delay < 0:
            raise ConfigError(f"evaluation: steps is {self.steps} and delay {self.delay}; need at least 1, at least 0")
        if not self.rate > 0 or (self.disturbance is not None and not 0 <= self.disturbance < np.inf):
            raise ConfigError(
                f"evaluation: rate is {self.rate}, disturbance {self.disturbance}; need a positive number of plans a "
                "second and a standard deviation of at least 0"
            )

    @staticmethod
    def steered(task: Task, system: System) -> Steering:
        """The task, which must steer to a goal, where plans made later are made for the same dynamics.

        Raises:
            ConfigError: if it does not steer.
            NotApplicableError: if the system varies.
        """
        if not isinstance(task, Steering):
            raise ConfigError(
                "evaluation: closed_loop needs a task that steers to a goal at quadratic cost; use task=lqr or "
                "task=fleet, or evaluation=default"
            )
        if isinstance(system, TimeVarying):
            raise NotApplicableError(
                "evaluation: closed_loop plans each time from t = 0, but the system varies; use evaluation=default"
            )
        return task


@dataclass(frozen=True, kw_only=True)
class Exact(Evaluation):
    """Plans as in `Evaluation`, and how far the law that they are drawn from is from the right one.

    Args:
        robots: of a fleet, how many are judged: those that differ most.
        draws: plans from which the law is estimated where it has no closed form.
    """

    robots: int = 4
    draws: int = 2000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.robots < 1 or self.draws < 10:
            raise ConfigError(f"evaluation: robots is {self.robots}, draws {self.draws}; need at least 1 and 10")

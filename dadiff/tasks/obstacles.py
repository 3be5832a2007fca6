"""The task of waypoints and collision avoidance (Section IV-B of the paper).

The printed cost rewards distance from discs and has no minimum at the paper's sizes; the default formulation keeps
its waypoint and input costs and constrains the distance instead (see `dadiff.experts.obstacles`).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from dadiff.errors import ConfigError, InfeasibleError, ShapeError
from dadiff.experts.obstacles import batched, ipopt, literal, successive
from dadiff.experts.obstacles.problem import ObstacleProblem, Solutions, time_step_of
from dadiff.experts.obstacles.quadratic import obstacle_free
from dadiff.systems import System
from dadiff.tasks import environments as env
from dadiff.tasks.environments import Environments
from dadiff.tasks.obstacle_distribution import ANNULUS, ObstacleDistribution
from dadiff.tasks.obstacle_scores import choice, collision_scores, side_scores, success_scores, waypoint_scores
from dadiff.tasks.task import Cases, Demonstrations, Scores
from dadiff.trajectory import Layout

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)

_EXPERTS = {"batched": batched.solve, "cvxpy": successive.solve, "ipopt": ipopt.solve}
_NEAR = {"default": 0.6, "uniform": 0.0, "hard": 0.9}  # probability that a centre is drawn in the way
_ACTIVE = 1e-3  # metres from its inflated rim at which a disc counts as touched
_SHOW_PROGRESS = 500  # environments from which on solving them shows a bar


@dataclass(frozen=True)
class Obstacles:
    """Waypoints at given times, a target at T, and discs to avoid; the system moves without noise in the plan.

    Args:
        horizon: T.
        waypoint_times: when waypoints are due in drawn environments, ascending, in steps.
        max_waypoints, max_obstacles: slots of the condition vector; environments may use fewer.
        radius_range: smallest and largest radius, in metres.
        start_range: x_init ~ U[-s, s]^4.
        box: target and obstacles in U[-b, b]^2, in metres.
        margin: by which the expert inflates discs, in metres; scores use the true discs.
        waypoint_tolerance: how far from waypoints and target a successful plan may pass, in metres.
        waypoint_weight: cost of a squared metre at a waypoint or the target.
        input_cost: rho, R = rho I. At 1e-4 the optimum passes waypoints within centimetres, as in the paper's figures.
        distribution: "default" draws 60 % of the discs in the way, "uniform" none on purpose; "hard" draws as many as
            there are slots, 90 % in the way.
        formulation: "constrained", or "literal" for the printed cost.
        expert: who solves the constrained problem.
    """

    version: ClassVar[str] = "obstacles-v1"

    horizon: int = 40
    waypoint_times: Sequence[int] = (5, 33)
    max_waypoints: int = 2
    max_obstacles: int = 4
    radius_range: Sequence[float] = (0.4, 0.8)
    start_range: float = 1.0
    box: float = 4.0
    margin: float = 0.05
    waypoint_tolerance: float = 0.15
    waypoint_weight: float = 1.0
    input_cost: float = 1e-4
    distribution: Literal["default", "uniform", "hard"] = "default"
    formulation: Literal["constrained", "literal"] = "constrained"
    expert: Literal["batched", "cvxpy", "ipopt"] = "batched"

    def __post_init__(self) -> None:
        for name, least in (("horizon", 2), ("max_waypoints", 0), ("max_obstacles", 0), ("margin", 0)):
            if (value := getattr(self, name)) < least:
                raise ConfigError(f"task: {name} is {value}; it must be at least {least}")
        for name in ("start_range", "waypoint_tolerance", "waypoint_weight", "input_cost"):
            if not (value := getattr(self, name)) > 0:
                raise ConfigError(f"task: {name} is {value}; it must be positive")
        if not self.box >= ANNULUS[0]:
            raise ConfigError(
                f"task: box is {self.box}; it must be at least {ANNULUS[0]}, which waypoints keep from targets"
            )
        self._check_sizes()

    def _check_sizes(self) -> None:
        times = list(self.waypoint_times)
        if times != sorted(set(times)) or not all(1 <= t < self.horizon for t in times):
            raise ConfigError(f"task: waypoint_times are {times}; expected ascending steps in 1..{self.horizon - 1}")
        if len(times) > self.max_waypoints:
            raise ConfigError(f"task: {len(times)} waypoint_times, but max_waypoints is {self.max_waypoints}; raise it")
        if len(self.radius_range) != 2 or not 0 < self.radius_range[0] <= self.radius_range[1]:
            raise ConfigError(
                f"task: radius_range is {list(self.radius_range)}; expected 0 < smallest <= largest (metres)"
            )

    def stretched(self, factor: float) -> Obstacles:
        """The same task with start, target and discs from ranges times `factor`."""
        return replace(self, start_range=factor * self.start_range, box=factor * self.box)

    def target(self, system: System) -> System:
        """The system itself."""
        return system

    def condition(self, system: System | None = None) -> Layout:
        """E: x_init (4), target (2), and slots of waypoints (W, 4) and obstacles (O, 4)."""
        return env.condition(self.max_waypoints, self.max_obstacles)

    def environment(self, system: System, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from x_init, target, and lists of waypoints {position, time} and obstacles {centre, radius}.

        Raises:
            DataError: naming what is missing, not known, or unusable.
            InfeasibleError: if start, waypoint or target lies inside a disc.
        """
        environments = env.parse(given, self.max_waypoints, self.max_obstacles, "condition")
        env.check(environments, self.horizon, time_step_of(system), where="condition: ")
        return env.encode(environments, self.horizon)[0]

    def demonstrations(self, system: System, count: int, rng: np.random.Generator) -> Demonstrations:
        """Optima in `count` drawn environments; those that the expert could not solve are left out and counted."""
        cases = self.cases(system, count, rng)
        return Demonstrations(cases.reference, cases.environment, cases.notes)

    def cases(self, system: System, count: int, rng: np.random.Generator) -> Cases:
        """As `demonstrations`, for testing."""
        dt = time_step_of(system)
        environments, notes = self.distribution_for(dt).sample(count, rng)
        problem, found = self._solve(environments, dt)
        if not found.solved.all():
            logger.warning("expert %s left %d of %d environments unsolved", self.expert, (~found.solved).sum(), count)
        notes |= _notes(problem, found)
        keep = np.flatnonzero(found.solved)
        return self._cases(system, environments.take(keep), found.inputs[keep], notes)

    def solve(self, system: System, environment: np.ndarray) -> Cases:
        """References for given environments (N, c).

        Raises:
            ShapeError: if there are more obstacles than max_obstacles, or c is wrong otherwise.
            DataError: if values are unusable.
            InfeasibleError: if an environment has no solution, or the expert finds none.
        """
        dt = time_step_of(system)
        environments = self.decode(environment)
        env.check(environments, self.horizon, dt)
        problem, found = self._solve(environments, dt)
        if not found.solved.all():
            first = int(np.flatnonzero(~found.solved)[0])
            raise InfeasibleError(
                f"environment {first}: expert {self.expert} found no solution; move its obstacles apart or try another "
                "task.expert"
            )
        return self._cases(system, environments, found.inputs, _notes(problem, found))

    def decode(self, environment: np.ndarray) -> Environments:
        """The environments of condition vectors (N, c)."""
        layout = self.condition()
        if environment.shape[-1] != layout.size:
            raise ShapeError(
                f"environment has {environment.shape[-1]} numbers; max_waypoints = {self.max_waypoints} and "
                f"max_obstacles = {self.max_obstacles} make {layout.size}"
            )
        return env.decode(environment, layout, self.horizon)

    def augment(self, environment: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Shuffle the obstacle slots within each row of a training batch (N, c): obstacles are a set."""
        import torch

        layout = self.condition()
        E = layout.unpack(environment)
        slots = E["obstacles"]
        keys = torch.rand(slots.shape[:2], generator=generator).to(environment.device)
        order = keys.argsort(dim=1)[..., None].expand_as(slots)
        return layout.pack(**E | {"obstacles": slots.gather(1, order)})

    def problem(self, environments: Environments, time_step: float, *, margin: float | None = None) -> ObstacleProblem:
        """The optimisation problem of environments, its discs inflated by the margin."""
        N, T, e = environments.count, self.horizon, environments
        weight, goal = np.zeros((N, T + 1)), np.zeros((N, T + 1, 2))
        rows, slots = np.nonzero(e.due)
        times = e.time[rows, slots].astype(int)
        weight[rows, times], goal[rows, times] = self.waypoint_weight, e.waypoint[rows, slots]
        weight[:, T], goal[:, T] = self.waypoint_weight, e.target
        radius = np.where(e.present, e.radius + (self.margin if margin is None else margin), 0)
        return ObstacleProblem(e.x_init, goal, weight, e.centre, radius, self.input_cost, time_step)

    def score(self, system: System, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """Collisions, waypoints and sides of plans (cases, samples, d); success and cost after replay, and choices.

        Success is to keep clear of the discs and within `waypoint_tolerance` of waypoints and target. What ends in
        `_chosen` is that of the plan of each case which the planner would pick, knowing its own plans and E only.
        """
        environments, layout = self.decode(cases.environment), system.layout(self.horizon)
        expert = layout.states(cases.reference)[..., :2]
        scores = Scores()
        for suffix, tau in (("planned", planned), ("rollout", rollout)):
            positions = layout.states(tau)[..., :2]
            collisions, inside = collision_scores(environments, positions)
            named = collisions | waypoint_scores(environments, positions) | side_scores(environments, positions, expert)
            scores.per_plan.update({f"{name}_{suffix}": value for name, value in named.items()})
            scores.per_step[f"inside_{suffix}"] = inside
        scores.per_plan["success"] = success_scores(scores.per_plan, self.waypoint_tolerance)
        if self.formulation != "literal":  # whose expert minimises another cost, which can be negative
            self._score_cost(system, cases, planned, rollout, scores)
        return scores

    def _score_cost(
        self, system: System, cases: Cases, planned: np.ndarray, rollout: np.ndarray, scores: Scores
    ) -> None:
        """Cost of replays over that of the reference; of successes alone; and scores of the plans that are chosen."""
        layout, problem = (
            system.layout(self.horizon),
            self.problem(self.decode(cases.environment), time_step_of(system)),
        )

        def cost(tau: np.ndarray) -> np.ndarray:
            return problem.cost(layout.states(tau)[..., :2], layout.inputs(tau))

        named, reference = scores.per_plan, cases.reference[:, None]
        named["cost_ratio"] = cost(rollout) / cost(reference)
        named["cost_ratio_successful"] = np.where(named["success"] > 0, named["cost_ratio"], np.nan)
        scores.headline["successful_plans"] = float(named["success"].sum())
        error = np.square(layout.states(planned) - layout.states(reference)).sum(axis=-1).mean(axis=-1)
        chosen = choice(cost(planned), named["clearance_planned"])
        of_chosen = {"success": named["success"], "collision": named["collision_rollout"], "state_error": error}
        of_chosen |= {"cost_ratio": named["cost_ratio"]}
        named.update({f"{name}_chosen": np.where(chosen, value, np.nan) for name, value in of_chosen.items()})

    def distribution_for(self, time_step: float) -> ObstacleDistribution:
        """Where environments are drawn from."""
        most = self.max_obstacles
        return ObstacleDistribution(
            horizon=self.horizon,
            time_step=time_step,
            times=tuple(self.waypoint_times),
            slots=(self.max_waypoints, most),
            obstacles=(most if self.distribution == "hard" else min(1, most), most),
            radius=(self.radius_range[0], self.radius_range[1]),
            start=self.start_range,
            box=self.box,
            margin=self.margin,
            near=_NEAR[self.distribution],
            plan=lambda environments: obstacle_free(self.problem(environments, time_step)),
        )

    def _solve(self, environments: Environments, time_step: float) -> tuple[ObstacleProblem, Solutions]:
        if self.formulation == "literal":
            problem = self.problem(environments, time_step, margin=0.0)
            return problem, literal.solve(problem)
        problem = self.problem(environments, time_step)
        return problem, _EXPERTS[self.expert](problem, progress=problem.count >= _SHOW_PROGRESS)

    def _cases(self, system: System, environments: Environments, inputs: np.ndarray, notes: dict[str, float]) -> Cases:
        states = system.simulate(environments.x_init, inputs)
        reference = system.layout(self.horizon).flatten(states, inputs)
        return Cases(self.condition(), env.encode(environments, self.horizon), reference, notes)


def _notes(problem: ObstacleProblem, found: Solutions) -> dict[str, float]:
    """What the obstacles do: how often they are in the way of the obstacle-free optimum, how many are touched."""
    collides = ~problem.feasible(obstacle_free(problem))
    touched = (problem.penetration(found.positions).max(axis=1) > -_ACTIVE) & (problem.radius > 0)
    active = touched[found.solved].sum(axis=1)
    return {
        "obstacle_free_collides_share": float(collides.mean()),
        "active_obstacles_mean": float(active.mean()),
        "active_share": float((active > 0).mean()),
        "unsolved": float((~found.solved).sum()),
    }

"""The manoeuvre: nonlinear robots, from a moving start to rest at a target, at least quadratic cost.

    min  sum_{t<T} |x(t) - x_rest|_Q^2 + |u(t) - u_rest|_R^2  +  w |x(T) - x_rest|_Q^2   s.t.  x(t+1) = f(x(t), u(t))

Each robot rests at the target in its own way, f(x_rest, u_rest) = x_rest. As in the fleet the network sees trajectories
of all training robots and is told start and target, not the robot. The expert is iterated LQR, each robot solved by its
own, within the system's bounds where it has some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from dadiff.errors import ConfigError
from dadiff.experts import limited_ilqr
from dadiff.experts.ilqr import Metric, Solution, Tracking, solve
from dadiff.experts.limited_ilqr import LimitedTracking
from dadiff.systems import Family, Robots, System
from dadiff.systems.rest import at_rest
from dadiff.tasks.robots import ManyRobots, joined, scores_of
from dadiff.tasks.task import Cases, Demonstrations, Scores, encoded
from dadiff.trajectory import Channel, Layout

_CHUNK = 500  # problems solved side by side: fewer waste calls, more leave the cache
_SWEEPS = 200


@dataclass(frozen=True, kw_only=True)
class Manoeuvre(ManyRobots):
    """E = [x_init; target], followed by what the network is told of the robot; see `ManyRobots`.

    The target is given by the leading entries of the state; the others, and the inputs, are those with which the robot
    rests there.

    Args:
        horizon: T.
        state_cost: diagonal of Q, (n,).
        terminal_weight: w.
        input_cost: R = input_cost * I.
        init_range: x_init ~ U[-a, a], (n,), in the units of the states.
        target_range: target ~ U[-b, b], (p,), p <= n, likewise.
    """

    version: ClassVar[str] = "manoeuvre-v1"

    horizon: int = 40
    state_cost: Sequence[float] = (1.0, 1.0, 0.1, 0.1, 0.1, 0.1)
    terminal_weight: float = 50.0
    input_cost: float = 0.05
    init_range: Sequence[float] = (2.0, 2.0, 0.5, 1.0, 1.0, 1.0)
    target_range: Sequence[float] = (2.0, 2.0)

    def __post_init__(self) -> None:
        self.check_robots()
        if self.horizon < 1:
            raise ConfigError(f"task: horizon is {self.horizon}; it must be at least 1")
        for name in ("state_cost", "init_range", "target_range"):
            if not all(0 <= value < np.inf for value in getattr(self, name)):
                raise ConfigError(f"task: {name} is {list(getattr(self, name))}; entries are finite and not negative")
        for name in ("terminal_weight", "input_cost"):
            if not 0 < (value := getattr(self, name)) < np.inf:
                raise ConfigError(f"task: {name} is {value}; it must be finite and positive")

    def stretched(self, factor: float) -> Manoeuvre:
        """The same task with the ranges of starts and targets times `factor`."""
        init, target = ([factor * value for value in given] for given in (self.init_range, self.target_range))
        return replace(self, init_range=init, target_range=target)

    def target(self, system: Family) -> Robots:
        """The test robots: those inside the ranges, then those outside.

        Raises:
            ConfigError: if the system is no family, its sizes do not fit, or a robot does not rest at a target.
        """
        if not isinstance(system, Family):
            raise ConfigError(
                "task: manoeuvre draws robots from a family, found a single system; choose system=planar_quadrotors "
                "or another family"
            )
        robots = self.tested(system)
        self._check_states(robots)
        return robots

    def condition(self, system: Robots) -> Layout:
        """E = [x_init; target], and `parameters` or `recording` where these are told."""
        return self.with_robot(self._ends(system), system)

    def environment(self, system: Robots, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from its fields, each of them checked."""
        return encoded(self.condition(system), given)

    def demonstrations(self, system: Family, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` optima of each training robot, each in an environment of its own."""
        robots = self.trained(system, rng)
        self._check_states(robots)
        environment = self._draw((*robots.robots, count), rng)
        optimum = self.optimum(robots, environment)
        condition = self.told(self._ends(robots), environment, robots, count, rng)
        notes = {
            "robots": float(robots.robots[0]),
            "demonstrations a robot": float(count),
            "share converged": float(optimum.converged.mean()),
        }
        return Demonstrations(joined(optimum.tau), joined(condition), notes)

    def cases(self, system: Robots, count: int, rng: np.random.Generator) -> Cases:
        """`count` cases, the same for every robot, each with the robot's own optimum and one recording a robot."""
        environment = self._draw((count,), rng)
        environment = np.broadcast_to(environment, (*system.robots, *environment.shape))
        optimum = self.optimum(system, environment)
        condition = self.told(self._ends(system), environment, system, 1, rng)
        notes = {"share converged": float(optimum.converged.mean())}
        return Cases(self.condition(system), condition, optimum.tau, notes)

    def score(self, system: Robots, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """The cost after replay, relative to each robot's own optimum; see `scores_of`."""
        target = cases.get("target")
        optimal = self.cost(system, cases.reference, target)
        return scores_of(system, self.cost(system, rollout, target[..., None, :]) / optimal[..., None])

    def solve(
        self,
        system: Robots,
        environment: np.ndarray,
        model: System | None = None,
        start: np.ndarray | None = None,
        sweeps: int | None = None,
    ) -> np.ndarray:
        """Each robot's optimum tau (robots, ..., d) for E (robots, ..., c).

        Args:
            model: what is taken for the robots, of as many; None is what they are.
            start: tau to begin from; None begins at rest at the target.
            sweeps: at most; None until the optimum is reached.
        """
        ends = {name: self.condition(system).get(environment, name) for name in ("x_init", "target")}
        return self.optimum(system, self._ends(system).pack(**ends), model, start, sweeps or _SWEEPS).tau

    def goal(self, system: Robots, environment: np.ndarray) -> np.ndarray:
        """At rest at the target, (robots, ..., n)."""
        target = self.condition(system).get(environment, "target")
        return system.layout(self.horizon).states(self._at_rest(system, target))[..., 0, :]

    def weights(self, system: Robots) -> tuple[np.ndarray, np.ndarray]:
        """Q and R of a step before the last."""
        return np.diag(np.asarray(self.state_cost, dtype=np.float64)), self.input_cost * np.eye(system.input_dim)

    def cost(self, system: Robots, tau: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The cost (...) of trajectories (..., d) towards targets (..., p), see the module."""
        return self.metric(system).squared(tau - self._at_rest(system, target))

    def metric(self, system: System) -> Metric:
        """Q, R and w along the horizon."""
        Q = np.repeat(np.diag(np.asarray(self.state_cost, dtype=np.float64))[None], self.horizon + 1, axis=0)
        Q[-1] *= self.terminal_weight
        R = np.repeat(self.input_cost * np.eye(system.input_dim)[None], self.horizon, axis=0)
        layout = system.layout(self.horizon)
        return Metric(layout, Q, R, np.zeros((layout.size, 0)))

    def optimum(
        self,
        system: Robots,
        environment: np.ndarray,
        model: System | None = None,
        start: np.ndarray | None = None,
        sweeps: int = _SWEEPS,
    ) -> Solution:
        """Each robot's optimum in environments [x_init; target] (robots, plans, c); see `solve` for the rest."""
        ends = self._ends(system).unpack(environment)
        reference, metric = self._at_rest(system, ends["target"]), self.metric(system)
        size = max(1, _CHUNK // environment.shape[1])
        parts = []
        for first in range(0, len(environment), size):
            some = np.arange(first, min(first + size, len(environment)))
            taken = system if model is None else replace(model, bounds=system.bounds)
            given = taken.take(some), metric, reference[some], ends["x_init"][some]
            begin = None if start is None else start[some]
            if system.bounds.any:
                parts.append(limited_ilqr.solve(LimitedTracking.by_bounds(*given), begin, sweeps=sweeps))
            else:
                parts.append(solve(Tracking(*given), begin, sweeps=sweeps))
        return Solution(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))

    def _ends(self, system: System) -> Layout:
        return Layout((Channel("x_init", system.state_dim), Channel("target", len(self.target_range))))

    def _draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """[x_init; target], (*shape, n + p)."""
        ranges = np.array([*self.init_range, *self.target_range], dtype=np.float64)
        return rng.uniform(-ranges, ranges, size=(*shape, len(ranges)))

    def _at_rest(self, system: Robots, target: np.ndarray) -> np.ndarray:
        """tau that stays at the target (*robots, ..., p), (*robots, ..., d); one target (p,) is that of all robots."""
        T = self.horizon
        target = target if target.ndim > 1 else np.broadcast_to(target, (*system.robots, 1, len(target)))
        x, u = at_rest(system, target)
        return system.layout(T).flatten(np.repeat(x[..., None, :], T + 1, -2), np.repeat(u[..., None, :], T, -2))

    def _check_states(self, robots: Robots) -> None:
        """Raise `ConfigError` unless costs and ranges fit the states, and robots rest at a target."""
        for name in ("state_cost", "init_range"):
            if (found := len(getattr(self, name))) != robots.state_dim:
                raise ConfigError(
                    f"task: {name} has {found} entries, the system {robots.state_dim} states; give one for each state"
                )
        at_rest(robots, np.broadcast_to(self.target_range, (*robots.robots, len(self.target_range))))

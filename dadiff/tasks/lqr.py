"""The LQR task: steer from x_init towards x_target at least quadratic cost (Section IV-A)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError
from dadiff.experts.lqr import AffineFeedback, GaussianLaw, closed_loop_law, optimal_feedback, stationary_feedback
from dadiff.systems import AffineSystem
from dadiff.tasks.task import Cases, Demonstrations, Scores, encoded
from dadiff.trajectory import Channel, Layout
from dadiff.trajectory.response import along


def ends_layout(system: AffineSystem) -> Layout:
    """[x_init; target], each (n,): what the expert needs to know."""
    return Layout((Channel("x_init", system.state_dim), Channel("target", system.state_dim)))


@dataclass(frozen=True)
class LQR:
    """x_init ~ U[-a, a]^n, x_target ~ U[-b, b]^n; E = [x_init; x_target].

    Args:
        horizon: T.
        state_cost: diagonal of Q, (n,).
        input_cost: R = input_cost * I.
        init_range: a, in the units of the state.
        target_range: b, likewise.
        expert: `optimal` is the finite-horizon affine optimum, `stationary` the infinite-horizon gain.
        reference: a test case's reference is the controller's trajectory without process noise (`mean`), or
            one noisy run of it (`realised`).
    """

    horizon: int = 30
    state_cost: Sequence[float] = (10.0, 10.0, 1.0, 1.0)
    input_cost: float = 1.0
    init_range: float = 1.0
    target_range: float = 4.0
    expert: Literal["optimal", "stationary"] = "optimal"
    reference: Literal["mean", "realised"] = "mean"

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ConfigError(f"task: horizon is {self.horizon}; it must be at least 1")
        if not (all(0 <= q < np.inf for q in self.state_cost) and 0 < self.input_cost < np.inf):
            raise ConfigError(
                f"task: state_cost is {list(self.state_cost)} and input_cost {self.input_cost}; "
                "Q must not be negative, R must be positive, and both finite"
            )
        for name in ("init_range", "target_range"):
            if not 0 <= (value := getattr(self, name)) < np.inf:
                raise ConfigError(f"task: {name} is {value}; it must be finite and not negative")
        if self.state_cost and not any(self.state_cost):
            raise ConfigError("task: state_cost is 0 for every state, so every optimum costs nothing; raise one")
        if self.init_range == self.target_range == 0:
            raise ConfigError("task: init_range and target_range are both 0, so every optimum costs nothing; widen one")

    @cached_property
    def Q(self) -> np.ndarray:
        """(n, n)."""
        return np.diag(np.asarray(self.state_cost, dtype=np.float64))

    def R(self, system: AffineSystem) -> np.ndarray:
        """(m, m)."""
        return self.input_cost * np.eye(system.input_dim)

    def target(self, system: AffineSystem) -> AffineSystem:
        """The system itself."""
        return system

    def condition(self, system: AffineSystem) -> Layout:
        """E = [x_init; target], each (n,)."""
        return ends_layout(system)

    def environment(self, system: AffineSystem, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from its fields, each of them checked."""
        return encoded(self.condition(system), given)

    def feedback(self, system: AffineSystem) -> AffineFeedback:
        """The expert's controller.

        Raises:
            ConfigError: if state_cost has another length than the system has states.
        """
        if len(self.state_cost) != system.state_dim:
            raise ConfigError(
                f"task: state_cost has {len(self.state_cost)} entries, the system {system.state_dim} states; "
                "give one weight a state"
            )
        solve = {"optimal": optimal_feedback, "stationary": stationary_feedback}[self.expert]
        return solve(system, self.Q, self.R(system), self.horizon)

    def law(self, system: AffineSystem) -> GaussianLaw:
        """The Gaussian law of demonstrations given E."""
        return closed_loop_law(system, self.feedback(system))

    def sample_environments(self, system: AffineSystem, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """E of shape (*shape, 2n)."""
        ranges = np.repeat([self.init_range, self.target_range], system.state_dim)
        return rng.uniform(-ranges, ranges, size=(*shape, 2 * system.state_dim))

    def demonstrations(self, system: AffineSystem, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` noisy runs of the expert, each in an environment of its own."""
        environment = self.sample_environments(system, (count,), rng)
        return Demonstrations(self.realise(system, environment, rng), environment)

    def cases(self, system: AffineSystem, count: int, rng: np.random.Generator) -> Cases:
        """`count` cases for each robot of the system."""
        environment = self.sample_environments(system, (*system.robots, count), rng)
        if self.reference == "realised":
            reference = self.realise(system, environment, rng)
        else:
            reference = self.law(system).mean(environment)
        return Cases(self.condition(system), environment, reference)

    def realise(self, system: AffineSystem, environment: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One noisy run of the expert for each E (*robots, ..., 2n): tau of shape (*robots, ..., d)."""
        law = self.law(system)
        noise = rng.standard_normal((*environment.shape[:-1], law.noise_map.shape[-1]))
        return law.mean(environment) + along(law.noise_map, noise)

    def cost(self, system: AffineSystem, tau: np.ndarray, target: np.ndarray) -> np.ndarray:
        """sum_t |x(t) - x_target|_Q^2 + |u(t)|_R^2 of trajectories (..., d) and targets (..., n)."""
        states, inputs = system.layout(self.horizon).split(tau)
        deviation = states[..., :-1, :] - target[..., None, :]
        return (deviation**2 @ np.diag(self.Q)).sum(-1) + self.input_cost * (inputs**2).sum((-2, -1))

    def score(self, system: AffineSystem, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """The cost after replay over that of the noise-free finite-horizon optimum; and how widely plans are spread.

        Spread is the trace of the covariance of a case's plans over that of the law of optimal trajectories, 1 for
        right samples: each plan's squared distance from their mean, S / (S - 1) times, over the trace.
        """
        target = cases.get("target")
        feedback = optimal_feedback(system, self.Q, self.R(system), self.horizon)
        ends = ends_layout(system).pack(x_init=cases.x_init, target=target)
        optimum = closed_loop_law(system, feedback).mean(ends)
        ratio = self.cost(system, rollout, target[..., None, :]) / self.cost(system, optimum, target)[..., None]
        return Scores(per_plan={"cost_ratio": ratio, **self._spread(system, planned)})

    def _spread(self, system: AffineSystem, planned: np.ndarray) -> dict[str, np.ndarray]:
        """Nothing of single plans, and where optimal trajectories have no spread."""
        samples, trace = planned.shape[-2], np.square(self.law(system).noise_map).sum(axis=(-2, -1))
        if samples < 2 or not np.all(trace > 0):
            return {}
        apart = np.square(planned - planned.mean(axis=-2, keepdims=True)).sum(axis=-1) * samples / (samples - 1)
        return {"spread": apart / np.expand_dims(trace, (-2, -1))}

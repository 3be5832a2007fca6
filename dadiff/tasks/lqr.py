"""The LQR task: steer from x_init towards x_target at least quadratic cost (Section IV-A)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError
from dadiff.experts.lqr import (
    AffineFeedback,
    ClosedLoopLaw,
    GaussianLaw,
    follow,
    optimal_feedback,
    stationary_feedback,
)
from dadiff.systems import AffineSystem, Family, TimeVarying, Unknown, require_affine
from dadiff.tasks.quadratic import (
    QuadraticCost,
    Range,
    Weight,
    check_range,
    check_weight,
    is_zero,
    limits,
    stretched,
    weight_matrix,
)
from dadiff.tasks.task import Cases, Demonstrations, Scores, encoded
from dadiff.trajectory import Channel, Layout
from dadiff.trajectory.response import along


def ends_layout(system: AffineSystem) -> Layout:
    """[x_init; target], each (n,): what the expert needs to know."""
    n, names, units = system.state_dim, system.state_names, system.state_units
    return Layout(tuple(Channel(name, n, labels=names, units=units) for name in ("x_init", "target")))


@dataclass(frozen=True)
class LQR:
    """x_init ~ U[-a, a]^n, x_target ~ U[-b, b]^n; E = [x_init; x_target].

    Args:
        horizon: T.
        state_cost: Q, as one weight for all states, one for each (its diagonal), or the rows of (n, n).
        input_cost: R, likewise for the inputs.
        terminal_cost: Q_T of x(T), likewise; 0 as in the paper.
        init_range: a, in the units of the state; one for all states, or one item for each: a, or [low, high].
        target_range: b, likewise.
        expert: `optimal` is the finite-horizon affine optimum, `stationary` the infinite-horizon gain.
        reference: a test case's reference is the controller's trajectory without process noise (`mean`), or
            one noisy run of it (`realised`).

    Where the system has bounds, references and `solve` are the optimum within them, and demonstrations are its noisy
    runs: the controller tracks it, and its inputs saturate. Noise may take states out of theirs. `law` knows no bounds.
    """

    version: ClassVar[str] = "lqr-v1"

    horizon: int = 30
    state_cost: Weight = (10.0, 10.0, 1.0, 1.0)
    input_cost: Weight = 1.0
    terminal_cost: Weight = 0.0
    init_range: Range = 1.0
    target_range: Range = 4.0
    expert: Literal["optimal", "stationary"] = "optimal"
    reference: Literal["mean", "realised"] = "mean"

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ConfigError(f"task: horizon is {self.horizon}; it must be at least 1")
        for name, positive in (("state_cost", False), ("input_cost", True), ("terminal_cost", False)):
            check_weight(getattr(self, name), name, positive=positive)
        for name in ("init_range", "target_range"):
            check_range(getattr(self, name), name)
        if self.state_cost != () and is_zero(self.state_cost) and is_zero(self.terminal_cost):
            raise ConfigError("task: state_cost is 0 for every state, so every optimum costs nothing; raise one")
        if is_zero(self.init_range) and is_zero(self.target_range):
            raise ConfigError("task: init_range and target_range are both 0, so every optimum costs nothing; widen one")

    def stretched(self, factor: float) -> LQR:
        """The same task with the ranges of starts and targets times `factor`."""
        init, target = (stretched(given, factor) for given in (self.init_range, self.target_range))
        return replace(self, init_range=init, target_range=target)

    def cost(self, system: AffineSystem) -> QuadraticCost:
        """What a trajectory costs.

        Raises:
            ConfigError: if a weight has another size than the system has states or inputs.
        """
        n, m = system.state_dim, system.input_dim
        return QuadraticCost(
            weight_matrix(self.state_cost, n, "state_cost", "states"),
            weight_matrix(self.input_cost, m, "input_cost", "inputs"),
            weight_matrix(self.terminal_cost, n, "terminal_cost", "states"),
        )

    def target(self, system: AffineSystem) -> AffineSystem:
        """The system itself; an unknown one has no expert, and demonstrations of one's own.

        Raises:
            ConfigError: if it is not linear.
        """
        if isinstance(system, Family | Unknown):  # of a family the caller says that it needs another task
            return system
        return require_affine(system, "task: the LQR expert")

    def condition(self, system: AffineSystem) -> Layout:
        """E = [x_init; target], each (n,)."""
        return ends_layout(system)

    def environment(self, system: AffineSystem, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) from its fields, each of them checked."""
        return encoded(self.condition(system), given)

    def feedback(self, system: AffineSystem) -> AffineFeedback:
        """The expert's controller."""
        cost = self.cost(system)
        if self.expert == "stationary":
            return stationary_feedback(system, cost.Q, cost.R, self.horizon)
        return optimal_feedback(system, cost.Q, cost.R, self.horizon, cost.terminal)

    def law(self, system: AffineSystem) -> GaussianLaw:
        """The Gaussian law of demonstrations given E."""
        return ClosedLoopLaw(system, self.feedback(system))

    def of_runs(self, system: AffineSystem, environment: np.ndarray) -> tuple[GaussianLaw, np.ndarray]:
        """The law of demonstrations, and E."""
        return self.law(system), environment

    def sample_environments(self, system: AffineSystem, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """E of shape (*shape, 2n)."""
        n = system.state_dim
        start, target = limits(self.init_range, n, "init_range"), limits(self.target_range, n, "target_range")
        low, high = (np.concatenate(ends) for ends in zip(start, target, strict=True))
        return rng.uniform(low, high, size=(*shape, 2 * n))

    def demonstrations(self, system: AffineSystem, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` noisy runs of the expert, each in an environment of its own."""
        environment = self.sample_environments(system, (count,), rng)
        return Demonstrations(self.realise(system, environment, rng), environment)

    def demonstrations_along(self, system: AffineSystem, count: int, rng: np.random.Generator) -> Demonstrations:
        """As `demonstrations`, each from a state that the expert passes on its way."""
        environment = self.on_the_way(system, self.sample_environments(system, (count,), rng), rng)
        return Demonstrations(self.realise(system, environment, rng), environment)

    def on_the_way(self, system: AffineSystem, environment: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """E (*robots, ..., 2n) with x_init at a time drawn from 0..T of a noisy run of the expert.

        Raises:
            NotApplicableError: if the system varies in time, for which another start is another problem.
        """
        if isinstance(system, TimeVarying):
            raise NotApplicableError("dataset: start_states=along is for systems that do not vary in time; use drawn")
        states = system.layout(self.horizon).states(self.realise(system, environment, rng))
        times = rng.integers(0, self.horizon + 1, size=environment.shape[:-1])
        passed = np.take_along_axis(states, times[..., None, None], axis=-2)[..., 0, :]
        ends = ends_layout(system)
        return ends.pack(x_init=passed, target=ends.get(environment, "target"))

    def cases(self, system: AffineSystem, count: int, rng: np.random.Generator) -> Cases:
        """`count` cases for each robot of the system."""
        environment = self.sample_environments(system, (*system.robots, count), rng)
        realised = self.reference == "realised"
        reference = self.realise(system, environment, rng) if realised else self.mean(system, environment)
        return Cases(self.condition(system), environment, reference)

    def mean(self, system: AffineSystem, environment: np.ndarray) -> np.ndarray:
        """The reference (*robots, cases, d) without process noise for E (*robots, cases, 2n), within bounds.

        Raises:
            InfeasibleError: if no trajectory within bounds starts from a case's x_init.
        """
        if not system.bounds.any:
            return self.law(system).mean(environment)
        from dadiff.experts.bounded import Costs, optimum_within

        cost, ends = self.cost(system), ends_layout(system).unpack(environment)
        return optimum_within(system, Costs(cost.Q, cost.R, cost.terminal), self.horizon, **ends)

    def realise(self, system: AffineSystem, environment: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One noisy run of the expert for each E (*robots, ..., 2n): tau of shape (*robots, ..., d)."""
        if system.bounds.any:
            return self._realise_within(system, environment, rng)
        law = self.law(system)
        noise = rng.standard_normal((*environment.shape[:-1], law.noise_map.shape[-1]))
        return law.mean(environment) + law.spread(noise)

    def solve(
        self,
        system: AffineSystem,
        environment: np.ndarray,
        model: AffineSystem | None = None,
        start: np.ndarray | None = None,
        sweeps: int | None = None,
    ) -> np.ndarray:
        """The optimum tau (*robots, ..., d) without process noise for [x_init; target] (*robots, ..., 2n).

        Args:
            model: what is taken for the system.
            start, sweeps: of no use to a closed form.
        """
        cost, ends, model = self.cost(system), self.condition(system).unpack(environment), model or system
        if system.bounds.any:
            from dadiff.experts.bounded import Costs, many_within

            model = replace(model, bounds=system.bounds)
            return many_within(model, Costs(cost.Q, cost.R, cost.terminal), self.horizon, **ends)
        return self._free_optimum(model, environment)

    def _free_optimum(self, system: AffineSystem, environment: np.ndarray) -> np.ndarray:
        """The optimum without bounds."""
        cost, ends = self.cost(system), ends_layout(system).unpack(environment)
        feedback = optimal_feedback(system, cost.Q, cost.R, self.horizon, cost.terminal)
        return follow(system, feedback, ends["x_init"], ends["target"])

    def _realise_within(self, system: AffineSystem, environment: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Runs of u(t) = clip(u*(t) + K(t) (x(t) - x*(t))) about the optimum within bounds, or of clipped feedback."""
        feedback, layout, T = self.feedback(system), system.layout(self.horizon), self.horizon
        ends, low_high = ends_layout(system).unpack(environment), system.bounds.of_inputs(system.input_dim)
        noise, x = system.noise((*environment.shape[:-1], T), rng), [ends["x_init"]]
        plan = layout.split(self.solve(system, environment)) if self.expert == "optimal" else None
        inputs: list[np.ndarray] = []
        for t in range(T):
            if plan is None:
                wanted = feedback.at(t, x[-1], ends["target"])
            else:
                wanted = plan[1][..., t, :] + along(feedback.K[..., t, :, :], x[-1] - plan[0][..., t, :])
            inputs.append(np.clip(wanted, *low_high))
            x.append(system.step(x[-1], inputs[-1], t) + noise[..., t, :])
        return layout.flatten(np.stack(x, axis=-2), np.stack(inputs, axis=-2))

    def goal(self, system: AffineSystem, environment: np.ndarray) -> np.ndarray:
        """The target (*robots, ..., n)."""
        return self.condition(system).get(environment, "target")

    def weights(self, system: AffineSystem) -> tuple[np.ndarray, np.ndarray]:
        """Q and R."""
        return self.cost(system).Q, self.cost(system).R

    def score(self, system: AffineSystem, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """The cost after replay over that of the noise-free finite-horizon optimum of the case.

        Where the system has bounds that optimum may exceed them, and `bounded_cost_ratio` is over the optimum within.
        """
        cost, target, layout = self.cost(system), cases.get("target"), system.layout(self.horizon)
        optimum = self._free_optimum(system, ends_layout(system).pack(x_init=cases.x_init, target=target))
        spent = cost(*layout.split(rollout), target[..., None, :])
        against = {"cost_ratio": optimum}
        if system.bounds.any and self.reference == "mean":
            against["bounded_cost_ratio"] = cases.reference
        ratios = {name: spent / cost(*layout.split(tau), target)[..., None] for name, tau in against.items()}
        return Scores(per_plan=ratios)

"""What a task is: it draws environments E, has its expert solve them, and scores plans.

Tasks know no projector and no network. Arrays are numpy float64. Where several robots are concerned
their dimension comes first, written `*robots`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

import numpy as np

from dadiff.errors import DataError
from dadiff.experts.lqr import GaussianLaw
from dadiff.systems import Family, System
from dadiff.trajectory import Layout

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Demonstrations:
    """Expert trajectories, and the environments that they solve.

    Args:
        trajectories: tau_0, (N, d), physical units.
        environment: E, (N, c).
        notes: what a reader should know of the set, by name (counts, shares), reported with it.
    """

    trajectories: np.ndarray
    environment: np.ndarray
    notes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Cases:
    """Test cases with the reference that plans are held against.

    Args:
        condition: the layout of E, which has a channel `x_init`.
        environment: E, (*robots, cases, c).
        reference: the optimum's tau, (*robots, cases, d).
        notes: as for `Demonstrations`.
    """

    condition: Layout
    environment: np.ndarray
    reference: np.ndarray
    notes: dict[str, float] = field(default_factory=dict)

    def get(self, name: str) -> np.ndarray:
        """A channel of E by its name, (*robots, cases, ...)."""
        return self.condition.get(self.environment, name)

    @property
    def x_init(self) -> np.ndarray:
        """(*robots, cases, n)."""
        return self.get("x_init")


@dataclass(frozen=True)
class Scores:
    """What a task alone can say of plans; what every task shares is in `dadiff.evaluation`.

    Args:
        per_plan: name -> (*robots, cases, samples).
        per_step: name -> (*robots, cases, samples, T+1); nan where a quantity is not defined at T.
        headline: name -> one number, beside the means of the above.
        tables: name -> columns, for what is neither a plan's nor a step's.
    """

    per_plan: dict[str, np.ndarray] = field(default_factory=dict)
    per_step: dict[str, np.ndarray] = field(default_factory=dict)
    headline: dict[str, float] = field(default_factory=dict)
    tables: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)


class Task(Protocol):
    """One planning problem. Implementations are dataclasses with a yaml in `conf/task/`."""

    horizon: int

    def target(self, system: System | Family) -> System:
        """The system, or the robots, that plans are made for. A task of one system returns it."""
        ...

    def condition(self, system: System) -> Layout:
        """The channels of the condition vector E, x_init among them, for what `target` returned."""
        ...

    def environment(self, system: System, given: Mapping[str, object]) -> np.ndarray:
        """E (c,) of one environment that is given by its fields, each of them checked."""
        ...

    def demonstrations(self, system: System | Family, count: int, rng: np.random.Generator) -> Demonstrations:
        """`count` expert demonstrations (a robot) in fresh environments."""
        ...

    def cases(self, system: System, count: int, rng: np.random.Generator) -> Cases:
        """`count` test cases (a robot) with references in fresh environments."""
        ...

    def score(self, system: System, cases: Cases, planned: np.ndarray, rollout: np.ndarray) -> Scores:
        """Scores of plans (*robots, cases, samples, d), as planned and after replaying their inputs."""
        ...


def encoded(condition: Layout, given: Mapping[str, object], place: str = "condition") -> np.ndarray:
    """E (c,) from its fields by name, each a channel of the layout.

    Args:
        place: what messages begin with.

    Raises:
        DataError: naming the first field that is missing, not known, of another shape, or not finite.
    """
    for name in given:
        if name not in condition:
            raise DataError(f"{place}: '{name}' is not known; expected {', '.join(condition.names)}")
    for name in condition.names:
        if name not in given:
            raise DataError(f"{place}: '{name}' is missing; expected {', '.join(condition.names)}")
    return condition.pack(**{name: numbers(given[name], name, condition.channel(name).shape, place) for name in given})


def numbers(value: object, field: str, shape: tuple[int, ...], place: str) -> np.ndarray:
    """A field as finite floats of a shape; a single number stands for (1,).

    Raises:
        DataError: naming place and field.
    """
    size = " x ".join(map(str, shape))
    try:
        values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise DataError(f"{place}: {field} is {value!r}; expected {size} numbers") from error
    if values.shape != shape:
        raise DataError(f"{place}: {field} has shape {values.shape}; expected {size} numbers")
    if not np.isfinite(values).all():
        shown = ", ".join(f"{v:g}" for v in values.ravel())
        raise DataError(f"{place}: {field} is ({shown}); every number must be finite")
    return values


@runtime_checkable
class Lawful(Protocol):
    """A task whose demonstrations have a Gaussian law given E, so that the exact denoiser is known."""

    def law(self, system: System) -> GaussianLaw:
        """The law of demonstrations given E."""
        ...


@runtime_checkable
class Repeatable(Protocol):
    """A task whose expert can be run anew on the robot that is planned for, since its law there is known."""

    def of_runs(self, system: System, environment: np.ndarray) -> tuple[GaussianLaw, np.ndarray]:
        """The law of the expert's runs, each robot's own, and what of E (*robots, cases, c) it depends on."""
        ...


@runtime_checkable
class Continuing(Protocol):
    """A task whose expert can begin anywhere on its way: what a closed loop meets."""

    def demonstrations_along(self, system: System | Family, count: int, rng: np.random.Generator) -> Demonstrations:
        """As `Task.demonstrations`, each from a state that the expert passes on its way."""
        ...


@runtime_checkable
class Stretching(Protocol):
    """A task that can draw its environments from other ranges: test cases unlike the demonstrations."""

    def stretched(self, factor: float) -> Task:
        """The same task with every range of starts and targets times `factor`, about its middle."""
        ...


@runtime_checkable
class Steering(Protocol):
    """A task that steers to a goal at quadratic cost, from whatever state: it can be planned for again and again."""

    def solve(
        self,
        system: System,
        environment: np.ndarray,
        model: System | None = None,
        start: np.ndarray | None = None,
        sweeps: int | None = None,
    ) -> np.ndarray:
        """The expert's tau (*robots, ..., d) without process noise for E (*robots, ..., c).

        Args:
            model: what the expert takes for the dynamics; None is the system.
            start: tau to begin from, for experts that iterate.
            sweeps: at most, of these; None until they have converged.
        """
        ...

    def goal(self, system: System, environment: np.ndarray) -> np.ndarray:
        """The state (*robots, ..., n) that E (*robots, ..., c) asks for."""
        ...

    def weights(self, system: System) -> tuple[np.ndarray, np.ndarray]:
        """Q (n, n) and R (m, m) of each step's |x(t) - goal|_Q^2 + |u(t)|_R^2."""
        ...


@runtime_checkable
class Augmenting(Protocol):
    """A task that knows changes of E which leave the optimum as it is."""

    def augment(self, environment: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """E (batch, c), changed at random."""
        ...


@runtime_checkable
class Versioned(Protocol):
    """A task that says which of its definitions it is, so that results of an older one are not taken for its own."""

    version: ClassVar[str]

"""`Planner`: a denoiser, a sampler, and the set of what the robot can do, as one thing that plans.

    planner = Planner.load("robot.zip")
    plan = planner.plan(x_init=[0, 0, 0, 0], target=[1, 2, 0, 0], samples=4, seed=0)

It knows no store, no stop-watch and no configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

from dadiff.behaviours import Limited, Pin, Projection, TrajectorySet
from dadiff.diffusion.chain import Observe, Samples, Start, sample
from dadiff.diffusion.context import Project
from dadiff.diffusion.enforcement import Enforcement
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.samplers import Listed, Sampler
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import DataError, NotApplicableError, ShapeError
from dadiff.memory import check_fits
from dadiff.planning.plans import Plans
from dadiff.randomness import torch_generator
from dadiff.systems.system import System
from dadiff.tasks import Task
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.layout import Layout, TrajectoryLayout

if TYPE_CHECKING:
    from dadiff.behaviours import Projector


class Parts(Protocol):
    """What a denoiser is made from, besides weights."""

    @property
    def sizes(self) -> tuple[int, int | None]:
        """Entries of tau, and of E where it is told that and not something made of it."""
        ...

    def build(self, device: str) -> Denoiser:
        """The denoiser, its weights yet to be filled in."""
        ...


class Denoiser(Protocol):
    """A denoiser that can be stored: trained, or exact."""

    @property
    def made_from(self) -> Parts:
        """All but its weights."""
        ...

    def __call__(self, tau: torch.Tensor, i: int, environment: torch.Tensor) -> torch.Tensor: ...

    def state_dict(self) -> dict[str, torch.Tensor]: ...


@dataclass(frozen=True)
class Planner:
    """Draws plans for a condition E.

    Args:
        task: says what E holds and how long a plan is.
        system: the robot that is planned for, or several.
        schedule, sampler, denoiser: of the diffusion.
        coordinates: where it acts.
        behaviour: what the robot can do; None for vanilla diffusion.
        enforcement: how the set enters the chain.
        starts_fixed: whether x(0) is pinned to x_init of E.
        divergence_bound: a chain is stopped once a value exceeds it, in the sampler's coordinates.
        device: where the chain runs.
        estimate: how uncertain the clean estimate is, where the enforcement weighs by it.
    """

    task: Task
    system: System
    schedule: Schedule
    sampler: Sampler
    denoiser: Denoiser = field(repr=False)
    coordinates: Coordinates
    behaviour: TrajectorySet | None = None
    enforcement: Enforcement | None = None
    starts_fixed: bool = False
    divergence_bound: float = 1e6
    device: str = "cpu"
    estimate: Estimate | None = field(default=None, repr=False)

    @cached_property
    def layout(self) -> TrajectoryLayout:
        """Of the plans."""
        return self.system.layout(self.task.horizon)

    @cached_property
    def steps(self) -> Listed:
        """The sampler's."""
        return Listed(self.sampler.steps(self.schedule))

    @cached_property
    def condition(self) -> Layout:
        """Of E."""
        return self.task.condition(self.system)

    def plan(
        self,
        environment: np.ndarray | None = None,
        *,
        samples: int = 1,
        seed: int = 0,
        start: Plans | None = None,
        pins: Sequence[Pin] = (),
        **fields: object,
    ) -> Plans:
        """Plans for one condition or many.

        Args:
            environment: E (*robots, *cases, c); or give the fields of E by name, such as x_init=[...], target=[...].
            samples: plans for each E.
            seed: of all noise; the same seed gives the same plans.
            start: plans to begin from instead of noise, of the shape of the result; see `Start`.
            pins: further entries of tau that are held, with values (*robots, *cases * samples, k).

        Raises:
            DataError: if a field of E is missing, not known, or unusable, or no plan is asked for.
            ConfigError: if they do not fit into memory.
            ShapeError: if E, or the plans to begin from, have another shape.
        """
        check_fits(24.0 * samples * self.layout.size, f"plan: samples={samples} of {self.layout.size} numbers")
        lead, E = self._flat(self._condition(environment, fields), samples)
        generator = torch_generator(seed, "sampling noise")
        begin = None if start is None else self._begun(start, (*lead, samples)).reshape(*E.shape[:-1], -1)
        project = self.projection(E, pins)
        drawn = self.draw(E, generator, project, start=begin)
        tau = self.coordinates.to_physical(drawn.tau.cpu().numpy())
        return Plans(
            self.layout,
            tau.reshape(*lead, samples, self.layout.size),
            drawn.network_calls,
            drawn.diverged_at,
            0 if project is None else project.info.unconverged,
            self.system.time_step,
        )

    def _condition(self, environment: np.ndarray | None, fields: Mapping[str, object]) -> np.ndarray:
        """E, as it is or from its fields."""
        if environment is None:
            return self.task.environment(self.system, fields)
        if fields:
            raise DataError(f"plan: both E and its fields {', '.join(fields)} are given; give one of them")
        return np.asarray(environment, np.float64)

    def _begun(self, start: Plans, expected: tuple[int, ...]) -> np.ndarray:
        """tau of plans to begin from (*robots, *cases, samples, d)."""
        if start.tau.shape != (*expected, self.layout.size):
            raise ShapeError(
                f"plan: start has shape {start.tau.shape}, expected {(*expected, self.layout.size)}: one for each "
                "plan that is asked for"
            )
        return start.tau

    def _flat(self, E: np.ndarray, samples: int) -> tuple[tuple[int, ...], np.ndarray]:
        """The leading dimensions of E, and E once for each plan, (*robots, plans, c)."""
        robots = self.system.robots
        if samples < 1:
            raise DataError(f"plan: samples is {samples}; ask for at least 1")
        if E.shape[-1:] != (self.condition.size,):
            raise ShapeError(
                f"plan: the condition has shape {E.shape}; its last dimension must be {self.condition.size}: "
                f"{', '.join(self.condition.names)}"
            )
        if E.shape[: len(robots)] != robots:
            E = np.broadcast_to(E, (*robots, *E.shape))
        return E.shape[:-1], np.repeat(E.reshape(*robots, -1, E.shape[-1]), samples, axis=-2)

    def projection(self, E: np.ndarray, pins: Sequence[Pin] = ()) -> Projection | None:
        """The projection onto the set, bound to the plans' conditions (*robots, plans, c); None for vanilla diffusion.

        Raises:
            NotApplicableError: if the enforcement has no meaning for an affine set, and the set is one.
        """
        if self.behaviour is None or self.enforcement is None:
            return None
        start = (Pin.initial_state(self.layout, self.condition.get(E, "x_init")),) if self.starts_fixed else ()
        behaviour = self.behaviour.among(self.condition, E) if isinstance(self.behaviour, Limited) else self.behaviour
        projection = behaviour.bind(self.coordinates, (*start, *pins), self.device)
        if not self.enforcement.affine and projection.affine:
            raise NotApplicableError(
                "enforcement: literal scales the sample, which is meaningless for an affine set (x(0) held, or "
                "coordinates with a mean); use projector.initial_state=free and coordinates=physical, or another "
                "enforcement"
            )
        return projection

    def draw(
        self,
        E: np.ndarray,
        generator: torch.Generator,
        project: Project | None,
        observe: Observe | None = None,
        start: np.ndarray | None = None,
        *,
        signal: float = Start.signal,
        progress: bool = False,
    ) -> Samples:
        """The chain for conditions (*robots, plans, c), in the sampler's coordinates; see `dadiff.diffusion.chain`."""
        return sample(
            self.steps,
            self.schedule,
            self.denoiser,
            torch.as_tensor(E, device=self.device),
            (*E.shape[:-1], self.layout.size),
            generator,
            project,
            self.enforcement,
            observe,
            self.divergence_bound,
            progress,
            estimate=self.estimate,
            start=None if start is None else Start(self._scaled(start), signal),
        )

    def rehearse(self, E: np.ndarray, tau: np.ndarray) -> None:
        """Take the last step of a chain from trajectories (*robots, plans, d) for conditions (*robots, plans, c).

        What keeps the parts from planning together shows here, also before the denoiser is trained.

        Raises:
            NotApplicableError: if the enforcement asks for what the set, the estimate or the denoiser has not.
        """
        self.draw(E, torch_generator(0, "rehearsal"), self.projection(E), start=tau, signal=1.0)

    def _scaled(self, tau: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(self.coordinates.to_scaled(tau), device=self.device)

    def of(self, system: System, projector: Projector) -> Planner:
        """The same network for another robot: what it draws becomes a plan of this system through its own set."""
        return replace(self, system=system, behaviour=projector.fit(system.layout(self.task.horizon), system=system))

    def save(self, path: str | Path) -> Path:
        """Write one self-contained file, see `dadiff.planning.files`."""
        from dadiff.planning.files import save

        return save(self, Path(path))

    @classmethod
    def load(cls, path: str | Path, components: Sequence[str] = (), device: str = "cpu") -> Planner:
        """The planner of a file that `save` wrote, or of a run's folder.

        Args:
            components: packages besides dadiff whose classes the file may name.

        Raises:
            CheckpointError: if the file is foreign, damaged, or of a newer version.
        """
        from dadiff.planning.files import load

        return load(Path(path), components, device)

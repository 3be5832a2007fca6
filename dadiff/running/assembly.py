"""A run before anything is sampled: its components, and the data and denoiser that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dadiff.behaviours import TrajectorySet, Transitions, disturbances, least_squares, starts_fixed
from dadiff.datasets.cached import load_data, save_data
from dadiff.denoisers.recipes import ExactRecipe, Recipe
from dadiff.denoisers.training import InformedTraining
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.measured import asked, measured
from dadiff.errors import ConfigError, NotApplicableError
from dadiff.evaluation import ClosedLoop, Exact
from dadiff.experts.lqr import GaussianLaw
from dadiff.randomness import torch_generator
from dadiff.running.data import told_of_data
from dadiff.running.identity import SHARED, Artefact, Identity, Shared, identity_of
from dadiff.running.parts import Parts
from dadiff.store import Cache, Results
from dadiff.systems import Linear, Recording, Robots, System, Unknown
from dadiff.tasks import Cases, Demonstrations
from dadiff.tasks.encodings import Encoder
from dadiff.tasks.task import Augmenting, Lawful
from dadiff.trajectory.coordinates import Coordinates, physical, standardised
from dadiff.trajectory.layout import Layout, TrajectoryLayout

if TYPE_CHECKING:
    from dadiff.denoisers.encoded import EncodedDenoiser
    from dadiff.denoisers.learned import NetworkDenoiser
    from dadiff.planning import Planner
    from dadiff.planning.planner import Denoiser


@dataclass(frozen=True)
class Experiment:
    """The components of a run, and what follows from them before anything is sampled.

    Args:
        config: the resolved configuration that all of it was made from.
        anew: what is made again though it is in the cache.
    """

    config: Mapping[str, Any]
    parts: Parts
    identity: Identity
    cache: Cache
    results: Results
    anew: Collection[Shared] = ()

    @classmethod
    def of(cls, config: Mapping[str, Any], anew: Collection[Shared] = SHARED) -> Experiment:
        """Assemble a resolved configuration.

        Args:
            anew: what `force` makes again besides the run: everything, where nobody else has done that.

        Raises:
            ConfigError: if it is not valid.
        """
        parts = Parts.of(config)
        output_dir = Path(parts.settings.output_dir).absolute()
        again = anew if parts.settings.force else ()
        return cls(config, parts, identity_of(parts), Cache(output_dir), Results(output_dir), again)

    @property
    def output_dir(self) -> str:
        """Where everything is written."""
        return self.parts.settings.output_dir

    @cached_property
    def target(self) -> System:
        """The system, or the robots, that plans are made for."""
        target = self.parts.task.target(self.parts.system)
        if not isinstance(target, System):
            raise ConfigError(
                "task: it plans for one system, and the chosen system is a family of robots; "
                "use task=fleet for linear robots, task=manoeuvre for nonlinear ones, or a single system such as "
                "system=double_integrator"
            )
        if isinstance(target, Unknown) and isinstance(self.parts.evaluation, ClosedLoop | Exact):
            raise NotApplicableError(
                "evaluation: episodes and exact laws need the system, which is unknown; use evaluation=default"
            )
        if isinstance(self.parts.evaluation, ClosedLoop):
            self.parts.evaluation.steered(self.parts.task, target)
        if isinstance(self.parts.evaluation, Exact) and self.parts.denoiser.trainable:
            raise NotApplicableError(
                "evaluation: the law of a trained denoiser is not known; use denoiser=gaussian or "
                "denoiser=moment_matched, or evaluation=default"
            )
        return target

    @cached_property
    def layout(self) -> TrajectoryLayout:
        """Of this task's trajectories."""
        return self.target.layout(self.parts.task.horizon)

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """What is learned from: from the cache, or made now."""
        _ = self.target  # which refuses a system that the task cannot plan for
        draw = self.parts.dataset.train
        build = partial(save_data, draw=lambda: draw(self.parts.task, self.parts.system))
        return Demonstrations(**load_data(self._cached(self.identity.demonstrations, build)))

    @cached_property
    def cases(self) -> Cases:
        """What is planned for: from the cache, or made now."""
        draw = self.parts.dataset.test
        build = partial(save_data, draw=lambda: draw(self.parts.task, self.target))
        return Cases(self.condition, **load_data(self._cached(self.identity.cases, build)))

    @property
    def condition(self) -> Layout:
        """Of E."""
        return self.parts.task.condition(self.target)

    @cached_property
    def encoder(self) -> Encoder | None:
        """Of E, for a trained denoiser that is told something else than E."""
        return self.parts.encoding.encoder(self.parts.task, self.target) if self.parts.denoiser.trainable else None

    @property
    def _told(self) -> Layout:
        """Of what a network is told."""
        return self.encoder.layout if self.encoder else self.condition

    @cached_property
    def _learned(self) -> tuple[np.ndarray, np.ndarray]:
        """What a network is told (N, f), and the trajectories, or differences to references, that it learns (N, d)."""
        environment, trajectories = self.demonstrations.environment, self.demonstrations.trajectories
        if self.encoder is None:
            return environment, trajectories
        features, reference = self.encoder.encode(environment)
        return features, trajectories - reference

    @cached_property
    def coordinates(self) -> Coordinates:
        """Where diffusion and projection act; standardised by what the network predicts."""
        if self.parts.settings.coordinates == "physical":
            return physical(self.layout)
        return standardised(self.layout, self._learned[1])

    @cached_property
    def device(self) -> str:
        """cpu or cuda.

        Raises:
            ConfigError: if cuda is asked for and not there.
        """
        import torch

        wanted, there = self.parts.settings.device, torch.cuda.is_available()
        if wanted == "cuda" and not there:
            raise ConfigError("device: cuda is asked for, but torch sees no GPU; use device=auto or device=cpu")
        return "cuda" if there and wanted != "cpu" else "cpu"

    @cached_property
    def denoiser(self) -> Denoiser:
        """The exact denoiser, or the trained one from the cache or trained now."""
        recipe = self.parts.denoiser
        if isinstance(recipe, ExactRecipe):
            return recipe.exact(self.law, self.coordinates, self.parts.schedule, self.device)
        return self._trained(recipe)

    @cached_property
    def behaviour(self) -> TrajectorySet | None:
        """What the projector finds admissible; None for vanilla diffusion."""
        return self.parts.projector.fit(self.layout, system=self.target, **self.sources)

    @cached_property
    def told_of_data(self) -> dict[str, float]:
        """What is to be known of data from files, see `dadiff.running.data`."""
        return told_of_data(self)

    @cached_property
    def sources(self) -> dict[str, Any]:
        """What the projector learns from, besides the system."""
        needs, sources = self.parts.projector.needs, dict[str, Any]()
        if "recording" in needs:
            sources["recording"] = self.parts.recording.record(self.target)
        if "demonstrations" in needs:
            sources["demonstrations"] = self.demonstrations.trajectories
        return sources

    @cached_property
    def planner(self) -> Planner:
        """All of it as one thing that plans."""
        _ = self.behaviour, self.told_of_data  # before training: they may refuse what they are given
        return self._planner(self.denoiser)

    def _planner(self, denoiser: Denoiser) -> Planner:
        from dadiff.planning import Planner

        return Planner(
            self.parts.task,
            self.target,
            self.parts.schedule,
            self.parts.sampler,
            denoiser,
            self.coordinates,
            self.behaviour,
            self.parts.enforcement,
            starts_fixed(self.parts.projector),
            self.parts.evaluation.divergence_bound,
            self.device,
            self._weighed_by(denoiser),
        )

    def _weighed_by(self, denoiser: Denoiser) -> Estimate | None:
        """What the enforcement asks for of the estimate's law."""
        by = self.parts.enforcement
        if not by.weighs or self.behaviour is None:
            return None
        trained = not isinstance(self.parts.denoiser, ExactRecipe)
        return self._measured(denoiser) if by.measures and trained else self.estimate

    def rehearse(self, recipe: Recipe) -> None:
        """Plan once with a network that has learned nothing, near a demonstration, so as not to train it in vain.

        Raises:
            DadiffError: if its plans could not be enforced or evaluated as they are asked for.
        """
        network = recipe.build(self.layout, self._told, self.parts.schedule, torch_generator(0, "rehearsal"))
        shown, robots = self.demonstrations, self.target.robots
        E, tau = (np.tile(a[:1], (*robots, 1, 1)) for a in (shown.environment, shown.trajectories))
        self._planner(self._encoded(network.to(self.device))).rehearse(E, tau)

    @cached_property
    def estimate(self) -> Estimate:
        """How uncertain the clean estimate is: of an exact denoiser by its law, else by the demonstrations."""
        shown, where = self.demonstrations, self.coordinates
        if isinstance(self.parts.denoiser, ExactRecipe):
            covariance = self.law.covariance / where.scale[:, None] / where.scale
            return Estimate.of_covariance(self.layout, where, shown.trajectories, covariance)
        return Estimate.of_demonstrations(self.layout, where, shown.trajectories, shown.environment)

    def _measured(self, denoiser: Denoiser) -> Estimate:
        """The network's own errors on demonstrations, in which the noise of linear dynamics is no error."""
        schedule, some = self.parts.schedule, asked(len(self.demonstrations.trajectories), self.layout.size)
        tau, environment = self.demonstrations.trajectories[some], self.demonstrations.environment[some]
        linear = isinstance(self.target, Linear)
        return measured(
            self.estimate,
            denoiser,
            schedule,
            [step.i for step in self.parts.sampler.steps(schedule) if step.call],
            self.coordinates.to_scaled(tau),
            environment,
            disturbances(self.layout, tau, family=isinstance(self.target, Robots)) if linear else None,
            self.device,
        )

    def planner_of(self, robot: int) -> Planner:
        """The planner of one robot of a fleet, its dimension kept; of one system, the planner."""
        if not isinstance(self.target, Robots):
            return self.planner
        one = self.target.take([robot])
        sources = dict(self.sources)
        if (recording := sources.get("recording")) is not None:
            sources["recording"] = Recording(recording.states[robot : robot + 1], recording.inputs[robot : robot + 1])
        return replace(self.planner, system=one, behaviour=self.parts.projector.fit(self.layout, system=one, **sources))

    @property
    def is_done(self) -> bool:
        """Whether there is a result that is only to be read."""
        return not self.parts.settings.force and self.results.is_done(self.identity.key)

    def build(self, kind: Shared) -> None:
        """Build something that is shared with other runs, unless it is cached."""
        getattr(self, kind)

    @cached_property
    def law(self) -> GaussianLaw:
        """Of demonstrations given E.

        Raises:
            ConfigError: if the task's law is not Gaussian.
        """
        task, recipe = self.parts.task, self.parts.denoiser
        if isinstance(self.target, Unknown) and not (isinstance(recipe, ExactRecipe) and recipe.matched):
            raise NotApplicableError(
                "denoiser: the exact denoiser needs the system, which is unknown; use denoiser=moment_matched or mlp"
            )
        if isinstance(recipe, ExactRecipe) and recipe.matched:
            return GaussianLaw.of_demonstrations(self.demonstrations.trajectories, self.demonstrations.environment)
        if not isinstance(task, Lawful):
            raise ConfigError(
                "denoiser: the exact denoiser needs a task whose law is Gaussian; use task=lqr, "
                "denoiser=moment_matched or denoiser=mlp"
            )
        return task.law(self.target)

    @property
    def covariance_trace(self) -> float | None:
        """Of the law of demonstrations given E, averaged over robots; None where the law is not known."""
        if not isinstance(self.parts.task, Lawful) or isinstance(self.target, Unknown):
            return None
        return float(np.square(self.law.noise_map).sum(axis=(-2, -1)).mean())

    def _cached(self, artefact: Artefact, build: Callable[[Path], None], *, resumable: bool = False) -> Path:
        return self.cache.get_or_build(
            artefact.kind,
            artefact.key,
            artefact.determined_by,
            build,
            resumable=resumable,
            anew=artefact.kind in self.anew,
        )

    def _trained(self, recipe: Recipe) -> NetworkDenoiser | EncodedDenoiser:
        from dadiff.denoisers.checkpoints import load

        if self.identity.denoiser is None:
            raise ConfigError("denoiser: it is neither trainable nor exact; see Recipe and ExactRecipe")
        folder = self._cached(self.identity.denoiser, partial(self._train, recipe), resumable=True)
        file, schedule = folder / "model.safetensors", self.parts.schedule
        return self._encoded(load(file, recipe, self.layout, self._told, schedule).to(self.device))

    def _encoded(self, network: NetworkDenoiser) -> NetworkDenoiser | EncodedDenoiser:
        from dadiff.denoisers.encoded import EncodedDenoiser

        if self.encoder is None:
            return network
        return EncodedDenoiser(network, self.encoder, self.coordinates, self.parts.schedule)

    def _train(self, recipe: Recipe, folder: Path) -> None:
        from dadiff.denoisers.learning import train

        if len(self.demonstrations.trajectories):
            self.rehearse(recipe)
        task, (told, learned) = self.parts.task, self._learned
        train(
            recipe,
            self.layout,
            self._told,
            self.parts.schedule,
            self.parts.training,
            learned / self.coordinates.scale if self.encoder else self.coordinates.to_scaled(learned),
            told,
            folder,
            device=self.device,
            augment=task.augment if isinstance(task, Augmenting) and not self.encoder else None,
            dynamics=self._shown_dynamics if isinstance(self.parts.training, InformedTraining) else None,
            progress=self.parts.settings.progress,
        )

    @property
    def _shown_dynamics(self) -> tuple[np.ndarray, np.ndarray]:
        """G (nT, d) and g (nT,) of the linear dynamics that what is learned obeys on the whole, residuals in its units.

        In the coordinates that the network learns in.
        """
        where, learned = self.coordinates, self._learned[1]
        found = least_squares(Transitions.of(*self.layout.split(learned)), "estimated")
        G, g = found.stages(self.layout.horizon).matrix(self.layout)
        return G * where.scale, g if self.encoder else g - G @ where.mean

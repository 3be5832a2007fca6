"""A run before anything is sampled: its components, and the data and denoiser that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from dadiff.config import Parts, assemble
from dadiff.datasets.cached import load_data, save_data
from dadiff.denoisers.checkpoints import load
from dadiff.denoisers.learning import train
from dadiff.errors import ConfigError
from dadiff.running.identity import Artefact, Identity, identify
from dadiff.store import Cache, Results
from dadiff.systems import LinearSystem
from dadiff.tasks import Cases, Demonstrations
from dadiff.trajectory.coordinates import Coordinates, physical, standardised
from dadiff.trajectory.layout import Layout, TrajectoryLayout


@dataclass(frozen=True)
class Experiment:
    """The components of a run, and what follows from them before anything is sampled."""

    parts: Parts
    identity: Identity
    cache: Cache
    results: Results

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Experiment:
        """Assemble a resolved configuration.

        Raises:
            ConfigError: if it is not valid.
        """
        parts = assemble(config, config.get("choices"))
        output_dir = Path(parts.settings.output_dir).absolute()
        return cls(parts, identify(config, parts), Cache(output_dir), Results(output_dir))

    @cached_property
    def target(self) -> LinearSystem:
        """The system, or the robots, that plans are made for."""
        target = self.parts["task"].target(self.parts["system"])
        if not isinstance(target, LinearSystem):
            raise ConfigError(
                "task: it plans for one system, and the chosen system is a family of robots; "
                "use task=fleet, or a single system such as system=double_integrator"
            )
        return target

    @cached_property
    def layout(self) -> TrajectoryLayout:
        """Of this task's trajectories."""
        return self.target.layout(self.parts["task"].horizon)

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """What is learned from: from the cache, or made now."""
        _ = self.target  # which refuses a system that the task cannot plan for
        draw = self.parts["dataset"].train
        build = partial(save_data, draw=lambda: draw(self.parts["task"], self.parts["system"]))
        return Demonstrations(**load_data(self._cached(self.identity.demonstrations, build)))

    @cached_property
    def cases(self) -> Cases:
        """What is planned for: from the cache, or made now."""
        draw = self.parts["dataset"].test
        build = partial(save_data, draw=lambda: draw(self.parts["task"], self.target))
        return Cases(self.condition, **load_data(self._cached(self.identity.cases, build)))

    @property
    def condition(self) -> Layout:
        """Of E."""
        return self.parts["task"].condition(self.target)

    @cached_property
    def coordinates(self) -> Coordinates:
        """Where diffusion and projection act."""
        if self.parts.settings.coordinates == "physical":
            return physical(self.layout)
        return standardised(self.layout, self.demonstrations.trajectories)

    @cached_property
    def device(self) -> str:
        """cpu or cuda.

        Raises:
            ConfigError: if cuda is asked for and not there.
        """
        wanted, there = self.parts.settings.device, torch.cuda.is_available()
        if wanted == "cuda" and not there:
            raise ConfigError("device: cuda is asked for, but torch sees no GPU; use device=auto or device=cpu")
        return "cuda" if there and wanted != "cpu" else "cpu"

    @cached_property
    def denoiser(self) -> Any:
        """The exact denoiser, or the trained one from the cache or trained now."""
        recipe, schedule, artefact = self.parts["denoiser"], self.parts["schedule"], self.identity.denoiser
        if artefact is None:
            return recipe.exact(self._law(), self.coordinates, schedule, self.device)
        folder = self._cached(artefact, self._train, resumable=True)
        file = folder / "model.safetensors"
        return load(file, recipe, self.layout, self.condition, schedule).to(self.device)

    def prepare(self) -> None:
        """Build what is shared with other runs."""
        _ = self.demonstrations, self.cases, self.denoiser

    def _law(self) -> Any:
        task = self.parts["task"]
        if not hasattr(task, "law"):
            raise ConfigError(
                "denoiser: the exact denoiser needs a task whose law is Gaussian; use task=lqr or denoiser=mlp"
            )
        return task.law(self.target)

    def _cached(self, artefact: Artefact, build: Callable[[Path], None], *, resumable: bool = False) -> Path:
        return self.cache.get_or_build(artefact.kind, artefact.key, artefact.determined_by, build, resumable=resumable)

    def _train(self, folder: Path) -> None:
        demonstrations = self.demonstrations
        train(
            self.parts["denoiser"],
            self.layout,
            self.condition,
            self.parts["schedule"],
            self.parts["training"],
            self.coordinates.to_scaled(demonstrations.trajectories),
            demonstrations.environment,
            folder,
            device=self.device,
            augment=getattr(self.parts["task"], "augment", None),
            progress=self.parts.settings.progress,
        )

"""The components of a run, each under the type that its room gives it. Light: no room is loaded for its types."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dadiff.config import Settings, assemble
from dadiff.running.sizes import check_sizes

if TYPE_CHECKING:
    from dadiff.behaviours import Projector
    from dadiff.datasets.generated import Dataset
    from dadiff.denoisers.recipes import ExactRecipe, Recipe
    from dadiff.denoisers.training import Training
    from dadiff.diffusion.enforcement import Enforcement
    from dadiff.diffusion.samplers import Sampler
    from dadiff.diffusion.schedule import Schedule
    from dadiff.evaluation import Evaluation
    from dadiff.systems import Family, System
    from dadiff.systems.recording import Recorder
    from dadiff.tasks import Task
    from dadiff.tasks.encodings import Encoding
    from dadiff.tracking import Tracking


@dataclass(frozen=True)
class Parts:
    """A configuration as components.

    Args:
        settings: what stands beside the groups.
        nodes: group -> its configuration, with every default written out.
    """

    settings: Settings
    nodes: Mapping[str, Mapping[str, Any]]
    system: System | Family
    task: Task
    dataset: Dataset
    recording: Recorder
    schedule: Schedule
    encoding: Encoding
    denoiser: Recipe | ExactRecipe
    training: Training
    sampler: Sampler
    projector: Projector
    enforcement: Enforcement
    evaluation: Evaluation
    tracking: Tracking

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Parts:
        """Those of a resolved configuration.

        Raises:
            ConfigError: if it is not valid, or asks for more memory than there is.
        """
        made = assemble(config)
        parts = cls(made.settings, made.nodes, **made.components)
        check_sizes(parts)
        return parts

"""What a run is: a stable key from everything that can change its result, and a name for people.

The key is a hash of the complete configuration without what cannot matter: paths, tracking, device, verbosity; the
recording where no projector reads it, the enforcement where nothing is projected, the training where nothing is
trained. Data from files count by content, not by place; own components with their sources. The same rule keys data
sets, recordings and trainings, so that the runs of a sweep share them. Free of torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from dadiff.behaviours import NoProjector
from dadiff.config import GROUPS
from dadiff.config.build import TARGET
from dadiff.config.own import is_own, sources_of
from dadiff.datasets.files import FromFiles
from dadiff.datasets.generated import PARTS, Dataset
from dadiff.running import naming
from dadiff.running.digest import digest
from dadiff.running.parts import Parts
from dadiff.systems import Bounds, Family, System
from dadiff.tasks.encodings import Plain
from dadiff.tasks.task import Versioned

FORMAT = 2  # raised whenever a change moves results; see CHANGELOG

WITHIN_BOUNDS = 2  # raised whenever a change moves what experts do within a system's bounds, and nothing else

Shared = Literal["demonstrations", "denoiser", "cases"]
SHARED: tuple[Shared, ...] = get_args(Shared)
"""What runs share, in the order in which it is made."""


@dataclass(frozen=True)
class Artefact:
    """Something shared by runs: its kind, what determines it, and the hash of that.

    Args:
        kind: what is shared is cached; a recording is cheap.
    """

    kind: Shared | Literal["recording"]
    determined_by: dict[str, Any]

    @property
    def key(self) -> str:
        """16 hexadecimal digits."""
        return digest(self.determined_by)


@dataclass(frozen=True)
class Identity:
    """A run's key, name and axes, and what it needs from the cache.

    Args:
        determined_by: everything that can change the result.
        name: for people; two runs may share it.
        axes: flat parameters, the choice of each group under the group's name.
        demonstrations, cases: the two parts of the data set.
        denoiser, recording: None stands for nothing to build.
    """

    determined_by: dict[str, Any]
    name: str
    axes: dict[str, Any]
    demonstrations: Artefact
    cases: Artefact
    denoiser: Artefact | None
    recording: Artefact | None

    @property
    def key(self) -> str:
        """16 hexadecimal digits."""
        return digest(self.determined_by)

    @property
    def links(self) -> dict[str, str]:
        """Kind -> key of what the run is made with."""
        artefacts = (self.demonstrations, self.cases, self.denoiser, self.recording)
        return {artefact.kind: artefact.key for artefact in artefacts if artefact}


def identify(config: Mapping[str, Any]) -> Identity:
    """The identity of a resolved configuration, a nested plain mapping.

    Raises:
        ConfigError: if the configuration is not valid.
    """
    return identity_of(Parts.of(config))


def identity_of(parts: Parts) -> Identity:
    """The identity of a run with these components."""
    given = dict(parts.nodes) | {"recording": _with_noise(parts.nodes["recording"], parts)}
    nodes = {group: _content(getattr(parts, group), node) for group, node in given.items()}
    if _bounded(parts.system):
        nodes["task"]["within_bounds"] = WITHIN_BOUNDS
    matters = _groups_that_matter(parts)
    seed, coordinates = parts.settings.seed, parts.settings.coordinates
    expert = {"format": FORMAT, "system": nodes["system"], "task": nodes["task"]}
    demonstrations = Artefact("demonstrations", expert | {"dataset": nodes["dataset"]["train"]})
    cases = Artefact("cases", expert | {"dataset": nodes["dataset"]["test"]})
    trained = {"demonstrations": demonstrations.key, "coordinates": coordinates}
    learning = [group for group in ("schedule", "encoding", "denoiser", "training") if group in matters]
    denoiser = Artefact("denoiser", trained | {g: nodes[g] for g in learning})
    recording = Artefact("recording", expert | {"recording": nodes["recording"]})
    shown = {group: given[group] for group in matters}
    return Identity(
        {"format": FORMAT, "coordinates": coordinates, **{g: nodes[g] for g in matters}},
        naming.name(shown, seed, coordinates),
        naming.axes(shown, seed, coordinates),
        demonstrations,
        cases,
        denoiser if parts.denoiser.trainable else None,
        recording if "recording" in matters else None,
    )


def _bounded(system: System | Family[Any]) -> bool:
    bounds = system.bounds if isinstance(system, System) else getattr(system, "bounds", None)
    return bounds.any if isinstance(bounds, Bounds) else Bounds.of(bounds).any


def _groups_that_matter(parts: Parts) -> list[str]:
    ignored = {"tracking"}
    if not parts.denoiser.trainable:
        ignored |= {"training", "encoding"}
    if isinstance(parts.encoding, Plain):
        ignored.add("encoding")
    if "recording" not in parts.projector.needs:
        ignored.add("recording")
    if isinstance(parts.projector, NoProjector):
        ignored.add("enforcement")
    return [group for group in GROUPS if group not in ignored]


def _with_noise(node: Mapping[str, Any], parts: Parts) -> dict[str, Any]:
    """A recording that leaves its process noise to the system has that of the system."""
    if "process_noise" in node and node["process_noise"] is None:
        return {**node, "process_noise": np.asarray(parts.system.process_noise).tolist()}
    return dict(node)


def _content(component: Any, node: Mapping[str, Any]) -> dict[str, Any]:
    """The node; of data from files, what they hold in place of their path; of a data set, its two parts.

    Own components count with their sources, tasks with their version.
    """
    made: dict[str, Any] = {}
    if is_own(node[TARGET]):
        made["sources"] = sources_of(node[TARGET])
    if isinstance(component, Versioned):
        made["version"] = component.version
    if isinstance(component, Dataset):
        return {TARGET: node[TARGET], **{str(part): component.determined_by(part) | made for part in PARTS}}
    if isinstance(component, FromFiles):
        made["content"] = component.fingerprint()
        node = {k: v for k, v in node.items() if k != "path"}
    return {**node, **made}

"""What a run is: a stable key from everything that can change its result, and a name for people.

The key is a hash of the complete configuration without what cannot matter: paths, tracking, device, verbosity; the
recording where no projector reads it, the enforcement where nothing is projected, the training where nothing is
trained. Data from files count by content, not by place. The same rule keys data sets, recordings and trainings, so
that cells of a sweep share them. Free of torch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dadiff.behaviours import NoProjector
from dadiff.config import GROUPS
from dadiff.config.build import TARGET, defaults, resolve
from dadiff.datasets.files import FromFiles
from dadiff.datasets.generated import PARTS, Dataset
from dadiff.running.parts import Parts
from dadiff.tasks.encodings import Plain

FORMAT = 2  # raised whenever a change moves results; see CHANGELOG

Shared = Literal["demonstrations", "denoiser", "cases"]


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


def digest(value: Any) -> str:
    """A stable hash of plain data: 16 hexadecimal digits."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def identify(config: Mapping[str, Any]) -> Identity:
    """The identity of a resolved configuration, a nested plain mapping.

    Raises:
        ConfigError: if the configuration is not valid.
    """
    return identity_of(Parts.of(config))


def identity_of(parts: Parts) -> Identity:
    """The identity of a run with these components."""
    nodes = {group: _content(getattr(parts, group), node) for group, node in parts.nodes.items()}
    matters = _groups_that_matter(parts)
    coordinates = parts.settings.coordinates
    expert = {"format": FORMAT, "system": nodes["system"], "task": nodes["task"]}
    demonstrations = Artefact("demonstrations", expert | {"dataset": nodes["dataset"]["train"]})
    cases = Artefact("cases", expert | {"dataset": nodes["dataset"]["test"]})
    trained = {"demonstrations": demonstrations.key, "coordinates": coordinates}
    learning = [group for group in ("schedule", "encoding", "denoiser", "training") if group in matters]
    denoiser = Artefact("denoiser", trained | {g: nodes[g] for g in learning})
    recording = Artefact("recording", expert | {"recording": nodes["recording"]})
    determined_by = {"format": FORMAT, "coordinates": coordinates, **{g: nodes[g] for g in matters}}
    choices = {g: parts.settings.choices.get(g, nodes[g][TARGET].rpartition(".")[2].lower()) for g in matters}
    return Identity(
        determined_by,
        _name(choices, nodes, parts),
        _axes(choices, parts.nodes, parts),
        demonstrations,
        cases,
        denoiser if parts.denoiser.trainable else None,
        recording if "recording" in matters else None,
    )


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


def _content(component: Any, node: Mapping[str, Any]) -> dict[str, Any]:
    """The node; of data from files, what they hold in place of their path; of a data set, its two parts."""
    if isinstance(component, Dataset):
        return {TARGET: node[TARGET], **{part: component.determined_by(part) for part in PARTS}}
    if isinstance(component, FromFiles):
        return {**{k: v for k, v in node.items() if k != "path"}, "content": component.fingerprint()}
    return dict(node)


def _axes(choices: Mapping[str, str], nodes: Mapping[str, Mapping[str, Any]], parts: Parts) -> dict[str, Any]:
    leaves = {f"{g}.{k}": v for g in choices for k, v in nodes[g].items() if k != TARGET}
    initial_state = nodes["projector"].get("initial_state")
    settings = {"seed": parts.settings.seed, "coordinates": parts.settings.coordinates, "initial_state": initial_state}
    return {**choices, **settings, **leaves}


def _name(choices: Mapping[str, str], nodes: Mapping[str, Mapping[str, Any]], parts: Parts) -> str:
    projector = _word("projector", choices, nodes)
    fixed = nodes["projector"].get("initial_state") == "fixed" and not projector.endswith("_fixed")
    words = [_word("task", choices, nodes), projector + ("_fixed" if fixed else "")]
    if "recording" in choices and "length" in nodes["recording"]:
        recording = nodes["recording"]
        words += [f"S={recording['length']}", f"w={recording['process_noise']}"]
        words += [f"recording={recording['seed']}"] if recording["seed"] != parts.settings.seed else []
    others = ("enforcement", "encoding", "denoiser", "sampler")
    words += [_word(group, choices, nodes) for group in others if group in choices]
    return "/".join([*words, f"seed={parts.settings.seed}"])


def _word(group: str, choices: Mapping[str, str], nodes: Mapping[str, Mapping[str, Any]]) -> str:
    """The choice of a group, with the parameters that differ from their defaults: "ddpm(last_step_noise=False)"."""
    usual = defaults(resolve(nodes[group], group, [nodes[group][TARGET].split(".")[0]]))
    node = {name: list(value) if isinstance(value, tuple) else value for name, value in nodes[group].items()}
    usual = {name: list(value) if isinstance(value, tuple) else value for name, value in usual.items()}
    changed = [f"{k}={v}" for k, v in node.items() if k in usual and v != usual[k] and k != "initial_state"]
    return choices[group] + (f"({','.join(changed)})" if changed else "")

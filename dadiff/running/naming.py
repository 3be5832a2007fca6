"""What runs are called, and the flat parameters that they are shown by.

Both follow from the components with their parameters, never from the presets by which they were chosen: two ways to
write one configuration give one name. A component is called as the shipped preset of its class that it is closest to.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from dadiff.config.build import TARGET, defaults, resolve
from dadiff.config.own import is_own
from dadiff.config.settings import GROUPS
from dadiff.folders import shipped
from dadiff.running.digest import digest

Node = Mapping[str, Any]
SAFE = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""In C where it was compiled: every job reads the presets."""

FIRST = ("task", "projector", "recording", "enforcement", "encoding", "denoiser", "sampler")
"""Groups that every name shows, as far as they matter; others where they are not what the task usually has."""

LONGEST_VALUE, LONGEST_WORD = 24, 60
TOLD_APART = {"projector": ("initial_state",), "recording": ("length", "process_noise", "seed")}
"""Parameters that names show in another way."""


def axes(nodes: Mapping[str, Node], seed: int, coordinates: str) -> dict[str, Any]:
    """The name of each component under its group, and its parameters under dotted names."""
    names = {group: closest(group, node, seed)[0] for group, node in nodes.items()}
    leaves = {f"{group}.{k}": v for group, node in nodes.items() for k, v in node.items() if k != TARGET}
    state = nodes["projector"].get("initial_state")
    return {**names, "seed": seed, "coordinates": coordinates, "initial_state": state, **leaves}


def name(nodes: Mapping[str, Node], seed: int, coordinates: str) -> str:
    """A name for people: what every run has, then what differs from what the task usually has, then the seed."""
    usual = usual_of(closest("task", nodes["task"], seed)[0])
    words = [word(group, nodes[group], seed) for group in FIRST if group in nodes]
    for group in (group for group in nodes if group not in FIRST):
        shown = word(group, nodes[group], seed)
        words += [shown] if shown != word(group, usual.nodes[group], seed) else []
    words += [coordinates] if coordinates != usual.coordinates else []
    return "/".join([*words, f"seed={seed}"])


def word(group: str, node: Node, seed: int) -> str:
    """A component with the parameters that are not those of the preset it is called by: "dpm_solver(eta=1.0)"."""
    preset, changed = closest(group, node, seed)
    changed = {k: v for k, v in changed.items() if k not in TOLD_APART.get(group, ())}
    text = ",".join(f"{k}={_shortened(k, v)}" for k, v in changed.items())
    if len(text) > LONGEST_WORD:
        text = f"{text[: LONGEST_WORD - 6]}…{digest(list(changed.values()))[:4]}"
    if group == "projector" and node.get("initial_state") == "fixed":
        preset += "_fixed"
    said = preset + (f"({text})" if text else "")
    return _recording(said, node, seed) if group == "recording" else said


def _recording(said: str, node: Node, seed: int) -> str:
    if "length" not in node:
        return said
    parts = [] if said == "gaussian" else [said]
    parts += [f"S={node['length']}", f"w={_shortened('process_noise', node.get('process_noise'))}"]
    return "/".join([*parts, *([f"recording={node['seed']}"] if node.get("seed", seed) != seed else [])])


def _shortened(key: str, value: Any) -> str:
    text = Path(str(value)).name if key == "path" else str(value).replace(" ", "")
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 5]}…{digest(str(value))[:4]}"


def closest(group: str, node: Node, seed: int) -> tuple[str, dict[str, Any]]:
    """The preset of the component's class with the fewest other parameters, and the component's own values of those."""
    presets = _presets(group).get(node[TARGET]) or {_snake(node[TARGET].rpartition(".")[2]): {}}
    signature = _signature(group, node[TARGET])
    found = [(preset, _changed(node, {**signature, **given}, seed)) for preset, given in presets.items()]
    return min(found, key=lambda entry: (len(entry[1]), entry[0]))


def _changed(node: Node, usual: Node, seed: int) -> dict[str, Any]:
    usual = {**usual, "seed": seed}
    return {
        k: v for k, v in node.items() if k in usual and not _interpolated(usual[k]) and _plain(v) != _plain(usual[k])
    }


def _interpolated(value: Any) -> bool:
    return isinstance(value, str) and "${" in value


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _signature(group: str, target: str) -> dict[str, Any]:
    return _own_signature(group, target) if is_own(target) else _shipped_signature(group, target)


def _own_signature(group: str, target: str) -> dict[str, Any]:
    return defaults(resolve({TARGET: target}, group, [target.partition(".")[0]]))


_shipped_signature = cache(_own_signature)


@cache
def _presets(group: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Class -> the shipped presets that name it themselves -> their parameters."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for file in sorted((shipped("conf") / group).glob("*.yaml")):
        content, _ = _read(file)
        node = content.get(group, content)
        if TARGET in node:
            found.setdefault(node[TARGET], {})[file.stem] = {k: v for k, v in node.items() if k != TARGET}
    return found


def _read(file: Path) -> tuple[dict[str, Any], Sequence[Any]]:
    """A preset's content and its list of defaults."""
    content = yaml.load(file.read_text(), Loader=SAFE)
    return content, content.pop("defaults", [])


@dataclass(frozen=True)
class Usual:
    """What runs of a task have where nothing else is chosen."""

    nodes: Mapping[str, Node]
    coordinates: str


@cache
def usual_of(task: str) -> Usual:
    """That of a shipped task; of another one what every task has."""
    content, choices = _read(shipped("conf") / "config.yaml")
    chosen = {group: preset for entry in choices if isinstance(entry, dict) for group, preset in entry.items()}
    file = shipped("conf") / "task" / f"{task}.yaml"
    own, overrides = _read(file) if file.is_file() else ({}, [])
    chosen |= {group.removeprefix("override /"): name for entry in overrides for group, name in dict(entry).items()}
    nodes = {group: _node(group, chosen[group]) | own.get(group, {}) for group in GROUPS if group != "task"}
    said = {group: {k: v for k, v in node.items() if not _interpolated(v)} for group, node in nodes.items()}
    return Usual(said, own.get("coordinates", content["coordinates"]))


def _node(group: str, preset: str) -> dict[str, Any]:
    """A preset over those that it starts from, with the defaults of its class."""
    content, parents = _read(shipped("conf") / group / f"{preset}.yaml")
    below = {k: v for parent in parents if parent != "_self_" for k, v in _node(group, parent).items()}
    target = str(content.get(TARGET, below.get(TARGET)))
    return {TARGET: target, **_signature(group, target), **below, **content}

"""The configuration as a whole: its groups, its top-level settings, and its assembly into components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dadiff.config.build import TARGET, check, defaults, resolve
from dadiff.config.trust import check_trusted, trusted
from dadiff.errors import ConfigError

GROUPS = (
    "system",
    "task",
    "dataset",
    "recording",
    "schedule",
    "encoding",
    "denoiser",
    "training",
    "sampler",
    "projector",
    "enforcement",
    "evaluation",
    "tracking",
)


@dataclass(frozen=True)
class Settings:
    """What stands beside the groups.

    Args:
        seed: the root seed; each role derives its own stream.
        coordinates: where diffusion and projection act: `physical` units (the paper), or `standardised` channels.
        device: `auto` takes a GPU if there is one.
        output_dir: where everything is written.
        components: packages besides dadiff whose classes are named; trusted on the command line only.
        force: make anew what is done: data, training and run.
        dry_run: say what would run, and stop.
        progress: show progress bars.
        choices: the preset chosen in each group, for names and messages; filled in by the command line.
    """

    seed: int = 0
    coordinates: Literal["physical", "standardised"] = "physical"
    device: Literal["auto", "cpu", "cuda"] = "auto"
    output_dir: str = "outputs"
    components: Sequence[str] = ()
    force: bool = False
    dry_run: bool = False
    progress: bool = True
    choices: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Assembled:
    """A configuration that was checked and built.

    Args:
        nodes: group -> its configuration, with every parameter that was left to its default.
        components: group -> what was built of it.
    """

    settings: Settings
    nodes: Mapping[str, Mapping[str, Any]]
    components: Mapping[str, Any]


def settings_of(config: Mapping[str, Any]) -> Settings:
    """The checked top-level settings.

    Raises:
        ConfigError: on an unknown key, a missing group or a wrong type, or where a file trusts a package.
    """
    top = {key: value for key, value in config.items() if key not in GROUPS}
    settings = Settings(**check(top, Settings, "config.yaml"))
    check_trusted(settings.components)
    return settings


def assemble(config: Mapping[str, Any]) -> Assembled:
    """Build every component of a resolved configuration, after all of it is checked.

    Args:
        config: nested plain mapping; `choices` says which preset each group is, so that messages can name the file.

    Raises:
        ConfigError: if anything in it is not valid.
    """
    settings = settings_of(config)
    targets, given, nodes = {}, {}, {}
    for group in GROUPS:
        node, place = _node(config, group), where(group, settings.choices)
        targets[group] = resolve(node, place, trusted())
        given[group] = check(node, targets[group], place)
        nodes[group] = {TARGET: node[TARGET], **defaults(targets[group]), **given[group]}
    # the system last: it loads python-control, and mistakes elsewhere are told before
    built = {group: targets[group](**given[group]) for group in reversed(GROUPS)}
    return Assembled(settings, nodes, built)


def where(group: str, choices: Mapping[str, str] | None = None) -> str:
    """How messages name a group: with its file, where that is known."""
    return f"{group} ({group}/{choices[group]}.yaml)" if choices and group in choices else group


def _node(config: Mapping[str, Any], group: str) -> Mapping[str, Any]:
    node = config.get(group)
    if not isinstance(node, Mapping) or TARGET not in node:
        raise ConfigError(f"{group}: no component is configured; choose one with {group}=...")
    return node

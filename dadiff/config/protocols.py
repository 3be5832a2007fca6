"""What a component of each group must offer, held against a target before anything of it is executed.

A group's protocol is a class of its room: a `typing.Protocol`, whose members the target's class must have and whose
methods must be callable in the same way, or a plain class, which the target must be, extend or return. A function
counts as what its annotation says that it returns.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, get_type_hints

from dadiff.errors import ConfigError

PROTOCOLS: Mapping[str, tuple[str, ...]] = {
    "system": ("dadiff.systems.System", "dadiff.systems.Family"),
    "task": ("dadiff.tasks.Task",),
    "dataset": ("dadiff.datasets.generated.Dataset",),
    "recording": ("dadiff.systems.recording.Recorder",),
    "schedule": ("dadiff.diffusion.schedule.Schedule",),
    "encoding": ("dadiff.tasks.encodings.Encoding",),
    "denoiser": ("dadiff.denoisers.recipes.Recipe", "dadiff.denoisers.recipes.ExactRecipe"),
    "training": ("dadiff.denoisers.training.Training",),
    "sampler": ("dadiff.diffusion.samplers.Sampler",),
    "projector": ("dadiff.behaviours.Projector",),
    "enforcement": ("dadiff.diffusion.enforcement.Enforcement",),
    "evaluation": ("dadiff.evaluation.Evaluation",),
    "tracking": ("dadiff.tracking.Tracking",),
}
"""Group -> the protocols of which a component must meet one."""


def check_component(group: str, target: Callable[..., Any], where: str) -> None:
    """Refuse a target that is no component of its group. Nothing of the target is executed.

    Args:
        where: what to call the node in messages.

    Raises:
        ConfigError: naming what the target lacks.
    """
    made = _made_by(target, f"{where}: {target.__module__}.{target.__qualname__} is no {group}")
    if inspect.isabstract(made) or getattr(made, "_is_protocol", False):
        raise ConfigError(f"{where}: {made.__module__}.{made.__qualname__} is abstract; name a class that extends it")
    lacking = [_lacks(made, _protocol(path)) for path in PROTOCOLS[group]]
    if not any(lacks is None for lacks in lacking):
        name = f"{target.__module__}.{target.__qualname__}"
        raise ConfigError(f"{where}: {name} is no {group}: {' and '.join(filter(None, lacking))}")


def _made_by(target: Callable[..., Any], where: str) -> type:
    """The class of what calling the target gives."""
    if inspect.isclass(target):
        return target
    try:
        made = get_type_hints(target).get("return")
    except (NameError, TypeError) as error:
        raise ConfigError(f"{where}: its annotations cannot be read ({error})") from error
    if not inspect.isclass(made):
        raise ConfigError(f"{where}: it does not say what class it returns; annotate it")
    return made


@cache
def _protocol(path: str) -> type:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


@cache
def _lacks(made: type, protocol: type) -> str | None:
    """What keeps a class from meeting the protocol; None if it meets it."""
    if not getattr(protocol, "_is_protocol", False):
        return None if issubclass(made, protocol) else f"it gives no {protocol.__name__}"
    names, methods = _members(protocol)
    if absent := [name for name in sorted(names) if not _has(made, name)]:
        return f"it has no {absent[0]}"
    odd = [name for name, wanted in methods.items() if not _callable_as(getattr(made, name), wanted)]
    return f"its {odd[0]} does not take {inspect.signature(methods[odd[0]])}" if odd else None


def _members(protocol: type) -> tuple[set[str], dict[str, Callable[..., Any]]]:
    """The names that a protocol asks for, and its methods."""
    layers = [layer for layer in protocol.__mro__ if getattr(layer, "_is_protocol", False)]
    own = {name: value for layer in reversed(layers) for name, value in vars(layer).items() if name[0] != "_"}
    annotated = {name for layer in layers for name in inspect.get_annotations(layer)}
    return own.keys() | annotated, {name: value for name, value in own.items() if inspect.isfunction(value)}


def _has(made: type, name: str) -> bool:
    return hasattr(made, name) or any(name in inspect.get_annotations(layer) for layer in made.__mro__)


def _callable_as(method: Any, wanted: Callable[..., Any]) -> bool:
    """Whether a method can be called as another one is: needed arguments in order, the rest by name."""
    if not callable(method):
        return False
    parameters = inspect.signature(wanted).parameters.values()
    needed = [None for p in parameters if p.default is p.empty]
    optional = {p.name: None for p in parameters if p.default is not p.empty}
    try:
        inspect.signature(method).bind(*needed, **optional)
    except (TypeError, ValueError):
        return False
    return True

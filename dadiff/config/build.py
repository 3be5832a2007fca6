"""Components from configuration: a mapping with `_target_` becomes an object, after every key and type is checked.

The target's signature is the schema: a dataclass or an annotated function. A misspelt key or a wrong type is an error
that names the file and the key. Only components of the node's group are built, from this package and from those that
the user trusts.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from dadiff.config import own
from dadiff.config.protocols import check_component
from dadiff.errors import ConfigError

TARGET = "_target_"
MADE = "; no yaml holds one: let _target_ name a function that makes it, such as dadiff.systems.inline of matrices"
STRICT = ConfigDict(strict=True, arbitrary_types_allowed=True)


def build(node: Mapping[str, Any], where: str, trusted: Sequence[str] = ()) -> Any:
    """The component that a configuration node describes.

    Args:
        node: `_target_` and the target's parameters.
        where: its group, and what to call it in messages, for example "projector (projector/known.yaml)".
        trusted: packages besides this one whose targets may be built.

    Raises:
        ConfigError: on an unknown key, a missing one, a wrong type, or a target that is not trusted or not there.
    """
    target = resolve(node, where, trusted)
    return target(**check(node, target, where))


def defaults(target: Callable[..., Any]) -> dict[str, Any]:
    """The parameters that a target does not need to be given."""
    parameters = _parameters(target).items()
    return {name: parameter.default for name, parameter in parameters if parameter.default is not parameter.empty}


def resolve(node: Mapping[str, Any], where: str, trusted: Sequence[str] = ()) -> Callable[..., Any]:
    """Import the node's target.

    Raises:
        ConfigError: if it is missing, not trusted, cannot be found, or is no component of the node's group.
    """
    path = node.get(TARGET)
    if not isinstance(path, str) or "." not in path:
        raise ConfigError(f"{where}: {TARGET} is {path!r}; expected the dotted name of a class or function")
    state = own.state_of(path) if path.split(".")[0] in trusted else None
    return _found(path, where, frozenset({"dadiff", *trusted}), state)


@cache
def _found(path: str, where: str, roots: frozenset[str], state: str | None) -> Callable[..., Any]:
    """The target, looked up once as long as its sources stay as they are."""
    if path.split(".")[0] not in roots:
        raise ConfigError(
            f"{where}: {TARGET} {path} lies outside dadiff and is not built; "
            f"to trust its package add components=[{path.split('.')[0]}]"
        )
    module, _, name = path.rpartition(".")
    try:
        target = getattr((own.load if own.is_own(path) else importlib.import_module)(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise ConfigError(f"{where}: {TARGET} {path} cannot be found ({error})") from error
    # What a trusted module has itself imported, such as pathlib.Path, is not the trusted package's.
    if not callable(target) or target.__module__.split(".")[0] not in roots:
        raise ConfigError(f"{where}: {TARGET} {path} is no class or function of {path.split('.')[0]}")
    check_component(where.split()[0], target, where)
    return target


def check(node: Mapping[str, Any], target: Callable[..., Any], where: str) -> dict[str, Any]:
    """The node's parameters, checked against the target's signature."""
    try:
        parameters, hints = _parameters(target), _hints(target)
    except (NameError, TypeError) as error:
        raise ConfigError(f"{where}: the annotations of {target.__qualname__} cannot be read ({error})") from error
    given = {key: value for key, value in node.items() if key != TARGET}
    for key in given:
        if key not in parameters:
            raise ConfigError(f"{where}: {_unknown(key, list(parameters))}")
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and given.get(name) is None:
            raise ConfigError(f"{where}: {name} is missing; give {where.split()[0]}.{name}=...")
    for key in given:
        if key not in hints:
            raise ConfigError(f"{where}: {key} has no type in {target.__qualname__}; annotate every parameter")
    return {key: _typed(value, hints[key], f"{where}: {key}") for key, value in given.items()}


@cache
def _parameters(target: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """Of a target; read once, since a sweep asks for every cell."""
    return inspect.signature(target).parameters


@cache
def _hints(target: Callable[..., Any]) -> dict[str, Any]:
    """The types of a target's parameters."""
    plain_class = inspect.isclass(target) and not is_dataclass(target)
    return get_type_hints(target.__init__ if plain_class else target)


@cache
def _adapter(hint: Any) -> TypeAdapter[Any]:
    """What checks values of a type; made once."""
    return TypeAdapter(hint, config=STRICT)


def _unknown(key: str, known: list[str]) -> str:
    close = difflib.get_close_matches(key, known, 1)
    advice = f"did you mean {close[0]}?" if close else f"known keys: {', '.join(known) or 'none'}"
    return f"key {key!r} is not known; {advice}"


def _typed(value: Any, hint: Any, where: str) -> Any:
    try:
        return _adapter(hint).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        told = f"{where} is {first['input']!r}: {first['msg'][0].lower()}{first['msg'][1:]}"
        raise ConfigError(told + (MADE if first["type"] == "is_instance_of" else "")) from error

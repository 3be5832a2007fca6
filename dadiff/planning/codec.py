"""Frozen dataclasses as plain data and arrays, and back: how a planner is stored without code.

A dataclass is its class's name and its fields; an array is a name in a table of arrays. Nothing but a dataclass of
dadiff's rooms of subject, or of a package that the caller names, is ever made from a file.
"""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from dadiff.errors import CheckpointError, DadiffError

ROOMS = ("trajectory", "systems", "experts", "tasks", "behaviours", "diffusion", "denoisers", "planning")
"""The rooms whose dataclasses hold values and do nothing when they are made."""

Plain = Any  # what json holds


@dataclass
class Encoder:
    """Turns values into plain data, and collects the arrays.

    Attributes:
        arrays: name -> array, the names being the places where they were found.
    """

    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    def __call__(self, value: Any, place: str) -> Plain:
        """Plain data for a value at a place, such as "planner.system.A".

        Raises:
            CheckpointError: if there is a value, such as a function, that cannot be stored.
        """
        if value is None or isinstance(value, bool | int | str):
            return value
        if isinstance(value, float | np.floating):
            return float(value) if math.isfinite(value) else {"number": str(float(value))}
        if isinstance(value, np.ndarray):
            self.arrays[place] = np.ascontiguousarray(value).reshape(value.shape)
            return {"array": place}
        if is_dataclass(value) and not isinstance(value, type):
            return {"class": name_of(type(value)), "fields": self._fields(value, place)}
        if isinstance(value, Mapping):
            return {"mapping": {str(key): self(item, f"{place}.{key}") for key, item in value.items()}}
        if isinstance(value, list | tuple):
            kind = "tuple" if isinstance(value, tuple) else "list"
            return {kind: [self(item, f"{place}.{k}") for k, item in enumerate(value)]}
        raise CheckpointError(
            f"{place}: is a {type(value).__name__}, which cannot be stored in a file; make it a dataclass of numbers, "
            "arrays and strings"
        )

    def _fields(self, value: Any, place: str) -> dict[str, Plain]:
        """What its constructor takes."""
        names = inspect.signature(type(value)).parameters
        return {name: self(getattr(value, name), f"{place}.{name}") for name in names}


@dataclass(frozen=True)
class Decoder:
    """Turns plain data back into values.

    Args:
        arrays: as collected by the encoder.
        where: what messages begin with, the file's name.
        components: packages besides dadiff whose dataclasses may be made.
    """

    arrays: Mapping[str, np.ndarray]
    where: str
    components: Sequence[str] = ()

    def __call__(self, plain: Plain) -> Any:
        """The value.

        Raises:
            CheckpointError: if the data are not what an encoder wrote.
        """
        if not isinstance(plain, dict):
            return plain
        match plain:
            case {"number": "nan" | "inf" | "-inf" as text}:
                return float(text)
            case {"array": str(name)} if name in self.arrays:
                return self.arrays[name]
            case {"class": str(name), "fields": dict(given)}:
                return self._made(name, {key: self(item) for key, item in given.items()})
            case {"mapping": dict(items)}:
                return {key: self(item) for key, item in items.items()}
            case {"tuple": list(items)}:
                return tuple(self(item) for item in items)
            case {"list": list(items)}:
                return [self(item) for item in items]
        raise CheckpointError(f"{self.where}: holds {str(plain)[:60]}, which is no part of a planner; save it again")

    def _made(self, name: str, given: dict[str, Any]) -> Any:
        made = self.class_of(name)
        self.check(made, given)
        try:
            return made(**given)
        except DadiffError as error:
            raise CheckpointError(f"{self.where}: {error}") from error
        except (TypeError, ValueError, AttributeError, IndexError, KeyError) as error:
            raise CheckpointError(
                f"{self.where}: its {made.__name__} does not fit this version ({error}); save it again"
            ) from error

    def check(self, made: type, given: Mapping[str, Any]) -> None:
        """Refuse values that are none of the types that a dataclass annotates.

        Raises:
            CheckpointError: naming the field.
        """
        for name, hint in _hints(made).items():
            if name in given and not _fits(given[name], hint):
                raise CheckpointError(
                    f"{self.where}: {name} of its {made.__name__} is {str(given[name])[:60]}, which is no "
                    f"{getattr(hint, '__name__', str(hint))}; save it again"
                )

    def class_of(self, name: str) -> type:
        """The frozen dataclass of a stored name, "dadiff.systems.linear:Linear".

        Raises:
            CheckpointError: if it is no such class, or of a package that is not trusted.
        """
        module, _, qualified = name.partition(":")
        root, *rest = module.split(".")
        trusted = (root == "dadiff" and rest and rest[0] in ROOMS) or root in self.components
        if not trusted:
            hint = "" if root == "dadiff" else f'; to trust its package load with components=["{root}"]'
            raise CheckpointError(f"{self.where}: names {name[:80]}, which is not built from a file{hint}")
        try:
            found = getattr(importlib.import_module(module), qualified)
        except (ImportError, AttributeError) as error:
            raise CheckpointError(
                f"{self.where}: names {name[:80]}, which this version does not have; save it again"
            ) from error
        if not (isinstance(found, type) and is_dataclass(found) and found.__module__ == module):
            raise CheckpointError(f"{self.where}: names {name[:80]}, which is no dataclass of that module")
        return found


@cache
def _hints(made: type) -> dict[str, Any]:
    """The types of a dataclass's fields; of one that names types which are there for checkers only, none."""
    try:
        return get_type_hints(made)
    except NameError:
        return {}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a type; of containers, whose parts are checked where they are made, nothing is said."""
    if get_origin(hint) in (Union, UnionType):
        return any(_fits(value, part) for part in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    is_open = getattr(hint, "_is_protocol", False) and not getattr(hint, "_is_runtime_protocol", False)
    return isinstance(value, hint) if isinstance(hint, type) and not is_open else True


def name_of(kind: type) -> str:
    """Module and name, as stored."""
    return f"{kind.__module__}:{kind.__qualname__}"

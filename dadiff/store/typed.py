"""JSON files of ours as typed values: what is missing or of a wrong type is one line, what is newer is left aside."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dadiff.errors import DataError
from dadiff.store.files import read_json

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Kind = TypeVar("Kind")


def read_typed(path: Path, kind: type[Kind]) -> Kind:
    """The dataclass that a file holds; fields that this version does not know are left aside.

    Raises:
        DataError: if the file is missing or damaged, or a field is missing or of a wrong type.
        StoreError: if its format is newer than this version reads.
    """
    return typed(read_json(path), kind, path)


def typed(stored: Mapping[str, Any], kind: type[Kind], path: Path) -> Kind:
    """A dataclass from plain data.

    Args:
        path: where it was read, for messages.

    Raises:
        DataError: if a field is missing or of a wrong type.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(stored)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors()[0]
        where, what = ".".join(map(str, first["loc"])), f"{first['msg'][0].lower()}{first['msg'][1:]}"
        raise DataError(f"{path}: {where}: {what}; remove it and run again") from error


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)

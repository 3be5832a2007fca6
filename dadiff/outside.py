"""What comes from outside is judged before it is read: files of others, their sizes, addresses with passwords.

Nothing here waits for a pipe or a device, follows aliases without end, or makes room for what a header merely claims.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Hashable
from pathlib import Path
from typing import Any

from dadiff.errors import DataError

MOST_TEXT = 64 * 2**20
"""Bytes of a json or yaml file: the largest of ours, the record of a sweep of 10,000 cells, has 20 MB."""

MOST_ALIASED = 100_000
"""Nodes of a yaml file once its aliases are written out."""

PASSWORD = re.compile(r"(\w[\w+.-]*://[^\s/:@'\"]*):[^\s/@'\"]*@")


def regular(path: Path) -> Path:
    """The path, if a plain file lies there: reading pipes and devices may never end.

    Raises:
        DataError: if it is missing, or no plain file.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(mode):
        raise DataError(f"{path}: is no plain file")
    return path


def text_of(path: Path) -> str:
    """The text of a plain file.

    Raises:
        DataError: if there is none, it is too long, or no text.
    """
    if (size := regular(path).stat().st_size) > MOST_TEXT:
        raise DataError(f"{path}: has {size:,} bytes; at most {MOST_TEXT:,} are read")
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is no text ({error})") from error


def yaml_of(path: Path) -> Any:
    """The plain data in a yaml file.

    Raises:
        DataError: if it cannot be read, is no yaml, or grows beyond measure by its aliases.
    """
    import yaml

    try:
        node = yaml.compose(text_of(path), Loader=yaml.SafeLoader)
        check_aliases(node, str(path))
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise DataError(f"{path}: not readable as yaml: {' '.join(str(error).split())}") from error


def check_aliases(root: Any, where: str) -> None:
    """Refuse a yaml document that a few aliases of aliases make endless.

    Args:
        root: its first node, as `yaml.compose` gives it.

    Raises:
        DataError: if it has too many nodes once every alias is written out.
    """
    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        if id(node) not in sizes:
            sizes[id(node)] = 1  # while it is being counted, so that a node inside itself ends
            parts = node.value if isinstance(getattr(node, "value", None), list) else []
            inner = [part for entry in parts for part in (entry if isinstance(entry, tuple) else (entry,))]
            sizes[id(node)] = 1 + sum(map(size, inner))
        return sizes[id(node)]

    if root is not None and (count := size(root)) > MOST_ALIASED:
        raise DataError(
            f"{where}: has {count:,} values once its aliases are written out; at most {MOST_ALIASED:,} are read"
        )


def without_passwords(text: str) -> str:
    """Text as it may be shown: "postgresql://me:secret@host/db" becomes "postgresql://me@host/db"."""
    return PASSWORD.sub(r"\1@", text)


def spreadsheet_safe(value: Hashable) -> Hashable:
    """A cell of a table as text that a spreadsheet takes for text, not for a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in "=+-@\t\r" and value else value

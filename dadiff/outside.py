"""What comes from outside is judged before it is read: files of others, their sizes, addresses with passwords.

Nothing here waits for a pipe or a device, follows aliases without end, or makes room for what a header merely claims.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from dadiff.errors import DataError
from dadiff.memory import available, in_words

if TYPE_CHECKING:
    import numpy as np

UNREADABLE = (
    *(OSError, EOFError, ValueError, SyntaxError, RuntimeError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What zipfile and numpy raise on damaged, encrypted or unknown content, and on pickled objects."""

OBJECTS = "it holds Python objects, which are never loaded: write numbers, and runs of different lengths as files"
"""What to say of an array that only pickle reads."""

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


def json_of(path: Path) -> Any:
    """The plain data in a json file.

    Raises:
        DataError: if it cannot be read, or is no json.
    """
    try:
        return json.loads(text_of(path))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as json: {error}") from error


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
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
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


def digest_of(paths: Iterable[Path], root: Path | None = None) -> str:
    """A hash of what plain files hold and, below `root`, of how they are called: 16 hexadecimal digits.

    Raises:
        DataError: if one is no plain file.
    """
    digest = hashlib.sha256()
    for path in paths:
        if root is not None:
            digest.update(path.relative_to(root).as_posix().encode())
        with regular(path).open("rb") as stream:
            while block := stream.read(2**20):
                digest.update(block)
    return digest.hexdigest()[:16]


@contextmanager
def npz(path: Path, what: str = "an array") -> Iterator[np.lib.npyio.NpzFile]:
    """An .npz file open for reading, its headers judged; nothing in it is executed.

    Args:
        what: is read from it, for the message.

    Raises:
        DataError: if it is no such file, declares more than it holds or than fits, or what is read is damaged.
    """
    import numpy as np

    if not zipfile.is_zipfile(regular(path)):
        raise DataError(f"{path}: is not a readable .npz file; write it with numpy.savez")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_headers(archive, path)
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except UNREADABLE as error:
        found = OBJECTS if "Object arrays" in str(error) else " ".join(str(error).split())
        raise DataError(f"{path}: {what} cannot be read ({found})") from error


def _check_headers(archive: zipfile.ZipFile, path: Path) -> None:
    members = archive.infolist()
    if (size := sum(member.file_size for member in members)) > available():
        raise DataError(f"{path}: holds {in_words(size)} when unpacked, {in_words(available())} of memory are there")
    for member in members:
        with archive.open(member) as stream:
            declared = _declared(stream)
        if declared > member.file_size:
            raise DataError(
                f"{path}: array {member.filename.removesuffix('.npy')} claims {in_words(declared)} and holds "
                f"{in_words(member.file_size)}; it is damaged or made up"
            )


def _declared(stream: IO[bytes]) -> int:
    """Bytes of the array that an .npy header claims."""
    from numpy.lib import format as npy

    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, _, dtype = readers.get(npy.read_magic(stream), _unknown)(stream)
    return math.prod(shape) * dtype.itemsize


def _unknown(stream: IO[bytes]) -> Any:
    raise ValueError("an array of a format that holds no plain numbers")


def check_parquet(path: Path) -> None:
    """Refuse a table that unpacks to more than fits: a few bytes may stand for any number of equal rows.

    Raises:
        DataError: with the estimate.
    """
    from pyarrow.parquet import read_metadata

    metadata = read_metadata(path)
    if (size := 8 * metadata.num_rows * metadata.num_columns) > available():
        raise DataError(f"{path}: holds {in_words(size)} when unpacked, {in_words(available())} of memory are there")


def without_passwords(text: str) -> str:
    """Text as it may be shown: "postgresql://me:secret@host/db" becomes "postgresql://me@host/db"."""
    return PASSWORD.sub(r"\1@", text)


def passwords_removed(value: Any) -> Any:
    """Plain data with `without_passwords` applied to every text in it."""
    if isinstance(value, Mapping):
        return {name: passwords_removed(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [passwords_removed(part) for part in value]
    return without_passwords(value) if isinstance(value, str) else value


def spreadsheet_safe(value: Any) -> Any:
    """A cell of a table: text that a spreadsheet would take for a formula gets the mark of text before it."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value

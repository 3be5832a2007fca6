"""The forms of keys and names. What comes from a file or a server becomes part of a path only if it has its form."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

from dadiff.errors import StoreError

KEY = re.compile(r"[0-9a-f]{16}")
KIND = re.compile(r"[a-z]{1,32}")
SWEEP = re.compile(r"(?![.-])[^/\\\x00-\x1f\x7f]{1,100}")
FILE = re.compile(r"[A-Za-z_][\w-]{0,63}\.[a-z]{2,16}")


def key_of(text: object) -> str:
    """A key: 16 hexadecimal digits.

    Raises:
        StoreError: if it is none.
    """
    return _formed(text, KEY, "key", "16 hexadecimal digits")


def kind_of(text: object) -> str:
    """What is cached: "demonstrations", "cases", "denoiser".

    Raises:
        StoreError: if it is no word.
    """
    return _formed(text, KIND, "kind", "a word")


def sweep_name(text: object) -> str:
    """A sweep's name, which is no path.

    Raises:
        StoreError: if it is none.
    """
    return _formed(text, SWEEP, "name of a sweep", "at most 100 characters, no '/' and no '.' first: it is no path")


def file_name(text: object) -> str:
    """The name of a file beside others, which leads nowhere else.

    Raises:
        StoreError: if it is none.
    """
    return _formed(text, FILE, "name of a file", "a plain name with its ending")


def is_inside(name: str) -> bool:
    """Whether a relative path stays below the folder that it starts from."""
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


def _formed(text: object, form: re.Pattern[str], what: str, expected: str) -> str:
    if not isinstance(text, str) or not form.fullmatch(text):
        raise StoreError(f"{str(text)[:80]!r} is no {what}; expected {expected}")
    return text


def differences(names: Sequence[str]) -> list[str]:
    """Each name without the words that all of them have.

    Example:
        >>> differences(["lqr/known/mlp/seed=0", "lqr/none/mlp/seed=0"])
        ['known', 'none']
    """
    words = [name.split("/") for name in names]
    common = set.intersection(*map(set, words))
    return ["/".join(word for word in name if word not in common) or "/".join(name) for name in words]

"""Components of packages besides dadiff: found from the current folder too, and known by what their sources hold.

A result is that of the sources as they were when it was made. So their hash is part of what determines it, and sources
that were edited since they were loaded are loaded anew, in a notebook as on the command line.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from dadiff.errors import ConfigError
from dadiff.outside import digest_of

OURS = "dadiff"

_loaded: dict[str, str] = {}
"""Package -> the hash of the sources that were loaded."""


def is_own(target: str) -> bool:
    """Whether a dotted name lies outside dadiff."""
    return target.partition(".")[0] != OURS


def load(module: str) -> ModuleType:
    """A module of an own package, as its sources are now.

    Raises:
        ModuleNotFoundError: if there is none.
    """
    package = module.partition(".")[0]
    _look_here()
    if (now := _hash(package)) is not None:
        if _loaded.get(package, now) != now:
            for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
                del sys.modules[name]
        _loaded[package] = now
    with _without_bytecode():  # whose time stamps miss an edit within a second
        return importlib.import_module(module)


def sources_of(target: str) -> str:
    """A hash of all Python sources of the package that a dotted name lies in.

    Raises:
        ConfigError: if there are none, so that nobody could say what a result was made with.
    """
    found = state_of(target)
    if found is None:
        package = target.partition(".")[0]
        raise ConfigError(f"components: {package} has no source files; own components live in files of their own")
    return found


def state_of(target: str) -> str | None:
    """As `sources_of`; None for what has none, and for dadiff's own, which do not change while it runs."""
    if not is_own(target):
        return None
    _look_here()
    return _hash(target.partition(".")[0])


def _hash(package: str) -> str | None:
    importlib.invalidate_caches()
    try:
        spec = importlib.util.find_spec(package)
    except ValueError:  # made by hand, in memory
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations is None:
        return digest_of([Path(spec.origin)]) if spec.origin and Path(spec.origin).is_file() else None
    folders = sorted(map(Path, spec.submodule_search_locations))
    hashes = [digest_of(sorted(folder.rglob("*.py")), folder) for folder in folders]
    return hashes[0] if len(hashes) == 1 else "-".join(hashes)


def _look_here() -> None:
    """Let packages be found in the current folder, after all other places."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)


@contextmanager
def _without_bytecode() -> Iterator[None]:
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before

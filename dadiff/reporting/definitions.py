"""What a report holds, as data: `reports/<name>.yaml`.

title, about        words
sweeps              patterns of sweep names that this definition is for
claims              ids of the ledger; absent: all of them
figures             id, kind (a module of `dadiff.reporting.figures`, or the dotted name of an own class), title,
                    caption, options
tables              id, title, caption, options
"""

from __future__ import annotations

import fnmatch
import importlib
import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dadiff.errors import ConfigError
from dadiff.folders import shipped
from dadiff.outside import yaml_of
from dadiff.reporting import figures, tables

FOLDER = shipped("reports")
"""Holds the definitions, the ledger and the templates."""


@dataclass(frozen=True)
class Item:
    """One figure or table: `kind` is its module; tables have the one kind `table`."""

    id: str
    title: str
    kind: str = "table"
    caption: str = ""
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def collect(self) -> Callable[..., Any]:
        """The function that gathers its numbers.

        Raises:
            ConfigError: if the kind is unknown or its options do not fit.
        """
        collect = tables.collect if self.kind == "table" else _figure(self.kind, self.id)
        try:
            inspect.signature(collect).bind(None, **self.options)
        except TypeError as error:
            raise ConfigError(f"report item {self.id}: {error}; see the options of kind {self.kind!r}") from None
        return collect


def _figure(kind: str, item: str) -> Callable[..., Any]:
    if "." in kind:
        return _own_figure(kind, item)
    kinds = sorted(module.name for module in pkgutil.iter_modules(figures.__path__) if module.name != "style")
    if kind not in kinds:
        raise ConfigError(
            f"report item {item}: unknown kind {kind!r}; expected {', '.join(kinds)}, or the dotted name of a class"
        )
    module = importlib.import_module(f"{figures.__name__}.{kind}")
    return module.collect


def _own_figure(kind: str, item: str) -> Callable[..., Any]:
    """`collect` of a class that the user trusts: it makes the figure, which has `runs`, `notes` and `draw(columns)`."""
    from dadiff.config.own import load as load_module
    from dadiff.config.trust import VARIABLE, trusted

    module, _, name = kind.rpartition(".")
    package = module.partition(".")[0]
    if package not in trusted():
        raise ConfigError(
            f"report item {item}: kind {kind!r} is of a package that you did not name; trust it with "
            f"--components {package}, or by {VARIABLE}={package}"
        )
    try:
        found = getattr(load_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise ConfigError(f"report item {item}: kind {kind!r} cannot be found ({error}); write module.Class") from None
    if not all(callable(getattr(found, part, None)) for part in ("collect", "draw")):
        raise ConfigError(f"report item {item}: kind {kind!r} is no figure; a class with collect and draw is one")
    collect: Callable[..., Any] = found.collect
    return collect


@dataclass(frozen=True)
class Definition:
    """One report.

    Args:
        judged: selects the cells that claims are about; empty for all.
    """

    name: str
    title: str
    about: str = ""
    sweeps: list[str] = field(default_factory=list)
    claims: list[str] | None = None
    judged: dict[str, Any] = field(default_factory=dict)
    figures: list[Item] = field(default_factory=list)
    tables: list[Item] = field(default_factory=list)


def load(name: str) -> Definition:
    """The definition of a name, or of a yaml file that somebody wrote.

    Raises:
        ConfigError: if there is none, or it has unknown or missing keys.
    """
    own = name.endswith((".yaml", ".yml"))
    path = Path(name) if own else FOLDER / f"{name}.yaml"
    if own and not path.is_file():
        raise ConfigError(f"report definition {name}: there is no such file; give the path of a yaml, or a name")
    if not path.is_file():
        raise ConfigError(f"no report definition {name!r}; found {', '.join(names())} in {FOLDER}")
    try:
        content = yaml_of(path)
        parts = [[Item(**item) for item in content.pop(kind, [])] for kind in ("figures", "tables")]
        return Definition(name=path.stem, figures=parts[0], tables=parts[1], **content)
    except (TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: {error}; expected the keys of a report definition") from None


def names() -> list[str]:
    """All definitions."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem != "claims")


def for_sweep(sweep: str) -> Definition:
    """The definition of the sweep's name, else the first whose patterns fit, else `default`."""
    if sweep in names():
        return load(sweep)
    fitting = [d for d in map(load, names()) if any(fnmatch.fnmatchcase(sweep, pattern) for pattern in d.sweeps)]
    return fitting[0] if fitting else load("default")

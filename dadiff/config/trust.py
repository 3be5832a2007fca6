"""Whose code a configuration may name: dadiff's, and that of packages which the user trusts.

Trust is given on the command line (`components=[mylab]`) or in the environment (`DADIFF_COMPONENTS=mylab`), where jobs
inherit it. A file never gives it, be it a preset, a sweep or a stored configuration: who hands over a file could
otherwise make its reader run any installed code.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

from dadiff.errors import ConfigError

VARIABLE = "DADIFF_COMPONENTS"


def trusted() -> tuple[str, ...]:
    """The packages besides dadiff whose components may be built."""
    return tuple(dict.fromkeys(filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(",")))))


def trust(packages: Iterable[str]) -> None:
    """Trust packages from now on, in this process and those that it starts."""
    os.environ[VARIABLE] = ",".join(dict.fromkeys(filter(None, [*trusted(), *packages])))


def check_trusted(components: Sequence[str]) -> None:
    """Refuse a configuration that trusts what the user does not.

    Raises:
        ConfigError: naming the package.
    """
    for package in components:
        if package not in trusted():
            raise ConfigError(
                f"components: a file names {package!r}; packages are trusted on the command line only, with "
                f"components=[{package}], or by {VARIABLE}={package}"
            )

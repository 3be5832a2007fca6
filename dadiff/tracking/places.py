"""Places as MLflow reads them: it takes paths for addresses and writes them into SQL, where ?, %, # and quotes act."""

from __future__ import annotations

import atexit
import shlex
import shutil
import tempfile
from functools import cache
from pathlib import Path
from urllib.parse import quote, unquote

from dadiff.outside import without_passwords

SQLITE = "sqlite:///"
SPECIAL = frozenset("?%#'\"\\")


def address_of(uri: str) -> str:
    """The address of a store under which MLflow opens what lies at the path after sqlite:///."""
    if not uri.startswith(SQLITE):
        return uri
    path = Path(uri.removeprefix(SQLITE))
    return f"{SQLITE}{plain_folder(path.parent) / path.name}"


def artifacts_of(folder: Path | str) -> str:
    """A folder of artifacts as MLflow keeps it: its path, escaped where that is needed."""
    return f"file://{quote(str(folder))}" if SPECIAL & set(str(folder)) else str(folder)


def folder_of(artifacts: str) -> Path:
    """`artifacts_of` undone."""
    return Path(unquote(artifacts.removeprefix("file://")) if artifacts.startswith("file://") else artifacts)


def plain_folder(folder: Path) -> Path:
    """The folder, or where its name would be misread a link to it with a plain one, which goes with this process."""
    return _link_to(folder.absolute()) if SPECIAL & set(str(folder.absolute())) else folder


def interface_of(uri: str) -> str:
    """What a person types to see a store: from its folder, where the folder's name would be misread."""
    path = Path(uri.removeprefix(SQLITE))
    if not uri.startswith(SQLITE) or not SPECIAL & set(str(path)):
        return f"mlflow ui --backend-store-uri {without_passwords(uri)}"
    return f"cd {shlex.quote(str(path.parent))} && mlflow ui --backend-store-uri {SQLITE}{path.name}"


@cache
def _link_to(folder: Path) -> Path:
    place = Path(tempfile.mkdtemp(prefix="dadiff-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)  # of a link to a folder it removes the link
    link = place / "store"
    link.symlink_to(folder, target_is_directory=True)
    return link

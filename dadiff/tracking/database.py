"""The database of a store that is a file: there whole or not at all, and made again where it is damaged.

MLflow makes its tables in many steps, and a process that is killed between two of them, or a second one that comes
meanwhile, breaks the file for good. So it is made beside its place and renamed. As all that it holds is a mirror of
what lies in the output folder, a damaged one is set aside, and filled again, and nobody waits for the disk.
"""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Literal

from dadiff.errors import StoreError
from dadiff.store.files import make_folder, sync
from dadiff.tracking.places import SQLITE, address_of, artifacts_of, folder_of

HEADER = b"SQLite format 3\0"
COMPANIONS = ("", "-wal", "-shm", "-journal")

log = logging.getLogger(__name__)


def prepare_database(path: Path, experiment: str, artifacts: str | None) -> None:
    """Make sure that MLflow's database is there and whole. The caller holds its lock.

    Args:
        experiment: whose files must lie where `artifacts` says, if that is beside the database.
        artifacts: the folder for files; None for MLflow's own choice.

    Raises:
        StoreError: if the file is something else than a database of MLflow's, which is left alone.
    """
    make_folder(path.parent)
    if path.exists() and (damage := damage_of(path, experiment, artifacts)):
        aside = _set_aside(path)
        log.warning("%s %s: set aside as %s, and filled again from what lies on disk", path, damage, aside.name)
    if not path.exists():
        _create(path)
    _write_ahead(path)
    _unhurried(address_of(SQLITE + str(path)), "NORMAL")


def damage_of(path: Path, experiment: str, artifacts: str | None) -> str | None:
    """What keeps a database of MLflow's from being used."""
    if path.stat().st_size == 0:
        return "is empty"
    with path.open("rb") as stream:
        if stream.read(len(HEADER)) != HEADER:
            raise StoreError(f"tracking: {path} cannot be opened as a database; move it away, or mend tracking.uri")
    try:
        with closing(sqlite3.connect(path, timeout=60)) as connection:
            return _damage_inside(connection, path) or _moved(connection, path, experiment, artifacts)
    except sqlite3.DatabaseError as error:
        return f"is damaged ({error})"


def _damage_inside(connection: sqlite3.Connection, path: Path) -> str | None:
    (found,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if found != "ok":
        return f"is damaged ({found})"
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if tables and "experiments" not in tables:
        raise StoreError(f"tracking: {path} is a database, but not of MLflow's; mend tracking.uri")
    made = "alembic_version" in tables and connection.execute("SELECT * FROM alembic_version").fetchone()
    return None if made else "was not made whole"


def _moved(connection: sqlite3.Connection, path: Path, experiment: str, artifacts: str | None) -> str | None:
    """MLflow keeps the absolute place of an experiment's files."""
    question = "SELECT artifact_location FROM experiments WHERE name = ?"
    found = connection.execute(question, (experiment,)).fetchone()
    beside = artifacts is not None and Path(artifacts).is_relative_to(path.parent)
    if found is None or not beside or folder_of(found[0]).is_relative_to(path.parent):
        return None
    return f"names files at {found[0]}, where its folder lay before"


def _set_aside(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    for ending in COMPANIONS:
        if (part := path.with_name(path.name + ending)).exists():
            part.rename(aside.with_name(aside.name + ending))
    return aside


def _create(path: Path) -> None:
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    for left in path.parent.glob(f".{path.name}.making*"):
        left.unlink()
    making = path.with_name(f".{path.name}.making")
    address = address_of(SQLITE + str(making))
    _unhurried(address, "OFF")
    SqlAlchemyStore(address, artifacts_of(path.parent / "mlartifacts")).engine.dispose()
    sync(making)
    shared = path.parent.stat().st_mode & 0o060  # SQLite gives no rights to a group, whatever the umask
    making.chmod(making.stat().st_mode | shared)
    making.rename(path)
    here = address_of(SQLITE + str(path))
    SqlAlchemyStore._get_or_create_engine(here).dispose()  # connections of this process to what lay here


@cache
def _unhurried(address: str, level: Literal["OFF", "NORMAL"]) -> None:
    """How far MLflow's connections in this process wait for the disk: never, or when the write-ahead log is emptied."""
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore
    from sqlalchemy import event

    def set_up(connection: sqlite3.Connection, record: object) -> None:
        connection.execute(f"PRAGMA synchronous={level}")

    event.listen(SqlAlchemyStore._get_or_create_engine(address), "connect", set_up)


def _write_ahead(path: Path) -> None:
    """Switch the database to its write-ahead log, in which readers and writers do not block each other."""
    with closing(sqlite3.connect(path, timeout=60)) as connection:
        connection.execute("PRAGMA journal_mode=WAL")

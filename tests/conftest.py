"""Fixtures that every test module shares. What the law suites run on is in `laws.py`."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from laws import AFFINE, SYSTEMS

from dadiff.systems import AffineSystem, Linear
from dadiff.tracking import database

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what it starts in the background


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small products get slower with two threads on a busy machine."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def tables_made_once() -> Iterator[None]:
    """MLflow makes its tables in sixty steps, the same each time: after the first time in a process they are copied."""
    make, tables = database._create, sqlite3.connect(":memory:", check_same_thread=False)

    def create(path: Path) -> None:
        from mlflow.store.db import utils

        initialise = utils._initialize_tables

        def copied(engine) -> None:
            made = tables.execute("SELECT * FROM sqlite_master").fetchone()
            if not made:
                initialise(engine)
            with closing(engine.raw_connection()) as connection:
                there = connection.driver_connection
                tables.backup(there) if made else there.backup(tables)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(utils, "_initialize_tables", copied)
            make(path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "_create", create)
        yield


@pytest.fixture
def rng():
    """A generator of the test's own."""
    import numpy as np

    return np.random.default_rng(0)


@pytest.fixture(params=SYSTEMS.values(), ids=SYSTEMS.keys())
def system(request) -> Linear:
    """The paper's system and others of other sizes, so that nothing assumes n = 4 and m = 2."""
    return request.param


@pytest.fixture(params=AFFINE.values(), ids=AFFINE.keys())
def affine(request) -> AffineSystem:
    """The same, one with an offset, and one that varies over 12 steps."""
    return request.param

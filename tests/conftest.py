"""Fixtures that every test module shares. What the law suites run on is in `laws.py`."""

from __future__ import annotations

import os
import signal

import pytest
from laws import AFFINE, SYSTEMS

from dadiff.systems import AffineSystem, Linear

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what it starts in the background


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small products get slower with two threads on a busy machine."""
    import torch

    torch.set_num_threads(1)


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

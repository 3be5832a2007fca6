"""How threads wait and how many there are is settled once, before torch loads."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dadiff import threads
from dadiff.launching.work import environment

ROOT = Path(__file__).parent.parent


def test_only_one_place_says_how_threads_wait():
    rooms = ("dadiff", "tests", "bench", "tools")
    said = [file for room in rooms for file in (ROOT / room).rglob("*.py") if "SPINCOUNT" in file.read_text()]
    assert {str(file.relative_to(ROOT)) for file in said} <= {"dadiff/threads.py", "tests/test_threads.py"}
    assert "SPINCOUNT" not in (ROOT / "Makefile").read_text()


def test_the_command_line_settles_it_before_torch_loads():
    code = (
        "import os, sys; from dadiff import cli, threads; before = 'torch' in sys.modules; threads.settle();"
        "print(before, os.environ['GOMP_SPINCOUNT'])"
    )
    given = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=given, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", threads.SPINS]


def test_what_the_user_says_of_waiting_is_kept():
    with environment({"GOMP_SPINCOUNT": "7"}):
        threads.settle()
        assert os.environ["GOMP_SPINCOUNT"] == threads.limits(2)["GOMP_SPINCOUNT"] == "7"


def test_limits_hold_for_every_library():
    assert {threads.limits(3)[name] for name in threads.LIMITS} == {"3"}


@pytest.mark.parametrize(
    ("files", "share"),
    [
        ({}, math.inf),
        ({"cpu.max": "max 100000\n"}, math.inf),
        ({"cpu.max": "150000 100000\n"}, 1.5),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, math.inf),
        ({"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4.0),
    ],
)
def test_a_containers_share_limits_the_cores(tmp_path, monkeypatch, files, share):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(threads, "CONTROL_GROUP", tmp_path)
    assert threads.share(tmp_path) == share
    assert threads.cores() == min(threads.affine_cores(), math.ceil(share) if share < math.inf else 10_000)

"""Every command ends in one line and the exit code that says how, whoever runs it and wherever."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from test_cli import ROOT, TINY

from dadiff.commands import have_home, in_one_line, reported
from dadiff.errors import DataError
from dadiff.store import Results, is_read_only


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (DataError("a.npz: is\n damaged"), 1, "dadiff: error: a.npz: is damaged"),
        (
            OSError(errno.ENOSPC, "No space left on device", "/disk/x"),
            1,
            "dadiff: error: /disk/x: No space left on device; make room, and the same command goes on",
        ),
        (OSError(errno.EDQUOT, "Quota"), 1, "dadiff: error: Quota; make room, and the same command goes on"),
        (PermissionError(errno.EACCES, "Permission denied", "x"), 1, "dadiff: error: x: Permission denied"),
        (MemoryError(), 1, "dadiff: error: out of memory"),
        (KeyboardInterrupt(), 130, "dadiff: interrupted; the same command goes on from what is stored"),
        (
            KeyboardInterrupt("step 7"),
            130,
            "dadiff: interrupted (step 7); the same command goes on from what is stored",
        ),
    ],
)
def test_an_end_that_a_person_can_mend_is_one_line(error, code, told, capsys, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda number, handler: None)
    assert reported("dadiff", raising(error)) == code
    assert capsys.readouterr().err == f"{told}\n"


def test_what_is_no_such_end_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        reported("dadiff", raising(ZeroDivisionError()))
    assert in_one_line(ValueError("a\nb")) == "a b"


def test_a_reader_that_has_heard_enough_is_no_error():
    code = "from dadiff.commands import reported; raise SystemExit(reported('x', lambda: print('y' * 10**6)))"
    command = f'{sys.executable} -c "{code}" | head -c 1'
    done = subprocess.run(["sh", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("y", "")


def test_a_process_without_a_home_gets_one(monkeypatch, tmp_path):
    monkeypatch.setattr(Path, "home", raising(RuntimeError("Could not determine home directory.")))
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.delenv("HOME", raising=False)
    have_home()
    assert os.environ["HOME"] == str(tmp_path / f"dadiff-{os.getuid()}")
    monkeypatch.setattr(os, "getuid", lambda: 12345)  # somebody else's folder of that name is not trusted
    (tmp_path / "dadiff-12345").mkdir()
    have_home()
    assert os.environ["HOME"] != str(tmp_path / "dadiff-12345")


ANYBODY = ["setpriv", "--reuid=12345", "--regid=12345", "--clear-groups"]
READING = ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]


@pytest.mark.slow
@pytest.mark.skipif(os.getuid() != 0, reason="changing the user takes root")
def test_a_user_without_an_entry_and_a_folder_that_is_done_and_read_only(tmp_path):
    place = Path(tempfile.mkdtemp())
    os.chown(place, 12345, 12345)
    bare = {name: value for name, value in os.environ.items() if name not in ("HOME", "USER", "LOGNAME")}

    def dadiff(*overrides: str) -> subprocess.CompletedProcess[str]:
        command = [*ANYBODY, *READING, sys.executable, "-m", "dadiff.cli", *overrides, *TINY]
        environment = {**bare, "PYTHONPATH": str(ROOT)}
        return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=False)

    assert dadiff("projector=none").returncode == 0
    assert dadiff("-m", "projector=none,rollout", "hydra.launcher.sweep=two").returncode == 0
    subprocess.run(["chown", "-R", "root:root", place], check=True)
    done = dadiff("projector=none")
    assert (done.returncode, "nothing was run" in done.stdout) == (0, True), done.stderr
    assert dadiff("-m", "projector=none,rollout", "hydra.launcher.sweep=two").returncode == 0
    refused = dadiff("projector=known")
    assert refused.returncode == 1
    assert "cannot be written to; choose another output_dir" in refused.stderr.splitlines()[-1]


def test_a_folder_that_is_not_there_is_not_read_only(tmp_path):
    assert not is_read_only(tmp_path / "none")
    assert not is_read_only(tmp_path)
    assert list(Results(tmp_path)) == []

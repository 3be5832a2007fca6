"""Files of others and declared sizes are judged first: nothing is waited for, allocated or shown that should not be."""

from __future__ import annotations

import csv
import io
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from laws import composed

from dadiff import memory
from dadiff.datasets import NpzRecordings, NpzTrajectories
from dadiff.datasets.environments import load_environments
from dadiff.denoisers import RecordingMLP
from dadiff.errors import CheckpointError, ConfigError, DadiffError, DataError, StoreError
from dadiff.outside import digest_of, json_of, npz, spreadsheet_safe, text_of, without_passwords, yaml_of
from dadiff.running.parts import Parts
from dadiff.store import Record, Results, Sweep, Sweeps
from dadiff.store.planners import read_file
from dadiff.systems import double_integrator
from dadiff.tasks import LQR
from dadiff.tasks.obstacles import Obstacles

SYSTEM = double_integrator()


def read_npz(path: Path) -> None:
    with npz(path) as arrays:
        _ = {name: arrays[name] for name in arrays.files}


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "text": ("a.json", text_of),
    "yaml": ("a.yaml", yaml_of),
    "npz": ("a.npz", read_npz),
    "digest": ("a.npz", lambda path: digest_of([path])),
    "recording": ("a.npz", lambda path: NpzRecordings(str(path.parent)).record(SYSTEM)),
    "fingerprint": ("a.npz", lambda path: NpzRecordings(str(path.parent)).fingerprint()),
    "demonstrations": ("train/a.npz", lambda path: NpzTrajectories(str(path.parents[1])).train(LQR(), SYSTEM)),
    "environments in yaml": ("a.yaml", lambda path: load_environments(path, Obstacles())),
    "environments in npz": ("a.npz", lambda path: load_environments(path, Obstacles())),
}


def made_up_header(path: Path) -> None:
    """An array that claims 8 TB and holds 8 bytes."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("states.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8))


def bomb(path: Path) -> None:
    """A few aliases of aliases, or a few bytes that unpack to many."""
    names = [f"a{k}: &a{k} [" + ", ".join([f"*a{k - 1}"] * 10 if k else ["x"] * 10) + "]" for k in range(10)]
    path.write_text("\n".join(names) + "\n")


HARMS: dict[str, Callable[[Path], object]] = {
    "fifo": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": lambda path: path.mkdir(),
    "missing": lambda path: path.unlink(missing_ok=True),
    "made-up header": made_up_header,
    "alias bomb": bomb,
    "no text": lambda path: path.write_bytes(b"\xff\xfe\x00"),
    "truncated": lambda path: path.write_bytes(b"PK\x03\x04" + bytes(20)),
    "pickle": lambda path: np.savez(path, states=np.array([{}], dtype=object)),
}


@pytest.mark.timeout(10)
@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("reader", READERS)
def test_files_of_others_are_judged_before_they_are_read(tmp_path, reader, harm):
    name, read = READERS[reader]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    HARMS[harm](path)
    if reader in ("text", "digest", "fingerprint") and harm not in ("fifo", "device", "folder", "missing"):
        return  # they ask for no form
    if reader == "text" and harm == "alias bomb":
        return
    with pytest.raises(DadiffError) as caught:
        read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.timeout(10)
def test_a_preset_of_aliases_is_refused(tmp_path):
    (tmp_path / "projector").mkdir()
    bomb(tmp_path / "projector" / "bomb.yaml")
    with pytest.raises(DataError, match="once its aliases are written out"):
        composed("projector=bomb", f"hydra.searchpath=[file://{tmp_path}]")


def test_a_zip_that_unpacks_to_more_than_there_is(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", states=np.zeros(100_000))
    monkeypatch.setattr("dadiff.outside.available", lambda: 1e5)
    with pytest.raises(DataError, match=r"holds 800\.1 kB when unpacked, 100\.0 kB of memory are there"):
        read_npz(tmp_path / "a.npz")


def test_a_table_that_unpacks_to_more_than_there_is(tmp_path, monkeypatch):
    run = Results(tmp_path).write(Record("0" * 16, "x", "finished"), tables={"chain": pd.DataFrame({"a": range(1000)})})
    monkeypatch.setattr("dadiff.outside.available", lambda: 1e3)
    with pytest.raises(StoreError, match=r"holds 8\.0 kB when unpacked"):
        run.table("chain")


DECLARED = (
    "schedule.num_steps",
    "evaluation.samples",
    "dataset.train_size",
    "dataset.test_size",
    "task.horizon",
    "recording.length",
    "recording.count",
    "denoiser.width",
    "denoiser.blocks",
    "training.steps",
    "training.batch_size",
    "system.axes",
)


def test_a_network_that_reads_recordings_is_held_against_memory(monkeypatch):
    monkeypatch.setattr("dadiff.memory.available", lambda: 1e8)
    with pytest.raises(ConfigError, match="width=10000"):
        RecordingMLP(width=10_000)


@pytest.mark.timeout(10)
@pytest.mark.parametrize("size", [10**12, 10**30])
@pytest.mark.parametrize("name", DECLARED)
def test_declared_sizes_are_held_against_memory_and_nothing_is_made(name, size):
    group, parameter = name.split(".")
    config = composed()
    config[group] = config[group] | {parameter: size}
    with pytest.raises(ConfigError, match=rf"{parameter}.*: needs at least .* of memory, .* are there$"):
        Parts.of(config)


def test_what_memory_there_is_follows_the_control_group_and_the_machine(tmp_path):
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("900000\n")
    (tmp_path / "memory.stat").write_text("anon 1\nfile 400000\n")
    assert memory._of_group(tmp_path) == 500_000
    (tmp_path / "meminfo").write_text("MemTotal:  10 kB\nMemAvailable:  7 kB\n")
    assert memory._of_machine(tmp_path / "meminfo") == 7 * 1024
    assert memory._of_group(tmp_path / "none") == float("inf")
    assert 0 < memory.available() < 1e15
    assert [memory.in_words(s) for s in (0, 999, 1.4e6, 10**40)] == ["0 B", "999 B", "1.4 MB", "more than 1,000,000 TB"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql://me:secret@host/db", "postgresql://me@host/db"),
        (
            "dadiff -m 'tracking.uri=https://u:p%40w@h:5000/x' seed=1",
            "dadiff -m 'tracking.uri=https://u@h:5000/x' seed=1",
        ),
        ("mysql+pymysql://:pw@h", "mysql+pymysql://@h"),
        ("sqlite:////a/b.db", "sqlite:////a/b.db"),
        ("http://host:5000/a@b", "http://host:5000/a@b"),
    ],
)
def test_passwords_are_not_shown(text, shown):
    assert without_passwords(text) == shown


def test_passwords_are_not_stored(tmp_path):
    uri = "postgresql://me:secret@host/db"
    config = {"tracking": {"uri": uri}, "many": [uri]}
    Results(tmp_path).write(Record("0" * 16, "x", "finished", config=config))
    Sweeps(tmp_path).write(Sweep("quick", f"dadiff -m tracking.uri={uri}", {"tracking.uri": uri}, []))
    for path in tmp_path.rglob("*.*"):
        assert path.is_dir() or "secret" not in path.read_text()
    assert Sweeps(tmp_path).read("quick").command == "dadiff -m tracking.uri=postgresql://me@host/db"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-x", "@a", "\tx", "\rx"])
def test_a_cell_that_a_spreadsheet_would_take_for_a_formula_is_marked_as_text(text):
    assert spreadsheet_safe(text) == f"'{text}"
    assert [spreadsheet_safe(value) for value in (-1.5, "lqr/a=1", "", None)] == [-1.5, "lqr/a=1", "", None]
    row = next(csv.reader(io.StringIO(f'"{spreadsheet_safe(text)}"\n', newline="")))
    assert row == [f"'{text}"]


@pytest.mark.parametrize("harm", ["encrypted", "odd method"])
def test_a_planner_that_zipfile_cannot_unpack_is_told_in_a_line(tmp_path, harm):
    path = tmp_path / "robot.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("planner.json", "{}")
        file.writestr("arrays.safetensors", b"")
    content, at = bytearray(path.read_bytes()), {"encrypted": (6, 8, 1), "odd method": (8, 10, 97)}[harm]
    for mark, offset in ((b"PK\x03\x04", at[0]), (b"PK\x01\x02", at[1])):
        place = content.find(mark)
        while place >= 0:
            content[place + offset] |= at[2]
            place = content.find(mark, place + 4)
    path.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match=r"robot\.zip: is (no planner of dadiff, or damaged|compressed)"):
        read_file(path)


@pytest.mark.parametrize(("text", "told"), [("{", "not readable as json"), ("[" * 100_000, "not readable as json")])
def test_json_that_is_none_is_told_in_a_line(tmp_path, text, told):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=rf"a\.json: {told}"):
        json_of(tmp_path / "a.json")

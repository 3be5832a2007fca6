"""A store that somebody else has had his hands on: each file of ours, harmed in each way, costs a line and no more."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dadiff.errors import DadiffError, DataError, StoreError
from dadiff.store import Cache, Record, Results, Sweep, Sweeps, SweptRun
from dadiff.store.cli import main as dadiff_cache
from dadiff.store.names import file_name, key_of, kind_of, sweep_name

KEYS = ("0123456789abcdef", "fedcba9876543210")


@pytest.fixture
def store(tmp_path) -> Path:
    """Two runs, a sweep of both, and an entry of the cache that each uses."""
    results, cache = Results(tmp_path), Cache(tmp_path)
    for key in KEYS:
        cache.get_or_build("denoiser", key, {}, lambda folder: np.save(folder / "x.npy", np.arange(5)))
        table = pd.DataFrame({"t": range(100), "gap": np.linspace(0, 1, 100)})
        results.write(
            Record(key, f"run {key}", "finished", links={"denoiser": key}),
            tables={"per_step": table},
            arrays={"states": np.ones(3)},
        )
    Sweeps(tmp_path).write(Sweep("quick", "dadiff -m", {}, [SweptRun(key, f"run {key}") for key in KEYS]))
    with Sweeps(tmp_path).running("quick"):
        pass
    return tmp_path


FILES = (
    f"runs/{KEYS[0]}/run.json",
    f"cache/denoiser/{KEYS[0]}/manifest.json",
    "sweeps/quick/sweep.json",
    "sweeps/quick/launcher.json",
    "store.json",
)


def without(field: str) -> Callable[[Path], None]:
    def harm(path: Path) -> None:
        content = json.loads(path.read_text())
        path.write_text(json.dumps({name: value for name, value in content.items() if name != field}))

    return harm


def every_field(value: object) -> Callable[[Path], None]:
    def harm(path: Path) -> None:
        content = json.loads(path.read_text())
        path.write_text(json.dumps({name: value if name != "format" else content[name] for name in content}))

    return harm


def replaced(text: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(text)  # type: ignore[return-value]


def newer(path: Path) -> None:
    path.write_text(path.read_text().replace('"format": 1', '"format": 99'))


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


HARMS: dict[str, Callable[[Path], None]] = {
    "empty": replaced(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[:-20]),  # type: ignore[dict-item,return-value]
    "number": replaced(b"7"),
    "list": replaced(b"[]"),
    "null": replaced(b"null"),
    "no field": replaced(b'{"format": 1}'),
    "no format": without("format"),
    "nulls": every_field(None),
    "texts": every_field("x"),
    "numbers": every_field(3),
    "lists": every_field([1, {}]),
    "deep": replaced(b'{"format": 1, "key": ' + b"[" * 100_000),
    "no text": replaced(b"\xff\xfe\x00"),
    "newer": newer,
    "fifo": fifo,
    "device": device,
    "folder": folder,
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("name", FILES)
def test_a_harmed_file_is_told_in_a_line_and_the_rest_goes_on(store, name, harm, capsys, caplog):
    HARMS[harm](store / name)
    results, sweeps = Results(store), Sweeps(store)
    readers = [
        lambda: results.status(KEYS[0]),
        lambda: results.read(KEYS[0]).table("per_step"),
        lambda: sweeps.read("quick"),
        lambda: sweeps.is_running("quick"),
        lambda: Cache(store).contains("denoiser", KEYS[0]),
        lambda: list(results.damaged()),
    ]
    for read in readers:
        with suppress(DadiffError):
            read()
    assert {run.key for run in results} >= {KEYS[1]}
    assert len(results.read(KEYS[1]).table("per_step")) == 100
    for action in ("list", "verify", "prune"):
        assert dadiff_cache([action, "--output-dir", str(store)]) in (0, 1)
    told = capsys.readouterr()
    assert "Traceback" not in told.err + caplog.text
    assert Cache(store).contains("denoiser", KEYS[1])


@pytest.mark.parametrize("name", ["per_step.parquet", "examples.npz"])
@pytest.mark.parametrize("harm", ["flip", "truncate"])
def test_a_bit_that_flips_in_a_run_is_found(store, name, harm):
    path = store / "runs" / KEYS[0] / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content if harm == "flip" else content[:-7])
    run = Results(store).read(KEYS[0])
    with pytest.raises(StoreError, match=r"differs from its checksum; run it again with force=true"):
        run.table("per_step") if name.endswith("parquet") else run.arrays()
    assert dict(Results(store).damaged()) == {KEYS[0]: [f"{name} differs from its checksum"]}
    assert dadiff_cache(["verify", "--output-dir", str(store)]) == 1


def test_swapped_runs_are_found(store):
    one, other = (store / "runs" / key for key in KEYS)
    swap(one, other)
    assert list(Results(store)) == []
    assert Results(store).status(KEYS[0]) is None
    with pytest.raises(DataError, match=f"is the record of run {KEYS[1]}; was its folder renamed"):
        Results(store).read(KEYS[0])


def test_swapped_entries_are_found_and_built_again(store):
    swap(*(store / "cache" / "denoiser" / key for key in KEYS))
    assert not Cache(store).contains("denoiser", KEYS[0])
    built = Cache(store).get_or_build("denoiser", KEYS[0], {}, lambda folder: np.save(folder / "y.npy", np.ones(2)))
    assert [path.name for path in built.glob("*.npy")] == ["y.npy"]


def test_an_entry_of_another_kind_is_found(store):
    (store / "cache" / "cases").mkdir()
    (store / "cache" / "denoiser" / KEYS[0]).rename(store / "cache" / "cases" / KEYS[0])
    assert not Cache(store).contains("cases", KEYS[0])


def test_a_renamed_sweep_is_found(store):
    (store / "sweeps" / "quick").rename(store / "sweeps" / "slow")
    with pytest.raises(DataError, match="is the record of sweep 'quick'"):
        Sweeps(store).read("slow")


def swap(one: Path, other: Path) -> None:
    aside = one.with_name("aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)


OUTSIDE = ("../../x", "/etc/passwd", "..", ".", "", "a/b", "a\0b", "\n", "x" * 300, None, 7)


@pytest.mark.parametrize("text", OUTSIDE)
@pytest.mark.parametrize("form", [key_of, kind_of, sweep_name, file_name])
def test_what_is_no_name_becomes_no_path(form, text):
    with pytest.raises(StoreError, match=r" is no (key|kind|name)"):
        form(text)


@pytest.mark.parametrize("text", OUTSIDE)
def test_no_part_of_the_store_takes_a_path_for_a_name(tmp_path, text):
    for use in (
        Results(tmp_path).folder,
        Sweeps(tmp_path).folder,
        lambda name: Cache(tmp_path).folder("denoiser", name),
        lambda name: Cache(tmp_path).folder(name, KEYS[0]),
    ):
        with pytest.raises(StoreError):
            use(text)
    assert list(tmp_path.iterdir()) == []


def test_a_record_whose_key_is_a_path_is_not_written(tmp_path):
    with pytest.raises(StoreError, match="is no key"):
        Results(tmp_path / "out").write(Record("../../elsewhere", "x", "finished"))
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", ["../../victim", "/etc/hostname"])
def test_a_manifest_reads_no_file_elsewhere(store, name):
    path = store / "cache" / "denoiser" / KEYS[0] / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"files": {name: {"sha256": "0", "bytes": 1}}}))
    assert dadiff_cache(["verify", "--output-dir", str(store)]) == 1


def test_pruning_touches_only_what_carries_our_manifest_in_a_store_of_ours(store, tmp_path_factory, capsys):
    victim = tmp_path_factory.mktemp("victim")
    (victim / "cache" / "denoiser" / KEYS[0]).mkdir(parents=True)
    (victim / "cache" / "denoiser" / KEYS[0] / "thesis.tex").write_text("years")
    assert dadiff_cache(["prune", "--output-dir", str(victim)]) == 1
    assert "is no output folder of dadiff" in capsys.readouterr().err
    foreign = store / "cache" / "denoiser" / ("1" * 16)
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("years")
    (store / "cache" / "letters").mkdir()
    (store / "cache" / "letters" / "mine").mkdir()
    (store / "cache" / "denoiser" / ("2" * 16)).symlink_to(victim / "cache" / "denoiser" / KEYS[0])
    (store / "cache" / "linked").symlink_to(victim / "cache" / "denoiser")
    assert dadiff_cache(["prune", "--output-dir", str(store)]) == 0
    assert "left alone denoiser" in capsys.readouterr().out
    assert (foreign / "thesis.tex").exists()
    assert (store / "cache" / "letters" / "mine").exists()
    assert (victim / "cache" / "denoiser" / KEYS[0] / "thesis.tex").exists()


def build(folder: Path) -> None:
    (folder / "payload").write_text("x")


@pytest.mark.parametrize(
    "place", [f"cache/denoiser/{'3' * 16}.partial", f"runs/.writing-{'3' * 16}", f"runs/{'3' * 16}"]
)
def test_nothing_is_written_where_a_link_leads(store, tmp_path_factory, place):
    victim = tmp_path_factory.mktemp("victim")
    (store / place).symlink_to(victim)
    if place.startswith("cache"):
        Cache(store).get_or_build("denoiser", "3" * 16, {}, build, resumable=True)
    else:
        Results(store).write(Record("3" * 16, "x", "finished"))
    assert list(victim.iterdir()) == []

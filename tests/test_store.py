"""Laws of the store: built once, whole or absent, damage is named and mended, failures give way to results."""

from __future__ import annotations

import json
import logging
import math
import multiprocessing
import os
import platform
import re
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dadiff.errors import DadiffError, DataError, LockedError, StoreError
from dadiff.store import Cache, Provenance, Record, Results, Status, Sweep, Sweeps, SweptRun, store_id
from dadiff.store.cli import main as dadiff_cache

KEY = "0123456789abcdef"


def build_slowly(log: Path, folder: Path) -> None:
    with log.open("a") as stream:
        stream.write(f"{os.getpid()}\n")
    time.sleep(0.2)
    np.save(folder / "x.npy", np.arange(5))


def get(root: Path, log: Path) -> None:
    Cache(root).get_or_build("dataset", KEY, {"seed": 1}, partial(build_slowly, log))


def build_until_killed(folder: Path) -> None:
    (folder / "checkpoint").write_text("step 7")
    (folder / "junk").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)


def get_and_die(root: Path) -> None:
    Cache(root).get_or_build("denoiser", KEY, {}, build_until_killed)


def run_process(target, *arguments) -> int | None:
    process = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    process.start()
    process.join()
    return process.exitcode


def record(status: Status = "finished", key: str = KEY, **more: Any) -> Record:
    return Record(key, "lqr/known", status, **{"axes": {"seed": 1}, "metrics": {"gap": 1.5}, **more})


def test_a_failure_is_not_written_over_work_in_progress(tmp_path):
    with Results(tmp_path).working(KEY):
        run_process(write_a_failure, tmp_path)
        assert Results(tmp_path).status(KEY) is None
    run_process(write_a_failure, tmp_path)
    assert Results(tmp_path).status(KEY) == "killed"


def write_a_failure(root: Path) -> None:
    Results(root).write_failure(record("killed", reason="SIGKILL"))


def test_eight_processes_on_a_cold_cache_build_once(tmp_path):
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=get, args=(tmp_path, tmp_path / "log")) for _ in range(8)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * 8
    assert len((tmp_path / "log").read_text().split()) == 1


@pytest.mark.parametrize("resumable", [True, False])
def test_a_killed_build_leaves_no_entry_and_can_go_on(tmp_path, resumable):
    assert run_process(get_and_die, tmp_path) == -signal.SIGKILL
    cache, seen = Cache(tmp_path), []

    def build(folder: Path) -> None:
        seen.extend(sorted(path.name for path in folder.iterdir() if path.name != "manifest.json"))
        for path in folder.iterdir():
            path.unlink()
        (folder / "weights").write_text("w")

    assert not cache.contains("denoiser", KEY)
    assert [entry.state for entry in cache.entries()] == ["partial"]
    folder = cache.get_or_build("denoiser", KEY, {}, build, resumable=resumable)
    assert seen == (["checkpoint", "junk"] if resumable else [])
    assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "weights"]


@pytest.mark.parametrize("harm", ["change", "truncate", "remove", "manifest"])
def test_damage_is_named_set_aside_and_rebuilt(tmp_path, caplog, harm):
    get(tmp_path, tmp_path / "log")
    folder = Cache(tmp_path).folder("dataset", KEY)
    payload = folder / "x.npy"
    if harm == "change":
        payload.write_bytes(payload.read_bytes()[:-1] + b"!")
    elif harm == "truncate":
        payload.write_bytes(payload.read_bytes()[:-1])
    else:
        (payload if harm == "remove" else folder / "manifest.json").unlink()
    with caplog.at_level(logging.WARNING):
        get(tmp_path, tmp_path / "log")
    assert ("manifest.json" if harm == "manifest" else "x.npy") in caplog.text
    assert f"{KEY}.damaged-1" in caplog.text
    assert sorted(path.name for path in folder.parent.iterdir()) == [KEY, f"{KEY}.damaged-1"]
    np.testing.assert_array_equal(np.load(payload), np.arange(5))


def test_a_builder_that_raises_leaves_no_entry(tmp_path):
    def build(folder: Path) -> None:
        raise DataError("no")

    with pytest.raises(DataError):
        Cache(tmp_path).get_or_build("dataset", KEY, {}, build)
    with pytest.raises(StoreError, match="wrote no file"):
        Cache(tmp_path).get_or_build("dataset", KEY, {}, lambda folder: None)


def test_a_run_comes_back_as_it_was_stored(tmp_path):
    table = pd.DataFrame({"t": [0, 1], "gap": [1e-300, np.nan]})
    results = Results(tmp_path)
    results.write(
        record(metrics={"gap": np.float64(math.nan), "rank": np.int64(64)}),
        files={"config.yaml": b"a: 1\n"},
        tables={"per_step": table},
        arrays={"states": np.ones((2, 3))},
    )
    (run,) = results
    assert math.isnan(run.metrics["gap"])
    assert run.metrics["rank"] == 64
    pd.testing.assert_frame_equal(run.table("per_step"), table)
    assert run.arrays()["states"].shape == (2, 3)
    assert json.loads((run.folder / "run.json").read_text())["metrics"]["gap"] is None
    with pytest.raises(StoreError, match="no such table"):
        run.table("chain")


def test_failures_give_way_to_results_and_not_the_other_way(tmp_path):
    results = Results(tmp_path)
    results.write_failure(record("killed", reason="SIGKILL"))
    assert results.status(KEY) == "killed"
    assert not results.is_done(KEY)
    results.write(record())
    assert results.is_done(KEY)
    results.write_failure(record("failed", reason="later"))
    assert results.read(KEY).status == "finished"
    assert [path.name for path in results.root.glob("[!.]*")] == [KEY]


def test_a_newer_format_is_refused(tmp_path):
    run = Results(tmp_path).write(record())
    path = run.folder / "run.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(StoreError, match=r"format 2.*update dadiff"):
        Results(tmp_path).read(KEY)
    path.write_text("{")
    with pytest.raises(DataError, match="damaged"):
        Results(tmp_path).read(KEY)


def test_a_record_comes_back_typed_whatever_it_holds(tmp_path):
    made = Provenance("host", "2024-01-01T00:00:00+00:00", 2.0, "cpu", None, {"dadiff": "0"})
    whole = record(
        config={"task": {"cost": [1.0, None]}}, notes={"schedule": {"C1": True}}, counts={"cases": 2},
        links={"cases": KEY}, provenance=made, diverged_step=3, reason="why",
    )  # fmt: skip
    assert Results(tmp_path).write(whole).record == whole


@pytest.mark.parametrize(
    ("harm", "where"),
    [
        ({"status": "done"}, "status"),
        ({"key": None}, "key"),
        ({"axes": []}, "axes"),
        ({"links": {"cases": 1}}, "links"),
    ],
)
def test_a_record_with_a_wrong_field_is_one_line_that_names_it(tmp_path, harm, where):
    path = Results(tmp_path).write(record()).folder / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **harm}))
    with pytest.raises(DataError, match=rf"^[^\n]*run.json: {where}[^\n]*$"):
        Results(tmp_path).read(KEY)


def test_fields_that_a_newer_version_adds_are_left_aside(tmp_path):
    path = Results(tmp_path).write(record()).folder / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "later": 1}))
    assert Results(tmp_path).read(KEY).record == record()


def test_claims_end_with_their_process(tmp_path):
    results = Results(tmp_path)
    assert KEY not in results.working_keys()
    with results.working(KEY):
        assert run_process(exit_with, tmp_path) == 1
    assert run_process(exit_with, tmp_path) == 0
    run_process(claim_and_die, tmp_path)
    assert KEY not in results.working_keys()


def exit_with(root: Path) -> None:
    raise SystemExit(int(KEY in Results(root).working_keys()))


def claim_and_die(root: Path) -> None:
    with Results(root).working(KEY):
        os.kill(os.getpid(), signal.SIGKILL)


def test_sweeps_come_back(tmp_path):
    sweep = Sweep("quick", "dadiff -m", {"seed": "1,2"}, [SweptRun(KEY, "lqr/known", {"seed": 1}, "failed", "why")])
    Sweeps(tmp_path).write(sweep)
    assert Sweeps(tmp_path).read("quick") == sweep
    assert Sweeps(tmp_path).names() == ["quick"]
    with pytest.raises(DadiffError, match="cannot be read"):
        Sweeps(tmp_path).read("other")


def test_one_process_at_a_time_runs_a_sweep(tmp_path):
    sweeps = Sweeps(tmp_path)
    assert not sweeps.is_running("quick")
    with sweeps.running("quick") as lease:
        assert sweeps.is_running("quick")
        assert lease.is_held()
        assert run_process(exit_with_the_refusal, tmp_path) == 1
        assert "cells" not in Sweeps(tmp_path).names()
    assert not lease.is_held()
    assert run_process(exit_with_the_refusal, tmp_path) == 0
    with sweeps.running("quick") as next_lease:
        assert next_lease.is_held()
        assert not lease.is_held()  # another launcher has taken over


def exit_with_the_refusal(root: Path) -> None:
    try:
        with Sweeps(root).running("quick"):
            raise SystemExit(0)
    except LockedError as error:
        named = f"process {os.getppid()} on {platform.node()}" in str(error) and "hydra.launcher.sweep" in str(error)
        raise SystemExit(1 if named else 2) from error


def test_a_sweep_is_free_again_when_its_launcher_is_killed(tmp_path):
    assert run_process(run_sweep_and_die, tmp_path) == -signal.SIGKILL
    assert not Sweeps(tmp_path).is_running("quick")


def run_sweep_and_die(root: Path) -> None:
    with Sweeps(root).running("quick"):
        os.kill(os.getpid(), signal.SIGKILL)


def test_the_id_of_an_output_folder_goes_with_it(tmp_path):
    name = store_id(tmp_path / "outputs")
    assert store_id(tmp_path / "others") != name
    (tmp_path / "outputs").rename(tmp_path / "moved")
    assert store_id(tmp_path / "moved") == name


def test_an_unwritable_folder_is_one_clear_line(tmp_path):
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(StoreError, match="choose another output_dir"):
        get(tmp_path, tmp_path / "log")


def test_the_cache_tool_lists_verifies_and_prunes(tmp_path, capsys):
    get(tmp_path, tmp_path / "log")
    Cache(tmp_path).get_or_build("denoiser", "f" * 16, {}, partial(build_slowly, tmp_path / "log"))
    Results(tmp_path).write(record(links={"dataset": KEY}))
    arguments = ["--output-dir", str(tmp_path)]
    assert dadiff_cache(["list", *arguments]) == 0
    listed = capsys.readouterr().out
    assert KEY in listed
    assert re.search(rf"^dataset +{KEY} +[\d.]+ k?B +whole +1$", listed, re.MULTILINE)
    assert dadiff_cache(["prune", *arguments, "--dry-run"]) == 0
    assert "would remove denoiser" in capsys.readouterr().out
    assert dadiff_cache(["prune", *arguments]) == 0
    assert [entry.kind for entry in Cache(tmp_path).entries()] == ["dataset"]
    assert dadiff_cache(["verify", *arguments]) == 0
    (Cache(tmp_path).folder("dataset", KEY) / "x.npy").write_bytes(b"")
    assert dadiff_cache(["verify", *arguments]) == 1
    assert "x.npy differs from its checksum" in capsys.readouterr().out
    with Results(tmp_path).working(KEY):
        assert dadiff_cache(["prune", *arguments]) == 1
    Sweeps(tmp_path).write(Sweep("quick", "dadiff -m", {}, []))
    with Sweeps(tmp_path).running("quick"):
        assert dadiff_cache(["prune", *arguments]) == 1
    assert "sweep quick is being run" in capsys.readouterr().err

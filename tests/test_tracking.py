"""Laws of tracking: MLflow mirrors what is on disk, once, and nothing stays RUNNING without its process."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dadiff.errors import ConfigError, StoreError
from dadiff.store import Cache, Cell, Provenance, Record, Results, Sweep, Sweeps
from dadiff.tracking import Tracking, is_tracked
from dadiff.tracking.client import open_client

KEY = "0123456789abcdef"


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    return f"sqlite:///{tmp_path_factory.mktemp('store')}/mlflow.db"


@pytest.fixture
def tracking(uri, tmp_path, request):
    return Tracking(uri, experiment=request.node.name, artifacts=str(tmp_path / "mlartifacts"))


def store(root: Path, key: str = KEY):
    table = pd.DataFrame({"case": [0, 0, 1, 1], "sample": 0, "t": [0, 1, 0, 1], "gap": [0.0, 2.0, 0.0, 4.0]})
    table["planned_input_error"] = [1.0, np.nan, 3.0, np.nan]
    record = Record(
        key,
        "lqr/known/seed=1",
        "finished",
        axes={"projector": "known", "seed": 1},
        metrics={"gap": 1.5, "cost_ratio": float("nan")},
        counts={"cases": 2, "samples": 1},
        links={"dataset": KEY},
        provenance=Provenance(started="2024-01-01T00:00:00+00:00", seconds=2.0, versions={"dadiff": "0"}),
    )
    return Results(root).write(record, files={"config.yaml": b"seed: 1\n"}, tables={"per_step": table})


def runs(tracking, condition=""):
    return open_client(tracking.uri).search_runs([tracking._experiment_id], condition)


def start_and_die(tracking, root):
    tracking.start(KEY, "dead", root)
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_run_is_mirrored_with_curves_scalars_and_tables(tracking, tmp_path):
    run = store(tmp_path)
    tracking.log_run(run, tracking.start(run.key, run.name, tmp_path))
    (mirror,) = runs(tracking)
    client = open_client(tracking.uri)
    curve = client.get_metric_history(mirror.info.run_id, "t/gap")
    assert [(point.step, point.value) for point in curve] == [(0, 0.0), (1, 3.0)]
    assert [p.step for p in client.get_metric_history(mirror.info.run_id, "t/planned_input_error")] == [0]
    assert mirror.data.metrics["gap"] == 1.5
    assert "cost_ratio" not in mirror.data.metrics
    assert mirror.data.params == {"projector": "known", "seed": "1"}
    assert mirror.info.run_name == run.name
    assert mirror.info.status == "FINISHED"
    assert {"key", "host", "pid", "link.dataset", "version.dadiff"} <= mirror.data.tags.keys()
    assert "2 cases" in mirror.data.tags["mlflow.note.content"]
    files = {artifact.path for artifact in client.list_artifacts(mirror.info.run_id)}
    assert files == {"run.json", "config.yaml", "per_step.parquet"}


def test_nothing_is_logged_twice(tracking, tmp_path):
    run = store(tmp_path)
    for _ in range(3):
        tracking.log_run(run)
    (mirror,) = runs(tracking)
    assert len(open_client(tracking.uri).get_metric_history(mirror.info.run_id, "t/gap")) == 2


def test_logging_that_was_cut_short_goes_on_in_the_same_run(tracking, tmp_path, monkeypatch, caplog):
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    def away(*_, **__):
        raise MlflowException("away")

    run = store(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "set_terminated", away)
        tracking.log_run(run)
    assert "dadiff-sync or the same command uploads it" in caplog.text
    assert not is_tracked(run.folder, tracking.uri)
    tracking.log_run(run)
    (mirror,) = runs(tracking)
    assert mirror.info.status == "FINISHED"
    assert is_tracked(run.folder, tracking.uri)
    assert len(open_client(tracking.uri).get_metric_history(mirror.info.run_id, "t/gap")) == 2


def test_a_result_done_again_replaces_its_mirror(tracking, tmp_path):
    tracking.log_run(store(tmp_path))
    tracking.log_run(store(tmp_path))
    assert len(runs(tracking)) == 1


def test_runs_of_dead_processes_are_closed_and_living_ones_are_not(tracking, tmp_path):
    tracking.prepare()
    process = multiprocessing.get_context("spawn").Process(target=start_and_die, args=(tracking, tmp_path))
    process.start()
    living = tracking.start("f" * 16, "living", tmp_path)
    elsewhere = tracking.start("e" * 16, "elsewhere", tmp_path / "other")
    process.join()
    assert len(runs(tracking, "attributes.status = 'RUNNING'")) == 3
    assert tracking.close_dead(tmp_path) == 1
    assert {run.info.run_id for run in runs(tracking, "attributes.status = 'RUNNING'")} == {living, elsewhere}
    (dead,) = runs(tracking, "attributes.status = 'KILLED'")
    assert "its process is gone" in dead.data.tags["mlflow.note.content"]


def test_runs_of_other_hosts_are_dead_when_nobody_holds_the_lock_of_their_work(tracking, tmp_path, monkeypatch):
    tracking.prepare()
    other = "f" * 16
    with monkeypatch.context() as there:
        there.setattr("platform.node", lambda: "elsewhere")
        living, _dead = tracking.start(KEY, "living", tmp_path), tracking.start(other, "dead", tmp_path)
        tracking.start(other, "training/dead", tmp_path, "training")
        sweep = tracking.start("quick", "quick", tmp_path, "sweep")
    with Results(tmp_path).working(KEY), Sweeps(tmp_path).running("quick"):
        assert tracking.close_dead(tmp_path) == 2
    assert {run.info.run_id for run in runs(tracking, "attributes.status = 'RUNNING'")} == {living, sweep}
    assert tracking.close_dead(tmp_path) == 2
    assert len(runs(tracking, "attributes.status = 'KILLED'")) == 4


def test_a_sweep_is_one_parent_however_often_it_is_run(tracking, tmp_path):
    run = store(tmp_path)
    cells = [Cell(run.key, run.name, run.axes, "finished"), Cell("f" * 16, "other", {}, "failed", "why")]
    sweep = Sweep("quick", "dadiff +sweeps=quick", {"projector": "known,none"}, cells)
    Sweeps(tmp_path).write(sweep)
    parents = []
    for _ in range(2):
        parents.append(tracking.open_sweep(sweep, tmp_path))
        child = Tracking(tracking.uri, tracking.experiment, tracking.artifacts, parent=parents[-1])
        child.log_run(run)
        tracking.close_sweep(parents[-1], sweep, tmp_path, "failed")
    assert parents[0] == parents[1]
    assert len(runs(tracking)) == 2
    (parent,) = runs(tracking, "tags.kind = 'sweep'")
    assert parent.info.status == "FAILED"
    assert "other: failed, why" in parent.data.tags["mlflow.note.content"]
    assert parent.data.tags["cells"] == "1 failed, 1 finished"
    (mirror,) = runs(tracking, f"tags.`mlflow.parentRunId` = '{parents[0]}'")
    assert mirror.info.run_name == run.name
    table = pd.read_csv(Sweeps(tmp_path).folder("quick") / "results.csv")
    assert list(table["gap"][:1]) == [1.5]
    assert list(table["status"]) == ["finished", "failed"]


def test_a_sweep_that_was_extended_shows_what_it_is_now(tracking, tmp_path):
    """MLflow refuses to change a parameter, and keeps the larger of two metrics of one step."""
    first = [Cell("a" * 16, "a", {"seed": 0}, "failed", "why")]
    both = [Cell("a" * 16, "a", {"seed": 0}, "finished"), Cell("b" * 16, "b", {"seed": 1}, "finished")]
    for cells, seeds in ((first, "0"), (both, "0,1")):
        sweep = Sweep("quick", "dadiff +sweeps=quick", {"seed": seeds}, cells)
        Sweeps(tmp_path).write(sweep)
        tracking.close_sweep(tracking.open_sweep(sweep, tmp_path), sweep, tmp_path, "finished")
    (parent,) = runs(tracking, "tags.kind = 'sweep'")
    assert json.loads(parent.data.tags["definition"]) == {"seed": "0,1"}
    assert parent.data.tags["cells"] == "2 finished"
    assert "| seed | 0,1 |" in parent.data.tags["mlflow.note.content"]
    assert parent.info.status == "FINISHED"
    assert is_tracked(Sweeps(tmp_path).folder("quick"), tracking.uri)


def test_a_training_is_a_run_of_its_own(tracking, tmp_path):
    def build(folder: Path) -> None:
        pd.DataFrame({"step": [1, 100], "loss": [1.0, 0.1]}).to_csv(folder / "training.csv", index=False)

    folder = Cache(tmp_path).get_or_build("denoiser", KEY, {"training": {"steps": 100}}, build)
    for _ in range(2):
        tracking.log_training(folder)
    (mirror,) = runs(tracking)
    assert mirror.data.params == {"training.steps": "100"}
    assert mirror.data.metrics == {"loss": 0.1}
    assert Cache(tmp_path).get_or_build("denoiser", KEY, {}, build) == folder


def test_a_server_that_is_away_is_an_error_at_the_start_and_a_warning_later(tmp_path, caplog):
    tracking = Tracking("http://127.0.0.1:9", experiment="x")
    start = time.monotonic()
    with pytest.raises(StoreError, match=r"127.0.0.1:9 does not answer .*tracking=sqlite"):
        tracking.prepare()
    assert time.monotonic() - start < 10
    with caplog.at_level(logging.WARNING):
        tracking.log_run(store(tmp_path))
    assert "dadiff-sync or the same command uploads it" in caplog.text


def test_the_store_is_absolute_and_writes_ahead(tracking, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Tracking("sqlite:///a/mlflow.db", artifacts="b").uri == f"sqlite:///{tmp_path}/a/mlflow.db"
    tracking.prepare()
    with sqlite3.connect(tracking.uri.removeprefix("sqlite:///")) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_damaged_database_is_one_clear_line(tmp_path):
    (tmp_path / "mlflow.db").write_text("this is not a database, though it is long enough to look like one" * 20)
    with pytest.raises(StoreError, match="cannot be opened as a database"):
        Tracking(f"sqlite:///{tmp_path}/mlflow.db").prepare()


def test_tracking_can_be_off_and_refuses_unknown_stores(tmp_path):
    off = Tracking("sqlite:///x.db", enabled=False)
    off.prepare()
    assert off.start(KEY, "x", tmp_path) is None
    assert off.close_dead(tmp_path) == 0
    off.log_run(store(tmp_path))
    assert not Path("x.db").exists()
    with pytest.raises(ConfigError, match="uri is 'file:"):
        Tracking("file:///tmp/mlruns")


def test_mlflow_is_imported_late():
    code = "import sys, dadiff.tracking, dadiff.store; sys.exit('mlflow' in sys.modules or 'pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

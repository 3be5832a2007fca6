"""Laws of tracking: MLflow mirrors what is on disk, once, and is made again from it whatever became of it."""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dadiff.errors import ConfigError, StoreError
from dadiff.store import Cache, Provenance, Record, Results, Sweep, Sweeps, SweptRun, store_id
from dadiff.sync import main as dadiff_sync
from dadiff.sync import sync
from dadiff.tracking import Tracking, client
from dadiff.tracking.client import open_client

KEY = "0123456789abcdef"


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    return f"sqlite:///{tmp_path_factory.mktemp('store')}/mlflow.db"


@pytest.fixture
def tracking(uri, tmp_path, request):
    return Tracking(uri, experiment=request.node.name, artifacts=str(tmp_path / "mlartifacts"))


def store(root: Path, key: str = KEY, name: str = "lqr/known/seed=1"):
    table = pd.DataFrame({"case": [0, 0, 1, 1], "sample": 0, "t": [0, 1, 0, 1], "gap": [0.0, 2.0, 0.0, 4.0]})
    table["planned_input_error"] = [1.0, np.nan, 3.0, np.nan]
    record = Record(
        key,
        name,
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


def test_a_run_is_mirrored_with_curves_scalars_and_tables(tracking, tmp_path):
    run = store(tmp_path)
    tracking.log_run(run)
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
    assert (mirror.info.end_time - mirror.info.start_time) == 2000
    assert {"key", "host", "link.dataset", "version.dadiff"} <= mirror.data.tags.keys()
    assert "2 cases" in mirror.data.tags["mlflow.note.content"]
    files = {artifact.path for artifact in client.list_artifacts(mirror.info.run_id)}
    assert files == {"run.json", "config.yaml", "per_step.parquet"}


def drip(connection) -> None:
    for byte in b"HTTP/1.1 200 OK\r\nContent-Length: 100000\r\n\r\n" + b"x" * 1000:
        connection.sendall(bytes([byte]))
        time.sleep(0.1)


SERVERS = {
    "drips": drip,
    "is silent": lambda connection: time.sleep(30),
    "speaks something else": lambda connection: connection.sendall(b"SSH-2.0-OpenSSH\r\n"),
    "hangs up": lambda connection: None,
}


@pytest.mark.parametrize("kind", SERVERS)
def test_a_server_that_keeps_one_waiting_is_told_in_a_line_in_time(kind, monkeypatch):
    monkeypatch.setattr(client, "PROBE_SECONDS", 0.5)
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with suppress(OSError):
            while True:
                connection, _ = listening.accept()
                with connection, suppress(OSError):
                    connection.recv(4096)
                    SERVERS[kind](connection)

    threading.Thread(target=serve, daemon=True).start()
    start = time.monotonic()
    with pytest.raises(StoreError, match=r"the MLflow server http://127\.0\.0\.1:\d+ does not answer") as told:
        client.prepare_store(f"http://127.0.0.1:{listening.getsockname()[1]}", "x", None)
    assert "\n" not in str(told.value)
    assert time.monotonic() - start < 5
    listening.close()


@pytest.mark.parametrize("name", ["a%20b", "50 % off?#1", "q'uote\"d"])
def test_a_folder_of_any_name_is_tracked_and_nothing_is_written_beside_it(name, tmp_path):
    home = tmp_path / "stores"
    for place in (home / name, home / f"moved {name}"):
        if place.name.startswith("moved"):
            (home / name).rename(place)
        else:
            store(place)
        assert sync(place) == 1
        tracking = Tracking.of({}, place)
        (mirror,) = runs(tracking)
        client = open_client(tracking.uri)
        assert "run.json" in {artifact.path for artifact in client.list_artifacts(mirror.info.run_id)}
        assert (place / "mlartifacts" / mirror.info.run_id / "artifacts" / "run.json").is_file()
        assert [path.name for path in home.iterdir()] == [place.name]
        assert str(place) in tracking.how_to_look("x") or "cd " in tracking.how_to_look("x")


def test_nothing_is_logged_twice(tracking, tmp_path):
    run = store(tmp_path)
    for _ in range(3):
        tracking.log_run(run)
    (mirror,) = runs(tracking)
    assert len(open_client(tracking.uri).get_metric_history(mirror.info.run_id, "t/gap")) == 2


def test_what_a_database_holds_is_seen_without_mlflow(tracking, tmp_path):
    run, cell = store(tmp_path), SweptRun(KEY, "lqr/known/seed=1", status="finished")
    Sweeps(tmp_path).write(Sweep("one", "dadiff", {}, [cell]))
    assert not tracking.mirrors(tmp_path, [run])
    tracking.log_run(run)
    assert tracking.mirrors(tmp_path, [run])
    assert not tracking.mirrors(tmp_path, [run], "one")  # its sweep is not mirrored
    parent = tracking.log_sweep(tmp_path, "one")
    assert not tracking.mirrors(tmp_path, [run], "one")  # nor is it nested under that
    tracking.log_run(run, parent)
    assert tracking.mirrors(tmp_path, [run], "one")
    again = store(tmp_path, name="another")
    assert not tracking.mirrors(tmp_path, [again], "one")  # what lies on disk has changed
    tracking.log_run(again, parent)
    assert tracking.mirrors(tmp_path, [again], "one")
    open_client(tracking.uri).delete_run(parent)
    assert not tracking.mirrors(tmp_path, [again], "one")


def test_a_failed_run_is_mirrored_as_such_until_it_is_done(tracking, tmp_path):
    Results(tmp_path).write_failure(Record(KEY, "x", "killed", "SIGKILL"))
    tracking.log_run(Results(tmp_path).read(KEY))
    (failed,) = runs(tracking)
    assert (failed.info.status, failed.data.tags["status"]) == ("KILLED", "killed")
    assert "SIGKILL" in failed.data.tags["mlflow.note.content"]
    tracking.log_run(store(tmp_path))
    (mirror,) = runs(tracking)
    assert mirror.info.status == "FINISHED"


@pytest.mark.parametrize("place", ["create_run", "log_batch", "log_artifact", "set_terminated", "set_tag"])
def test_logging_that_was_cut_short_is_done_again(tracking, tmp_path, monkeypatch, caplog, place):
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException

    def away(*_, **__):
        raise MlflowException("away")

    run = store(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, place, away)
        tracking.log_run(run)
    assert "dadiff-sync or the same command uploads it" in caplog.text
    tracking.log_run(run)
    (mirror,) = runs(tracking)
    assert mirror.info.status == "FINISHED"
    assert len(open_client(tracking.uri).get_metric_history(mirror.info.run_id, "t/gap")) == 2


def test_a_result_done_again_replaces_its_mirror(tracking, tmp_path):
    tracking.log_run(store(tmp_path))
    tracking.log_run(store(tmp_path, name="again"))
    (mirror,) = runs(tracking)
    assert mirror.info.run_name == "again"


def test_output_folders_that_share_a_store_do_not_touch_each_other(tracking, tmp_path):
    for folder in ("one", "two"):
        tracking.log_run(store(tmp_path / folder))
    tracking.catch_up(tmp_path / "one", [])
    assert len(runs(tracking)) == 2


def test_what_a_killed_process_left_running_goes_with_the_next_catching_up(tracking, tmp_path):
    left = {"kind": "run", "key": "f" * 16, "store": store_id(tmp_path)}
    open_client(tracking.uri).create_run(tracking._experiment_id, tags=left)
    tracking.catch_up(tmp_path, [store(tmp_path)])
    assert [mirror.info.status for mirror in runs(tracking)] == ["FINISHED"]


def test_a_run_shows_its_plans_and_the_data_that_it_was_made_with(tracking, tmp_path):
    record = Record(KEY, "lqr/known/seed=1", "finished", links={"demonstrations": "d" * 16, "cases": "c" * 16})
    states = np.random.default_rng(0).standard_normal((2, 3, 11, 4))
    tracking.log_run(Results(tmp_path).write(record, arrays={"states": states, "reference_states": states[:, 0]}))
    (mirror,) = runs(tracking)
    images = open_client(tracking.uri).list_artifacts(mirror.info.run_id, "images")
    assert {Path(image.path).suffix for image in images} == {".png", ".webp"}
    assert all(Path(image.path).name.startswith("plans") for image in images)
    used = {data.dataset.name: data.tags[0].value for data in mirror.inputs.dataset_inputs}
    assert used == {"demonstrations/dddddddd": "training", "cases/cccccccc": "testing"}


def test_a_training_is_a_model_with_a_planner_that_loads(tracking, tmp_path, monkeypatch):
    import dadiff

    monkeypatch.chdir(tmp_path)
    small = ["dataset.train_size=20", "dataset.test_size=2", "training.steps=2", "training.warmup=0"]
    run = dadiff.run([*small, "projector=known_fixed", "tracking.enabled=false", "progress=false"])
    for _ in range(2):
        tracking.catch_up(tmp_path / "outputs", [run])
    client = open_client(tracking.uri)
    (model,) = client.search_logged_models([tracking._experiment_id])
    assert model.tags["denoiser"] == run.record.links["denoiser"]
    assert model.source_run_id == runs(tracking, "tags.kind = 'run'")[0].info.run_id
    (file,) = Path(model.artifact_location.removeprefix("file://")).glob("planner.zip")
    before, after = dadiff.Planner.load(run.folder), dadiff.Planner.load(file)
    given = {"x_init": [0, 0, 0, 0], "target": [1, 2, 0, 0], "seed": 0}
    np.testing.assert_array_equal(before.plan(**given).states, after.plan(**given).states)


def sweep_of(*cells: SweptRun, seeds: str = "1") -> Sweep:
    return Sweep("quick", "dadiff +sweeps=quick", {"seed": seeds}, list(cells))


def test_a_sweep_is_one_parent_however_often_it_is_run(tracking, tmp_path):
    run, parents = store(tmp_path), []
    cells = SweptRun(run.key, run.name, run.axes, "finished"), SweptRun("f" * 16, "other", {}, "failed", "why")
    for status in ("waiting", "finished"):
        Sweeps(tmp_path).write(sweep_of(SweptRun(run.key, run.name, run.axes, status), cells[1]))
        parents.append(tracking.log_sweep(tmp_path, "quick"))
        tracking.log_run(run, parents[-1])
    assert parents[0] == parents[1]
    assert len(runs(tracking)) == 2
    (parent,) = runs(tracking, "tags.kind = 'sweep'")
    assert parent.info.status == "FAILED"
    assert "other: failed, why" in parent.data.tags["mlflow.note.content"]
    assert parent.data.tags["cells"] == "1 failed, 1 finished"
    (mirror,) = runs(tracking, f"tags.`mlflow.parentRunId` = '{parents[0]}'")
    assert mirror.info.run_name == run.name


def test_a_sweep_opens_as_a_table_with_what_varies_in_front_and_charts_on_log_axes(tracking, tmp_path):
    axes = {"projector": "known", "seed": 1}
    names = {KEY: "lqr/known/mlp/seed=1", "f" * 16: "lqr/none/mlp/seed=1"}
    cells = [SweptRun(key, name, axes | {"projector": name.split("/")[1]}) for key, name in names.items()]
    Sweeps(tmp_path).write(sweep_of(*cells))
    tracking.catch_up(tmp_path, [store(tmp_path)], ["quick"])
    (mirror,) = runs(tracking, "tags.kind = 'run'")
    assert mirror.info.run_name == "known · lqr/mlp/seed=1"
    client = open_client(tracking.uri)
    state = json.loads(client.get_experiment(tracking._experiment_id).tags["mlflow.sharedViewState.quick"])
    assert state["selectedColumns"][-1] == "params.`projector`"
    assert state["orderByKey"] == state["selectedColumns"][0] == min(state["selectedColumns"])
    assert [chart["scaleType"] for chart in state["compareRunCharts"] if chart["type"] == "LINE"] == ["log"] * 3
    assert "workflowType=machine_learning&viewStateShareKey=quick" in tracking.how_to_look("quick")


def test_the_note_of_a_sweep_says_what_its_report_found(tracking, tmp_path):
    Sweeps(tmp_path).write(sweep_of(SweptRun(KEY, "a")))
    (tmp_path / "reports" / "quick").mkdir(parents=True)
    (tmp_path / "reports" / "quick" / "report.json").write_text('{"format": 2, "sentences": ["Helps: it does."]}')
    tracking.log_sweep(tmp_path, "quick")
    (mirror,) = runs(tracking, "tags.kind = 'sweep'")
    assert mirror.data.tags["mlflow.note.content"].startswith("- Helps: it does.")


def test_a_sweep_that_was_extended_shows_what_it_is_now(tracking, tmp_path):
    """MLflow refuses to change a parameter, and keeps the larger of two metrics of one step."""
    first, second = SweptRun("a" * 16, "a", {"seed": 0}, "finished"), SweptRun("b" * 16, "b", {"seed": 1}, "finished")
    for cells, seeds in (([first], "0"), ([first, second], "0,1")):
        Sweeps(tmp_path).write(sweep_of(*cells, seeds=seeds))
        tracking.log_sweep(tmp_path, "quick")
    (parent,) = runs(tracking, "tags.kind = 'sweep'")
    assert json.loads(parent.data.tags["definition"]) == {"seed": "0,1"}
    assert parent.data.tags["cells"] == "2 finished"
    assert "| seed | 0,1 |" in parent.data.tags["mlflow.note.content"]
    assert parent.info.status == "FINISHED"


def test_a_training_is_a_run_of_its_own(tracking, tmp_path):
    def build(folder: Path) -> None:
        pd.DataFrame({"step": [1, 100], "loss": [1.0, 0.1]}).to_csv(folder / "training.csv", index=False)

    Cache(tmp_path).get_or_build("denoiser", KEY, {"training": {"steps": 100}}, build)
    for _ in range(2):
        tracking.log_training(tmp_path, KEY)
    (mirror,) = runs(tracking)
    assert mirror.data.params == {"training.steps": "100"}
    assert mirror.data.metrics == {"loss": 0.1}
    tracking.log_training(tmp_path, "f" * 16)  # there is none
    assert len(runs(tracking)) == 1


# --- the mirror is made again from disk


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An output folder with a sweep of two runs, one of them failed, a report of it, and its mirror."""
    root = tmp_path_factory.mktemp("made") / "outputs"
    run = store(root)
    Results(root).write_failure(Record("f" * 16, "other", "failed", "why"))
    cells = SweptRun(run.key, run.name, {}, "finished"), SweptRun("f" * 16, "other", {}, "failed", "why")
    Sweeps(root).write(sweep_of(*cells))
    (root / "reports" / "quick").mkdir(parents=True)
    (root / "reports" / "quick" / "index.html").write_text("<p>report</p>")
    assert sync(root) == 3
    return root


@pytest.fixture
def outputs(made, tmp_path):
    """A copy in another place, so that its database names files where the original lies."""
    return Path(shutil.copytree(made, tmp_path / "outputs"))


def shown(root: Path) -> dict[str, tuple[str, str, int]]:
    """What MLflow says: name -> status, parent's name, number of files."""
    tracking = Tracking.of({}, root)
    client, found = open_client(tracking.uri), runs(tracking)
    names = {run.info.run_id: run.info.run_name for run in found}
    return {
        run.info.run_name: (
            run.info.status,
            names.get(run.data.tags.get("mlflow.parentRunId"), ""),
            len(client.list_artifacts(run.info.run_id)),
        )
        for run in found
    }


WHOLE = {
    "quick": ("FAILED", "", 1),
    "other": ("FAILED", "quick", 1),
    "lqr/known/seed=1": ("FINISHED", "quick", 3),
}


def delete(database: Path) -> None:
    for part in database.parent.glob("mlflow.db*"):
        part.unlink()


def empty(database: Path) -> None:
    database.write_bytes(b"")


def truncate(database: Path) -> None:
    os.truncate(database, database.stat().st_size // 2)


def cut_in_creation(database: Path) -> None:
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE alembic_version")


def delete_in_the_pages(database: Path) -> None:
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE runs SET lifecycle_stage = 'deleted'")


def delete_the_experiment(database: Path) -> None:
    client = open_client(f"sqlite:///{database}")
    client.delete_experiment(client.get_experiment_by_name("dadiff").experiment_id)


def forget(database: Path) -> None:
    with sqlite3.connect(database) as connection:
        for table in ("tags", "metrics", "latest_metrics", "params", "runs"):
            connection.execute(f"DELETE FROM {table}")


@pytest.mark.parametrize(
    ("harm", "missing"),
    [
        (delete, 3),
        (empty, 3),
        (truncate, 3),
        (cut_in_creation, 3),
        (delete_in_the_pages, 3),
        (forget, 3),
        (delete_the_experiment, 0),  # which MLflow restores with its runs
    ],
)
def test_a_mirror_is_made_again_from_disk_whatever_became_of_it(outputs, harm, missing, capsys):
    sync(outputs)
    harm(outputs / "mlflow.db")
    assert dadiff_sync(["--output-dir", str(outputs)]) == 0
    assert capsys.readouterr().out == f"{missing} were missing in MLflow and are there now\n"
    assert shown(outputs) == WHOLE
    assert sync(outputs) == 0


def test_a_mirror_in_a_folder_that_was_moved_is_made_again_there(outputs):
    assert (sync(outputs), sync(outputs)) == (3, 0)
    assert shown(outputs) == WHOLE
    tracking = Tracking.of({}, outputs)
    (sweep,) = runs(tracking, "tags.kind = 'sweep'")
    assert Path(sweep.info.artifact_uri).is_relative_to(outputs)
    files = open_client(tracking.uri).list_artifacts(sweep.info.run_id, "report")
    assert [file.path for file in files] == ["report/index.html"]


def test_syncing_to_another_store_leaves_the_first(outputs, tmp_path):
    uri = f"sqlite:///{tmp_path}/other/mlflow.db"
    sync(outputs)
    assert (sync(outputs, uri), sync(outputs, uri), sync(outputs)) == (3, 0, 0)


def test_a_stored_configuration_finds_its_store_where_the_folder_was_moved():
    config = {
        "output_dir": "/old/outputs",
        "tracking": {
            "_target_": "dadiff.tracking.Tracking", "uri": "sqlite:////old/outputs/mlflow.db",
            "artifacts": "/old/outputs/mlartifacts", "experiment": "mine", "parent": "of an older version",
        },
    }  # fmt: skip
    expected = Tracking("sqlite:////new/place/mlflow.db", "mine", "/new/place/mlartifacts")
    assert Tracking.of(config, "/new/place") == expected


def test_a_server_that_is_away_is_an_error_at_the_start_and_a_warning_later(tmp_path, caplog):
    tracking = Tracking("http://me:secret@127.0.0.1:9", experiment="x")
    start = time.monotonic()
    with pytest.raises(StoreError, match=r"http://me@127.0.0.1:9 does not answer .*tracking=sqlite"):
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


def test_what_is_no_database_of_ours_is_left_alone(tmp_path):
    path = tmp_path / "mlflow.db"
    path.write_text("this is not a database, though it is long enough to look like one" * 20)
    with pytest.raises(StoreError, match="cannot be opened as a database"):
        Tracking(f"sqlite:///{path}").prepare()
    path.unlink()
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE mine (x)")
    with pytest.raises(StoreError, match="not of MLflow's"):
        Tracking(f"sqlite:///{path}").prepare()


def test_a_database_is_made_aside_and_put_in_its_place(tmp_path, monkeypatch):
    path, killed = tmp_path / "mlflow.db", KeyboardInterrupt
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(killed))
        with pytest.raises(killed):
            Tracking(f"sqlite:///{path}").prepare()
    assert not path.exists()
    Tracking(f"sqlite:///{path}").prepare()
    assert {part.name for part in tmp_path.iterdir()} <= {f"mlflow.db{end}" for end in ("", ".lock", "-wal", "-shm")}


def test_tracking_can_be_off_and_refuses_unknown_stores(tmp_path):
    off = Tracking("sqlite:///x.db", enabled=False)
    off.prepare()
    off.log_run(store(tmp_path))
    assert off.catch_up(tmp_path, [store(tmp_path)]) == 0
    assert not Path("x.db").exists()
    with pytest.raises(ConfigError, match="uri is 'file:"):
        Tracking("file:///tmp/mlruns")


def test_mlflow_is_imported_late():
    code = "import sys, dadiff.tracking, dadiff.store; sys.exit('mlflow' in sys.modules or 'pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

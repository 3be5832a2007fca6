"""Slow: sweeps and stores under attack. `python -m tests.faults.kills` prints the same trials as a table."""

from __future__ import annotations

import importlib.util
import multiprocessing
import threading
import time
from pathlib import Path

import pytest

from dadiff.store import Cache, Record, Results
from dadiff.sync import sync
from dadiff.tracking import Tracking
from dadiff.tracking.client import open_client
from tests.faults.kills import PLACES, launch, reference, struck_at_random, trial
from tests.faults.stores import Server, postgresql, postgresql_binaries

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return reference(tmp_path_factory.mktemp("reference") / "outputs")


@pytest.mark.parametrize("place", PLACES)
def test_a_sweep_survives_a_kill(place, undisturbed, tmp_path):
    assert trial(tmp_path / "outputs", PLACES[place], undisturbed).problems == []


def test_first_starts_that_are_killed_at_random_moments_recover(tmp_path):
    assert [done.problems for done in struck_at_random(tmp_path, 6, seed=1)] == [[]] * 6


def open_at_once(root: Path, number: int, ready) -> None:
    tracking = Tracking(f"sqlite:///{root}/mlflow.db", artifacts=str(root / "artifacts"))
    ready.wait()
    tracking.prepare()
    tracking.log_run(Results(root).write(Record(f"{number:016x}", f"run {number}", "refused", "on purpose")))


@pytest.mark.parametrize("attempt", range(20))
def test_eight_processes_may_open_a_store_that_does_not_exist(attempt, tmp_path):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["mlflow.store.tracking.sqlalchemy_store", "mlflow.tracking.client"])
    ready = context.Barrier(8)
    workers = [context.Process(target=open_at_once, args=(tmp_path, n, ready)) for n in range(8)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0] * 8
    client = open_client(f"sqlite:///{tmp_path}/mlflow.db")
    (experiment,) = (e for e in client.search_experiments() if e.name == "dadiff")
    assert len(client.search_runs([experiment.experiment_id])) == 8


def held(client) -> None:
    (experiment,) = (e for e in client.search_experiments() if e.name == "dadiff")
    runs = client.search_runs([experiment.experiment_id])
    finished = sorted(run.data.tags["kind"] for run in runs if run.info.status == "FINISHED")
    assert finished == ["run"] * 4 + ["sweep", "training"]
    assert {run.info.status for run in runs} <= {"FINISHED", "KILLED"}


def test_a_server_that_stops_and_comes_back_costs_nothing(undisturbed, tmp_path):
    server = Server(tmp_path, f"sqlite:///{tmp_path}/server.db")
    root = tmp_path / "outputs"
    here = ["tracking=server", f"tracking.uri={server.uri}"]
    start = time.monotonic()
    away = launch(root, arguments=here)
    assert away.returncode == 1
    assert "does not answer" in away.stderr
    assert not list(Results(root))
    assert time.monotonic() - start < 60
    server.start()
    try:
        stopper = threading.Thread(target=stop_when_training_is_done, args=(server, root))
        stopper.start()
        disturbed = launch(root, arguments=here)
        stopper.join()
        assert disturbed.returncode == 0, disturbed.stderr
        assert {run.key for run in Results(root)} < undisturbed.keys()
        server.start()
        assert sync(root) > 0
        assert sync(root) == 0
        assert launch(root, arguments=here).returncode == 0
        held(open_client(server.uri))
    finally:
        server.stop()


def stop_when_training_is_done(server: Server, root: Path) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not trained(root):
        time.sleep(0.1)
    server.stop()


def trained(root: Path) -> bool:
    return any(entry.kind == "denoiser" and entry.state == "whole" for entry in Cache(root).entries())


@pytest.mark.skipif(postgresql_binaries() is None, reason="PostgreSQL is not installed (Debian: postgresql)")
@pytest.mark.skipif(importlib.util.find_spec("psycopg2") is None, reason="psycopg2 is not installed")
def test_a_server_over_postgresql_works_the_same(undisturbed, tmp_path):
    with postgresql() as backend:
        server = Server(tmp_path, backend)
        server.start()
        try:
            root = tmp_path / "outputs"
            ended = launch(root, arguments=["tracking=server", f"tracking.uri={server.uri}"])
            assert ended.returncode == 0, ended.stderr
            held(open_client(server.uri))
        finally:
            server.stop()

"""Laws of the launchers for clusters: what `processes` promises holds there too. Tried on this machine alone."""

from __future__ import annotations

import importlib.util
import math
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from dadiff.errors import ConfigError, MissingExtraError
from dadiff.launching.pool import Pool
from dadiff.launching.ray import RayPool
from dadiff.launching.slurm import SlurmPool
from dadiff.launching.work import Work
from dadiff.store import Cache
from dadiff.tracking.client import open_client

ROOT = Path(__file__).parent.parent
SWEEP = [
    "-m", "projector=known", "projector.initial_state=fixed", "enforcement=normalised,convex,literal",
    "denoiser=gaussian", "sampler=ddim", "sampler.num_steps=4", "schedule.num_steps=30", "dataset.train_size=60",
    "dataset.test_size=2", "evaluation.samples=1", "progress=false",
]  # fmt: skip


def needs(package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed")


LAUNCHERS = {
    "slurm": ["hydra/launcher=slurm", "hydra.launcher.cluster=local", "hydra.launcher.workers=2"],
    "ray": ["hydra/launcher=ray", "hydra.launcher.workers=2"],
}
EACH = [pytest.param("slurm", marks=needs("submitit")), pytest.param("ray", marks=needs("ray"))]


def make_pool(launcher: str, root: Path, time_limit: float = 60.0) -> Pool:
    if launcher == "slurm":
        return SlurmPool(root / "submitit", "local", 2, 1, time_limit, {})
    return RayPool(None, 2, 1, time_limit)


def work(root: Path, key: str, function, *arguments, needs=()) -> Work:
    return Work(key, key, function, arguments, root / "logs" / f"{key}.log", frozenset(needs))


class Silent:
    def __init__(self) -> None:
        self.most = 0

    def ended(self, work, outcome) -> None:
        pass

    def tick(self, running) -> None:
        self.most = max(self.most, len(running))


class Impatient(Silent):
    def __init__(self, patience: Path) -> None:
        self.patience = patience

    def tick(self, running) -> None:
        if self.patience.exists() and self.patience.read_text():
            raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def _jobs_find_dadiff(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.mark.parametrize(("package", "launcher"), [("submitit", "slurm"), ("ray", "ray")])
def test_a_missing_package_is_named_with_its_extra(package, launcher, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'dadiff\[{launcher}\]'"):
        make_pool(launcher, tmp_path)


def test_slurm_is_asked_for_where_it_is(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="no srun on this machine"):
        SlurmPool(tmp_path, "slurm", 1, 1, 60.0, {})
    with pytest.raises(ConfigError, match="must be slurm or local"):
        SlurmPool(tmp_path, "slum", 1, 1, 60.0, {})


@pytest.mark.slow
@pytest.mark.parametrize("launcher", EACH)
def test_every_way_to_end_has_its_status_and_reason(launcher, tmp_path):
    works = [
        work(tmp_path, "bug", math.sqrt, -1.0),
        work(tmp_path, "crash", os.abort),
        work(tmp_path, "late", time.sleep, 60.0),
        work(tmp_path, "fine", time.sleep, 0.1),
        work(tmp_path, "after", time.sleep, 0.1, needs=["bug"]),
        work(tmp_path, "then", time.sleep, 0.1, needs=["fine"]),
    ]
    observer = Silent()
    outcomes = make_pool(launcher, tmp_path, time_limit=10.0).run(works, observer)
    assert {key: outcome.status for key, outcome in outcomes.items()} == {
        "bug": "failed", "crash": "killed", "late": "timeout", "fine": "finished", "after": "failed", "then": "finished"
    }  # fmt: skip
    assert f"ValueError: math domain error; log: {tmp_path}/logs/bug.log" in outcomes["bug"].reason
    assert "Traceback" in (tmp_path / "logs" / "bug.log").read_text()
    assert "time limit of 10 s" in outcomes["late"].reason
    assert "needs bug, which failed: ValueError" in outcomes["after"].reason
    assert 1 <= observer.most <= 2


@pytest.mark.slow
@pytest.mark.parametrize("launcher", EACH)
def test_an_interrupt_ends_the_jobs(launcher, tmp_path):
    pid = tmp_path / "pid"
    endless = work(tmp_path, "endless", subprocess.call, ["sh", "-c", f"echo $PPID > {pid}; sleep 60"])
    with pytest.raises(KeyboardInterrupt):
        make_pool(launcher, tmp_path).run([endless], Impatient(pid))
    deadline = time.monotonic() + 10
    while Path(f"/proc/{int(pid.read_text())}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{int(pid.read_text())}").exists()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", EACH)
def test_a_sweep_runs_skips_and_shares_its_results_with_other_launchers(launcher, tmp_path):
    def dadiff(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "dadiff.cli", *SWEEP, f"output_dir={tmp_path / 'outputs'}", *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)

    first = dadiff(*LAUNCHERS[launcher])
    assert first.returncode == 0, first.stderr
    assert "3 runs: 2 finished, 1 refused" in first.stderr
    assert "literal scales the sample" in first.stderr
    again = dadiff(*LAUNCHERS[launcher])
    assert again.returncode == 0, again.stderr
    assert "all 3 runs are done already" in again.stderr
    assert "3 runs, 3 done, 0 to run" in dadiff("dry_run=true").stdout


@pytest.mark.slow
@pytest.mark.parametrize("launcher", EACH)
def test_jobs_end_with_a_launcher_that_is_killed_and_the_next_start_does_the_work(launcher, tmp_path):
    outputs = tmp_path / "outputs"
    long = [
        "-m", "projector=none,known", "denoiser=mlp", "denoiser.width=16", "denoiser.blocks=1", "sampler=ddim",
        "sampler.num_steps=4", "training.steps=30000", "training.checkpoint_every=50", "training.batch_size=8",
        "dataset.train_size=60", "dataset.test_size=2", "evaluation.samples=1", "hydra.launcher.sweep=long",
    ]  # fmt: skip
    command = [sys.executable, "-m", "dadiff.cli", *long, *LAUNCHERS[launcher], f"output_dir={outputs}"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as launching:
        try:
            checkpoints = waited_for(lambda: list(outputs.glob("cache/denoiser/*.partial/checkpoint.safetensors")))
        finally:
            launching.kill()
    (key,) = (path.parent.name.split(".")[0] for path in checkpoints)
    waited_for(lambda: not Cache(outputs).is_building("denoiser", key))
    assert not Cache(outputs).contains("denoiser", key)
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert "2 runs: 2 finished" in again.stderr
    client = open_client(f"sqlite:///{outputs}/mlflow.db")
    (experiment,) = (e for e in client.search_experiments() if e.name == "dadiff")
    ended = Counter((run.data.tags["kind"], run.info.status) for run in client.search_runs([experiment.experiment_id]))
    assert ended == {("run", "FINISHED"): 2, ("training", "FINISHED"): 1, ("sweep", "FINISHED"): 1}


def waited_for(condition, seconds: float = 300.0):
    """What the condition gives as soon as that is true."""
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return value

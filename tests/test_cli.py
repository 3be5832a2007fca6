"""The real command line, in an empty directory: what it prints, its exit codes, and what it does not load."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
from laws import presets

from dadiff.config import GROUPS
from dadiff.store import Sweeps

ROOT = Path(__file__).parent.parent
HEAVY = ("torch", "mlflow", "control", "cvxpy", "casadi", "matplotlib", "pandas")
TINY = (
    "denoiser=gaussian",
    "sampler=ddim",
    "sampler.num_steps=5",
    "dataset.train_size=20",
    "dataset.test_size=2",
    "evaluation.samples=2",
    "tracking.enabled=false",
    "progress=false",
)


@pytest.fixture
def dadiff(tmp_path):
    """Run `dadiff` in an empty directory."""

    def call(*arguments: str, python: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, *python, "-m", "dadiff.cli", *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)

    return call


def refused(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of an error, which is all that a refused command prints."""
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 1
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("dadiff: error: ")
    assert done.stdout == ""
    return lines[0]


def loaded(done: subprocess.CompletedProcess[str]) -> set[str]:
    """Top-level packages that `-X importtime` saw."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    return {line.rsplit("|", 1)[-1].strip().split(".")[0] for line in lines}


def test_a_run_prints_its_table_and_stores_its_result(dadiff, tmp_path):
    done = dadiff(*TINY, "projector=rollout")
    assert done.returncode == 0, done.stderr
    name, *metrics, where = done.stdout.splitlines()
    assert name.startswith("lqr/rollout/")
    assert [line.rsplit(maxsplit=1)[0].strip() for line in metrics][:2] == ["state error", "input error"]
    folder = Path(where.removeprefix("stored in "))
    assert folder.parent == tmp_path / "outputs" / "runs"
    assert json.loads((folder / "run.json").read_text())["status"] == "finished"
    assert {path.name for path in tmp_path.iterdir()} == {"outputs"}
    assert "Warning" not in done.stderr


def test_help_names_every_group_and_choice_and_loads_nothing_heavy(dadiff):
    done = dadiff("--help", python=("-X", "importtime"))
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    for group in GROUPS:
        below = lines[lines.index(f"{group}:") + 1 :]
        told = [line.split(maxsplit=1) for line in takewhile(lambda line: line.startswith(" "), below)]
        assert set(presets(group)) <= {line[0] for line in told if len(line) == 2}
    assert max(map(len, lines)) <= 80
    assert not loaded(done) & set(HEAVY)


@pytest.mark.parametrize("mistake", ["+projector.foo=1", "dataset=npz", "schedule.slope=1.0"])
def test_a_configuration_error_is_one_line_and_loads_nothing_heavy(dadiff, tmp_path, mistake):
    done = dadiff(mistake, python=("-X", "importtime"))
    assert not loaded(done) & set(HEAVY)
    done.stderr = "\n".join(line for line in done.stderr.splitlines() if not line.startswith("import time:"))
    refused(done)
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_says_what_would_run_and_writes_nothing(dadiff, tmp_path):
    done = dadiff("dry_run=true", "projector=hankel_lowrank", "recording.length=300")
    assert done.returncode == 0
    key, name = done.stdout.split()
    assert len(key) == 16
    assert name.startswith("lqr/hankel_lowrank/S=300/w=0.01/")
    assert list(tmp_path.iterdir()) == []


def test_a_key_that_hydra_knows_to_be_misspelt_fails(dadiff):
    done = dadiff("projector.initial_sate=fixed")
    assert done.returncode == 1
    assert "initial_sate" in done.stderr


def test_refusals_of_a_run_are_one_line_too(dadiff, tmp_path):
    line = refused(dadiff(*TINY, "projector=hankel", "recording.length=60"))
    assert "S = 60 is too short" in line
    assert "record S >= 93" in line
    (stored,) = (tmp_path / "outputs" / "runs").glob("*/run.json")
    assert json.loads(stored.read_text())["status"] not in ("finished", "diverged")
    assert not list(stored.parent.glob("*.parquet"))


@pytest.mark.slow
def test_a_fleet_needs_a_family_of_robots(dadiff):
    error = refused(dadiff("task=fleet", "system=double_integrator"))
    assert "fleet draws robots from a family, found a single system; choose system=damped_integrators" in error


def test_a_sweep_that_another_process_runs_is_refused(dadiff, tmp_path):
    with Sweeps(tmp_path / "outputs").running("twin"):
        error = refused(dadiff("-m", "projector=none,known", "hydra.launcher.sweep=twin", *TINY))
    assert f"sweep twin is being run by process {os.getpid()}" in error


def test_a_bad_file_is_named(dadiff, tmp_path):
    for part in ("train", "test"):
        (tmp_path / "mine" / part).mkdir(parents=True)
        np.savez(tmp_path / "mine" / part / "a.npz", states=np.full((31, 4), np.nan))
    line = refused(dadiff(*TINY[:3], *TINY[6:], "dataset=npz", "dataset.path=mine"))
    assert "a.npz: array states holds a value that is not finite" in line


@pytest.mark.slow
def test_an_output_folder_that_cannot_be_written_is_named(dadiff, tmp_path):
    (tmp_path / "file").write_text("in the way")
    assert "file/below" in refused(dadiff(*TINY, "output_dir=file/below"))


def test_a_configuration_is_checked_before_it_is_printed(dadiff):
    assert "_target_: dadiff.systems.double_integrator" in dadiff("--cfg", "job").stdout
    mistaken = dadiff("--cfg", "job", "evaluation.samples=2.5")
    assert "evaluation (evaluation/default.yaml): samples is 2.5" in refused(mistaken)
    assert not mistaken.stdout


def test_a_parameter_of_the_command_takes_the_place_of_the_sweep_files(dadiff):
    """3 projectors x 2 seeds x 2 lengths x 4 noises, and 2 that read no recording, for each of 2 trainings."""
    done = dadiff("+sweeps=recordings", "recording.seed=0,1", "recording.length=100,150", "dry_run=true")
    assert "100 runs, 0 done, 100 to run" in done.stdout

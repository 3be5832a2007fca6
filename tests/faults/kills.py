"""Kill a sweep in every place that matters, run it again, and hold the end against an undisturbed sweep.

    python -m tests.faults.kills                 prints the table
    python -m tests.faults.kills --random 30     kills the first start of a run at random moments, as often

Each trial starts from nothing: two workers, one training, four cells. What is held: the rerun completes, its tables
and weights equal the undisturbed ones bit for bit, no result that was there is made again, MLflow has one finished
run a cell and a training, and nothing is left RUNNING.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dadiff.store import Cache, Results
from dadiff.tracking.client import open_client

SWEEP = [
    "-m", "projector=none,known", "sampler.num_steps=4,5", "denoiser=mlp", "denoiser.width=16", "denoiser.blocks=1",
    "training.steps=30", "training.warmup=1", "training.batch_size=8", "training.checkpoint_every=10", "sampler=ddim",
    "dataset.train_size=60", "dataset.test_size=2", "evaluation.samples=2", "device=cpu", "progress=false",
    "hydra.launcher.workers=2",
]  # fmt: skip

RUN = [*(word for word in SWEEP[3:] if not word.startswith("hydra")), "sampler.num_steps=4"]
"""One run with its training: what a first start makes everything for."""

PLACES = {
    "job: at its start": "dadiff.launching.jobs:run:before",
    "job: before sampling": "dadiff.running.experiment:draw_plans:before",
    "job: after sampling": "dadiff.running.experiment:draw_plans:after",
    "job: before its result is written": "dadiff.store.results:Results.write:before",
    "job: tables written, record not": "dadiff.store.results:write_json:before",
    "job: result written, not in its place": "dadiff.store.results:_replace:before",
    "job: result in its place": "dadiff.store.results:_replace:after",
    "job: before its plans are evaluated": "dadiff.running.experiment:evaluate:before",
    "trainer: before it trains": "dadiff.denoisers.learning:train:before",
    "trainer: before a checkpoint": "dadiff.denoisers.learning:State.store:before",
    "trainer: after a checkpoint": "dadiff.denoisers.learning:State.store:after",
    "trainer: at its end": "dadiff.denoisers.learning:_finish:after",
    "cache: before the manifest": "dadiff.store.cache:write_json:before",
    "cache: before the rename": "dadiff.store.cache:sync_folder:after",
    "data set: half written": "dadiff.running.assembly:save_data:after",
    "MLflow: some of its tables made": "alembic.command:upgrade:before",
    "MLflow: its database not in its place": "dadiff.tracking.database:_create:before",
    "MLflow: its database in its place": "dadiff.tracking.database:_create:after",
    "MLflow: run made, nothing done": "dadiff.tracking.mirror:Mirror._create:after",
    "MLflow: before logging": "dadiff.tracking.tracking:Tracking.log_run:before",
    "MLflow: metrics logged, files not": "mlflow:MlflowClient.log_artifact:before",
    "MLflow: everything logged, run open": "mlflow:MlflowClient.set_terminated:before",
    "MLflow: run closed, not stamped": "mlflow:MlflowClient.set_terminated:after",
    "launcher: after its start": "dadiff.launching.sweep:SweepRun.open:after",
    "launcher: as a job ends": "dadiff.launching.launcher:Watch.ended:before",
    "launcher: before its end": "dadiff.launching.sweep:SweepRun.close:before",
    "launcher: as MLflow catches up": "dadiff.tracking.tracking:Tracking.catch_up:before",
}


@dataclass(frozen=True)
class Trial:
    """What became of a sweep that was killed once and run again."""

    codes: tuple[int, int]
    problems: list[str]
    redone: int
    seconds: float


@dataclass(frozen=True)
class Struck:
    """A first start that was killed after some seconds, and what came of starting again."""

    after: float
    whole: bool
    problems: list[str]


def command_of(words: list[str], root: Path) -> list[str]:
    """dadiff with the traps of `faulty_dadiff`, which spring only where they are set."""
    return [sys.executable, str(Path(__file__).with_name("faulty_dadiff.py")), *words, f"output_dir={root}"]


def struck(root: Path, after: float, whole: bool, expected: dict[str, bytes], kinds: list[str]) -> Struck:
    """Start a run, kill it after some seconds, its helpers too or not, start it again, and compare.

    Args:
        expected, kinds: results, and kinds of finished runs in MLflow, of an undisturbed start.
    """
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    first = subprocess.Popen(command_of(RUN, root), start_new_session=True, **quiet)
    time.sleep(after)
    (os.killpg if whole else os.kill)(first.pid, signal.SIGKILL)
    first.wait()
    second = subprocess.run(command_of(RUN, root), capture_output=True, text=True, check=False, timeout=600)
    problems = [] if second.returncode == 0 else [f"the rerun failed: {second.stderr[-500:]}"]
    problems += [] if fingerprints(root) == expected else ["results differ from those of the undisturbed run"]
    return Struck(after, whole, problems + (mlflow_problems(root, kinds) if not problems else []))


def struck_at_random(folder: Path, count: int, seed: int) -> Iterator[Struck]:
    """First starts that are killed at moments drawn from the time that an undisturbed one takes."""
    rng, start = random.Random(seed), time.monotonic()
    subprocess.run(command_of(RUN, folder / "undisturbed"), capture_output=True, check=True, timeout=600)
    seconds, expected = time.monotonic() - start, fingerprints(folder / "undisturbed")
    kinds = finished_kinds(folder / "undisturbed")
    for number in range(count):
        root = folder / f"struck-{number}"
        yield struck(root, rng.uniform(0.1, 1.0) * seconds, rng.random() < 0.5, expected, kinds)
        shutil.rmtree(root)


def launch(root: Path, fault: str = "", arguments: list[str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run the sweep in `root`, with a trap or without."""
    environment = {**os.environ, "FAULT": fault, "FAULT_TOKEN": str(root.parent / f"{root.name}.token")}
    command = [sys.executable, str(Path(__file__).with_name("faulty_dadiff.py")), *SWEEP, *(arguments or [])]
    return subprocess.run(
        [*command, f"output_dir={root}"], env=environment, capture_output=True, text=True, check=False, timeout=300
    )


def reference(root: Path) -> dict[str, bytes]:
    """Every result of an undisturbed sweep."""
    ended = launch(root)
    if ended.returncode:
        raise RuntimeError(ended.stderr)
    return fingerprints(root)


def fingerprints(root: Path) -> dict[str, bytes]:
    """Key -> the bytes that must not depend on what happened on the way: tables, and weights."""
    found = {run.key: (run.folder / "per_step.parquet").read_bytes() for run in Results(root) if run.has("per_step")}
    for entry in Cache(root).entries():
        if entry.kind == "denoiser" and entry.state == "whole":
            found[entry.key] = in_order((entry.folder / "model.safetensors").read_bytes())
    return found


def in_order(weights: bytes) -> bytes:
    """A safetensors file with its header in order: that of its notes is another one in every process."""
    end = 8 + int.from_bytes(weights[:8], "little")
    return json.dumps(json.loads(weights[8:end]), sort_keys=True).encode() + weights[end:]


def trial(root: Path, fault: str, expected: dict[str, bytes]) -> Trial:
    """Kill, run again, and compare."""
    start = time.monotonic()
    first = launch(root, fault)
    fell = (root.parent / f"{root.name}.token").exists()
    before = {
        run.key: (run.folder / "run.json").stat().st_mtime_ns for run in Results(root) if run.status == "finished"
    }
    second = launch(root)
    problems = [] if fell else ["the trap did not spring"]
    problems += [] if second.returncode == 0 else [f"the rerun failed: {second.stderr[-500:]}"]
    problems += [] if fingerprints(root) == expected else ["results differ from those of the undisturbed sweep"]
    again = [key for key, at in before.items() if (Results(root).folder(key) / "run.json").stat().st_mtime_ns != at]
    problems += [f"done twice: {key}" for key in again]
    problems += mlflow_problems(root, ["run"] * 4 + ["sweep", "training"])
    redone, seconds = len(expected) - 1 - len(before), time.monotonic() - start
    return Trial((first.returncode, second.returncode), problems, redone, seconds)


def runs_in_mlflow(root: Path) -> tuple[Any, list[Any]]:
    """A client, and all runs."""
    client = open_client(f"sqlite:///{root}/mlflow.db")
    (experiment,) = (e for e in client.search_experiments() if e.name == "dadiff")
    return client, list(client.search_runs([experiment.experiment_id], max_results=1000))


def finished_kinds(root: Path) -> list[str]:
    """The kinds of the finished runs in MLflow."""
    return sorted(run.data.tags["kind"] for run in runs_in_mlflow(root)[1] if run.info.status == "FINISHED")


def mlflow_problems(root: Path, expected: list[str]) -> list[str]:
    """What MLflow shows that it should not, or lacks of the kinds of finished runs that are expected."""
    client, runs = runs_in_mlflow(root)
    problems = [f"left RUNNING: {run.info.run_name}" for run in runs if run.info.status == "RUNNING"]
    finished = [run for run in runs if run.info.status == "FINISHED"]
    kinds = sorted(run.data.tags["kind"] for run in finished)
    if kinds != expected:
        problems.append(f"MLflow has finished runs {kinds}")
    for run in finished:
        if run.data.tags["kind"] == "run":
            steps = [point.step for point in client.get_metric_history(run.info.run_id, "t/gap")]
            problems += (
                [] if steps == sorted(set(steps)) and len(steps) == 31 else [f"curve of {run.info.run_name}: {steps}"]
            )
    return problems


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="part of a place's name")
    parser.add_argument("--random", type=int, default=0, help="kill so many first starts at random moments instead")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    wanted, folder = options.only, Path(tempfile.mkdtemp())
    if options.random:
        return print_struck(folder, options.random, options.seed)
    expected = reference(folder / "undisturbed")
    sys.stdout.write(f"{'killed':<38} {'exit':>5} {'rerun':>5} {'redone':>6} {'s':>4}  verdict\n")
    for number, (place, fault) in enumerate(PLACES.items()):
        if wanted in place:
            done = trial(folder / str(number), fault, expected)
            verdict = "; ".join(done.problems) or "equal, once, closed"
            row = f"{place:<38} {done.codes[0]:>5} {done.codes[1]:>5} {done.redone:>6} {done.seconds:>4.0f}  {verdict}"
            sys.stdout.write(row + "\n")
            sys.stdout.flush()
    shutil.rmtree(folder)


def print_struck(folder: Path, count: int, seed: int) -> None:
    """Print what became of first starts that were killed at random moments."""
    recovered = 0
    for done in struck_at_random(folder, count, seed):
        recovered += not done.problems
        who = "all of it" if done.whole else "its first process"
        verdict = "; ".join(done.problems) or "equal, once, closed"
        sys.stdout.write(f"killed {who:<17} after {done.after:5.1f} s: {verdict}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{recovered} of {count} recovered\n")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()

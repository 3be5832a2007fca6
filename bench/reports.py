"""A report of many runs: how its time and memory grow with their number. The runs are copies under other names."""

from __future__ import annotations

import resource
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.overhead import dadiff, finished
from bench.rows import Row, seconds
from dadiff.running.digest import digest
from dadiff.store import Results, StoredRun, Sweep, Sweeps, SweptRun
from dadiff.store.files import write_json

COUNTS = (500, 2000)
CALLS = (3, 4, 5, 10, 20)
TINY = ["dataset.train_size=60", "dataset.test_size=2", "evaluation.samples=2", "schedule.num_steps=30"]


def copied(run: StoredRun, output_dir: Path, calls: int, seed: int) -> SweptRun:
    """A run as if it had been made with so many calls and another seed."""
    key = digest([run.key, calls, seed])
    axes = {**run.axes, "sampler.num_steps": calls, "seed": seed, "evaluation.seed": seed, "dataset.seed": seed}
    name = f"{run.name.rpartition('/')[0]}/calls={calls}/seed={seed}"
    folder = Results(output_dir).folder(key)
    shutil.copytree(run.folder, folder)
    write_json(folder / "run.json", replace(run.record, key=key, name=name, axes=axes).to_json())
    return SweptRun(key, name, dict(axes), "finished")


def store(runs: Sequence[StoredRun], output_dir: Path, count: int) -> str:
    """A sweep of so many copies; returns its name."""
    cells, seed = list[SweptRun](), 0
    while len(cells) < count:
        cells += [copied(run, output_dir, calls, seed) for run in runs for calls in CALLS]
        seed += 1
    name = f"copies-{count}"
    Sweeps(output_dir).write(Sweep(name, "dadiff", {"seed": f"range({seed})"}, cells[:count]))
    return name


def report(output_dir: Path, name: str) -> None:
    """Write one."""
    finished([sys.executable, "-m", "dadiff.reporting.cli", name, "--output-dir", str(output_dir)])


def measure() -> list[Row]:
    """The rows."""
    with tempfile.TemporaryDirectory() as folder:
        made, copies = Path(folder, "made"), Path(folder, "copies")
        dadiff(str(made), "projector=none,known", *TINY)
        runs, points = list(Results(made)), []
        for count in COUNTS:
            name = store(runs, copies / str(count), count)
            points.append((float(count), seconds(lambda name=name, count=count: report(copies / str(count), name))))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return [
        Row("a report of 2,000 runs", points[-1][1], "s", points=points),
        Row("its memory at the most", peak, "MB"),
    ]

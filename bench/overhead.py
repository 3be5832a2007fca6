"""What a sweep costs beside its cells' own work: planning it, and repeating it when it is done."""

from __future__ import annotations

import subprocess
import sys
import tempfile

from bench.rows import Row, seconds

MANY = ["projector=none,known,hankel,hankel_lowrank,identified,rollout", "recording.length=range(100,115)"]
FEW = ["projector=none,known", "sampler.num_steps=3,4", "seed=0,1,2,3", "dataset.train_size=60", "dataset.test_size=2"]
FEW += ["evaluation.samples=2", "schedule.num_steps=30"]


def dadiff(folder: str, *words: str) -> float:
    """Seconds of one command.

    Raises:
        RuntimeError: with what it said, if it failed.
    """
    command = [sys.executable, "-m", "dadiff", "-m", "denoiser=gaussian", f"output_dir={folder}", *words]
    return seconds(lambda: finished(command))


def finished(command: list[str]) -> None:
    """Run a command to its end.

    Raises:
        RuntimeError: with what it said, if it failed.
    """
    done = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: {done.stderr[-2000:]}")


def measure() -> list[Row]:
    """The rows."""
    with tempfile.TemporaryDirectory() as folder:
        points = [
            (6.0 * 15 * seeds, dadiff(folder, *MANY, f"seed=range({seeds})", "dry_run=true")) for seeds in (1, 10)
        ]
        whole, again = dadiff(folder, *FEW), dadiff(folder, *FEW)
    return [
        Row("planning a sweep of 900 cells", points[-1][1], "s", points=points),
        Row("a sweep of 16 trivial cells", whole, "s"),
        Row("the same when it is done", again, "s"),
    ]

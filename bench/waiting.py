"""How many threads, and how long they spin before they sleep: trainings and cells, alone and beside one busy process.

    python -m bench waiting

Every setting has a process of its own, and they take turns, so that whatever else the machine does meets all alike.
Each figure is that of one piece of work; `side by side` are as many processes as cores, one thread each.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np

from bench.rows import seconds
from dadiff import threads

ROUNDS, TIMES = 5, 8
SPINS = (0, 300, 1000, 2000, 5000, 20_000)
PIECES = ("training, float32", "training, bfloat16", "1,000 plans")
BUSY = [sys.executable, "-c", "while True: pass"]


def pieces() -> list[Callable[[], object]]:
    """A step of the quick training in each precision, and a cell's plans in three calls."""
    from bench.learning import LAYOUT, training_step
    from bench.planning import drawing
    from dadiff.behaviours import Known
    from dadiff.denoisers import MLP
    from dadiff.denoisers.training import Training
    from dadiff.diffusion.samplers import DPMSolver
    from dadiff.systems import double_integrator

    free = Known().fit(LAYOUT, double_integrator()).bind(device="cpu")
    trainings = [Training(steps=10_000, batch_size=256, precision=p) for p in ("float32", "bfloat16")]
    steps = [training_step(MLP(), training) for training in trainings]
    return [*steps, drawing(MLP(), DPMSolver(3), (1000, LAYOUT.size), free)]


def work() -> None:
    """For each line that names a piece, do it some times, and say how many milliseconds one took."""
    known = pieces()
    for line in sys.stdin:
        piece = known[int(line)]
        print(1e3 * seconds(lambda piece=piece: [piece() for _ in range(TIMES)]) / TIMES, flush=True)


class Setting:
    """Processes that do the same at the same time."""

    def __init__(self, name: str, count: int, each: int, spins: int) -> None:
        self.name, variables = name, os.environ | threads.limits(each) | {threads.SPINNING: str(spins)}
        command = [sys.executable, "-m", "bench.waiting", "work"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": variables}
        self._processes = [subprocess.Popen(command, **pipes) for _ in range(count)]

    def milliseconds(self, piece: int) -> float:
        """Of one piece of work; several processes do several in that time."""
        for process in self._processes:
            process.stdin.write(f"{piece}\n")
            process.stdin.flush()
        return max(float(process.stdout.readline()) for process in self._processes) / len(self._processes)

    def close(self) -> None:
        """End them."""
        for process in self._processes:
            process.stdin.close()
            process.wait()


def settings() -> Iterator[Setting]:
    """One thread, all of them with different patience, and one each side by side."""
    cores = threads.cores()
    yield Setting("one thread", 1, 1, 0)
    for spins in SPINS:
        yield Setting(f"{cores} threads, {spins} rounds", 1, cores, spins)
    yield Setting(f"{cores} side by side", cores, 1, 0)


@contextmanager
def beside(busy: int) -> Iterator[None]:
    """So many busy processes meanwhile."""
    running = [subprocess.Popen(BUSY) for _ in range(busy)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def measured(known: Sequence[Setting]) -> np.ndarray:
    """Milliseconds (settings, pieces): the median of some rounds, in each of which all take their turn."""
    turns = [[[s.milliseconds(k) for k in range(len(PIECES))] for s in known] for _ in range(ROUNDS)]
    return np.median(turns, axis=0)


def main() -> None:
    """Print milliseconds, and how much longer than with the best setting in the same place."""
    with ExitStack() as stack:
        known = list(settings())
        for setting in known:
            stack.callback(setting.close)
        measured(known[:1])  # all have loaded once the first answers, or nearly
        for busy, where in enumerate(("alone", "beside one busy process")):
            with beside(busy):
                found = measured(known)
            print(f"{where:<26}" + "".join(f"{name:>28}" for name in PIECES))
            for setting, row in zip(known, found, strict=True):
                shares = row / found.min(axis=0) - 1
                print(
                    f"  {setting.name:<24}"
                    + "".join(f"{ms:>16.1f} ms{share:>+8.0%} " for ms, share in zip(row, shares, strict=True))
                )


if __name__ == "__main__":
    work() if sys.argv[1:] == ["work"] else main()

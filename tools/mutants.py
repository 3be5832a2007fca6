"""Mutants: small faults put into the core one at a time, each of which a test must find.

    .venv/bin/python tools/mutants.py [--count 120] [--seconds 900] [--seed 0] [--only dadiff/diffusion/chain.py]

The tests are collected once. Which of them come to which line, and how long they take, is measured once and kept for
files that stay the same. Each mutant is a fork of this process in which the code of one function is replaced; it runs
the tests that come to the changed line, the quickest first, until one fails. So most cost less than a second.
Compiled loops are left alone; with `--compiled` they, as plain Python, which is slow, are all that is changed. A mutant
that no test finds has survived, and is listed; those that `tools/mutants.txt` explains are not counted. Leaves with
exit code 1 if fewer than 95 % are found.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import importlib
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType

os.environ |= {"OMP_NUM_THREADS": "1"} | ({"NUMBA_DISABLE_JIT": "1"} if "--compiled" in sys.argv else {})

import coverage
import pytest
from _pytest.runner import runtestprotocol
from faults import ROOT, Fault, faults

COMPILED = "--compiled" in sys.argv
ENOUGH = 0.95
LONGEST, BUDGET = 10.0, 20.0  # processor seconds of a test that is used, and of all tests for one mutant
ROOMS = ("trajectory", "behaviours", "diffusion", "denoisers", "experts", "tasks")
TESTS = """layout response hankel subspace covariance systems nonlinear features flat physics
    behaviours limited limited_ilqr nearest limiting manifold family offsets enforcement conditional measured
    rivals rival_networks exact doubt
    samplers schedules silence theorem1 denoisers training encodings
    lqr fleet ilqr obstacle_solver obstacle_experts obstacle_files obstacle_task manoeuvre
    evaluation control closed_loop planning datasets likeness"""
REASONS = Path(__file__).with_suffix(".txt")
KEPT = ROOT / ".pytest_cache" / "mutants"


@dataclass
class Seen:
    """What tests come to.

    Args:
        seconds: of each test, by its name.
        lines: file -> line -> names of the tests that come there.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    lines: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def add(self, other: Seen) -> None:
        """Those of another file of tests."""
        self.seconds |= other.seconds
        self.failed += other.failed
        for file, lines in other.lines.items():
            for line, tests in lines.items():
                self.lines.setdefault(file, {}).setdefault(line, []).extend(tests)

    def tests(self, fault: Fault) -> list[str]:
        """Those that come to a fault's line, or else to its statement, or else to its function; the quickest first."""
        known = self.lines.get(str(fault.file.relative_to(ROOT)), {})
        for lines in ([fault.line], fault.lines, fault.function):
            if found := {test for line in lines for test in known.get(str(line), [])}:
                return within(BUDGET, sorted(found, key=self.seconds.__getitem__), self.seconds)
        return []


def within(budget: float, tests: Sequence[str], seconds: dict[str, float]) -> list[str]:
    """As many as fit into the budget, and each short enough."""
    chosen, spent = [], 0.0
    for test in tests:
        spent += seconds[test]
        if spent > budget or seconds[test] > LONGEST:
            break
        chosen.append(test)
    return chosen


@dataclass
class Judge:
    """Takes the place of pytest's loop over tests."""

    given: argparse.Namespace
    code: int = 1

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Measure what is not kept, then try mutants."""
        items = {item.nodeid: item for item in session.items}
        for module in modules():
            importlib.import_module(module)
        seen = all_seen(items)
        for name in seen.failed:
            print(f"fails without any mutant, and is not used: {name}")
        self.code = judge(queue(self.given), seen, items, self.given)
        return True


def modules() -> Iterator[str]:
    """Of the rooms, so that what is imported late is there to be changed."""
    for room in ROOMS:
        for file in sorted((ROOT / "dadiff" / room).rglob("*.py")):
            yield ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def all_seen(items: dict[str, pytest.Item]) -> Seen:
    """Of all tests, measured now where the core or the test has changed since the last time."""
    KEPT.mkdir(parents=True, exist_ok=True)
    core, seen = digest(sorted((ROOT / "dadiff").rglob("*.py"))), Seen()
    for test in sorted({item.path for item in items.values()}):
        kept = KEPT / f"{test.stem}{'-compiled' * COMPILED}-{core}-{digest([test])}.json"
        if not kept.is_file():
            began = time.monotonic()
            in_fork(lambda test=test, kept=kept: measure([i for i in items.values() if i.path == test], kept))
            print(f"measured {test.stem} in {time.monotonic() - began:.0f} s", flush=True)
        seen.add(Seen(**json.loads(kept.read_text())))
    return seen


def digest(files: Sequence[Path]) -> str:
    """Of what the files hold."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def measure(items: Sequence[pytest.Item], kept: Path) -> bool:
    """Run tests, and write to which lines each of them comes."""
    seen = Seen()
    watch = coverage.Coverage(data_file=None, include=[str(ROOT / "dadiff" / room / "*") for room in ROOMS])
    watch.start()
    signal.signal(signal.SIGVTALRM, too_long)
    for item, after in zip(items, [*items[1:], None], strict=True):
        watch.switch_context(item.nodeid)
        signal.setitimer(signal.ITIMER_VIRTUAL, 2 * LONGEST)
        began = time.process_time()
        if not passes(item, after) and time.process_time() - began < LONGEST:
            seen.failed.append(item.nodeid)
        seen.seconds[item.nodeid] = time.process_time() - began
    signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    watch.stop()
    data = watch.get_data()
    for file in data.measured_files():
        lines = {str(k): sorted(set(tests) - {"", *seen.failed}) for k, tests in data.contexts_by_lineno(file).items()}
        seen.lines[str(Path(file).relative_to(ROOT))] = {line: tests for line, tests in lines.items() if tests}
    kept.write_text(json.dumps(vars(seen)))
    return True


def too_long(*_: object) -> None:
    """Ends a test that would not be used."""
    raise TimeoutError(f"takes more than {2 * LONGEST} s")


def passes(item: pytest.Item, after: pytest.Item | None) -> bool:
    """Whether a test passes, or is skipped."""
    return not any(report.failed for report in runtestprotocol(item, nextitem=after, log=False))


def queue(given: argparse.Namespace) -> list[Fault]:
    """Mutants in an order drawn from the seed, without those that are explained."""
    explained = reasons()
    found = [
        fault
        for room in ROOMS
        for file in sorted((ROOT / "dadiff" / room).rglob("*.py"))
        if given.only in str(file.relative_to(ROOT))
        for fault in faults(file)
        if fault.compiled == COMPILED
    ]
    random.Random(given.seed).shuffle(found)
    return [fault for fault in found if fault.name not in explained]


def judge(found: Sequence[Fault], seen: Seen, items: dict[str, pytest.Item], given: argparse.Namespace) -> int:
    """Try mutants until there are enough or the time is over, and say how many lived."""
    began, tried, alive = time.monotonic(), 0, 0
    for fault in found[: given.count]:
        if time.monotonic() - began > given.seconds:
            break
        tried += 1
        tests = [items[name] for name in seen.tests(fault)]
        if in_fork(lambda fault=fault, tests=tests: survives(fault, tests)):
            alive += 1
            print(f"survived {len(tests)} tests, line {fault.line}: {fault.name}", flush=True)
    killed = tried - alive
    print(
        f"{killed} of {tried} mutants found ({killed / max(tried, 1):.1%}), drawn with seed {given.seed} from "
        f"{len(found)}; {time.monotonic() - began:.0f} s"
    )
    return int(killed < ENOUGH * tried)


def survives(fault: Fault, tests: Sequence[pytest.Item]) -> bool:
    """Whether all tests pass with the fault in place."""
    codes = fault.codes()
    for function in gc.get_objects():
        if type(function) is FunctionType and function.__code__.co_filename == str(fault.file):
            code = function.__code__
            function.__code__ = codes.get((code.co_qualname, code.co_firstlineno), code)
    return all(passes(item, after) for item, after in zip(tests, [*tests[1:], None], strict=True))


def in_fork(work: Callable[[], bool]) -> bool:
    """What a function says in a process of its own; False if it fails, or takes much more than the budget."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (int(20 * BUDGET), int(20 * BUDGET)))
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        os._exit(0 if work() else 1)
    finally:
        os._exit(2)


def reasons() -> dict[str, str]:
    """Survivors that are explained: name -> reason."""
    lines = [line for line in REASONS.read_text().splitlines() if line and not line.startswith("#")]
    return {name.strip(): reason.strip() for name, _, reason in (line.rpartition(" | ") for line in lines)}


def main() -> int:
    """The command line; returns its exit code."""
    parser = argparse.ArgumentParser("mutants", description="Which faults put into the core do the tests not find?")
    parser.add_argument("--count", type=int, default=120, help="how many (120)")
    parser.add_argument("--seconds", type=float, default=900.0, help="when to stop in any case (900)")
    parser.add_argument("--seed", type=int, default=0, help="of the order (0)")
    parser.add_argument("--only", default="", help="files whose path contains this")
    parser.add_argument("--compiled", action="store_true", help="faults in compiled loops, and no others")
    parser.add_argument("--tests", nargs="*", default=TESTS.split(), help="names of test files")
    judge = Judge(parser.parse_args())
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    with tempfile.TemporaryDirectory() as folder:
        files = [str(ROOT / "tests" / f"test_{name}.py") for name in judge.given.tests]
        options = ["-s", "-q", "-p", "no:cacheprovider", "-p", "no:timeout", f"--basetemp={folder}/pytest"]
        pytest.main([*options, *files], plugins=[judge])
    return judge.code


if __name__ == "__main__":
    raise SystemExit(main())

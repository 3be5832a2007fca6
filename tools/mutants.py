"""Mutants: small faults put into the core one at a time, each of which the tests of its room must find.

    .venv/bin/python tools/mutants.py [--seconds 900] [--seed 0] [room ...]

Operators, comparisons, numbers, conditions and flags are changed, one in each mutant, in an order drawn from the seed
until the time is over. A mutant lives in a forked process alone, where its module is loaded from the changed source.
Those that no test finds are listed; those that `tools/mutants.txt` explains are not counted.
Leaves with exit code 1 if fewer than 95 % are found.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.abc
import importlib.util
import os
import random
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
REASONS = Path(__file__).with_suffix(".txt")
ENOUGH, LIMIT = 0.95, 300
TESTS = {
    "trajectory": "layout response hankel subspace covariance systems",
    "behaviours": "behaviours enforcement conditional",
    "diffusion": "samplers schedules silence enforcement theorem1 conditional",
    "denoisers": "denoisers training samplers encodings",
    "experts": "lqr obstacle_solver obstacle_experts ilqr",
    "tasks": "lqr fleet obstacle_task obstacle_files encodings evaluation",
}
SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.Lt: ast.LtE,
    ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or,
    ast.Or: ast.And,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Args:
        place: of the changed node in the order of `ast.walk`.
    """

    file: Path
    place: int
    line: int
    change: str

    @property
    def name(self) -> str:
        """File, line of code and change: what a reason is listed under."""
        code = self.file.read_text().splitlines()[self.line - 1].strip()
        return f"{self.file.relative_to(ROOT)} | {code} | {self.change}"

    def source(self) -> ast.Module:
        """The changed module."""
        tree = ast.parse(self.file.read_text())
        node = list(ast.walk(tree))[self.place]
        mutate(node)
        return ast.fix_missing_locations(tree)


def mutate(node: ast.AST) -> str | None:
    """Change a node in place; returns what was done, None if there is nothing to change."""
    if isinstance(node, (ast.BinOp, ast.BoolOp, ast.AugAssign)) and type(node.op) in SWAPS:
        before, node.op = type(node.op), SWAPS[type(node.op)]()
        return f"{before.__name__} -> {type(node.op).__name__}"
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        before, node.ops[0] = type(node.ops[0]), SWAPS[type(node.ops[0])]()
        return f"{before.__name__} -> {type(node.ops[0]).__name__}"
    if isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
        before = node.value
        node.value = (not before) if isinstance(before, bool) else before + 1 if isinstance(before, int) else 2 * before
        return f"{before} -> {node.value}" if node.value != before else None
    if isinstance(node, (ast.If, ast.IfExp)):
        node.test = ast.UnaryOp(ast.Not(), node.test)
        return "condition -> not"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        node.op = ast.UAdd()
        return "minus -> plus"
    return None


def mutants(file: Path) -> Iterator[Mutant]:
    """All of a file. Messages, types, defaults of parameters and what only a type checker reads are left alone."""
    tree = ast.parse(file.read_text())
    left_alone = {id(inner) for node in ast.walk(tree) for outer in unread(node) for inner in ast.walk(outer)}
    for place, node in enumerate(ast.walk(tree)):
        if id(node) not in left_alone and (change := mutate(copy.deepcopy(node))):
            yield Mutant(file, place, getattr(node, "lineno", 1), change)


def unread(node: ast.AST) -> list[ast.AST]:
    """Parts of a node whose changes no test should have to find."""
    if isinstance(node, (ast.Raise, ast.JoinedStr)):
        return [node]
    if isinstance(node, (ast.FunctionDef, ast.arguments)):
        return [part for part in ast.iter_child_nodes(node) if isinstance(part, ast.arguments)] + (
            [node.returns] if isinstance(node, ast.FunctionDef) and node.returns else []
        )
    if isinstance(node, ast.AnnAssign):
        return [node.annotation, *([node.value] if isinstance(node.value, ast.Constant) else [])]
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return [node]
    return []


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module from a changed source."""

    def __init__(self, mutant: Mutant) -> None:
        path = mutant.file.relative_to(ROOT).with_suffix("")
        self.name, self.mutant = ".".join(path.parts).removesuffix(".__init__"), mutant

    def find_spec(self, name, path=None, target=None):  # type: ignore[no-untyped-def]
        """The spec of the one module."""
        found = name == self.name
        return importlib.util.spec_from_file_location(name, self.mutant.file, loader=self) if found else None

    def create_module(self, spec):  # type: ignore[no-untyped-def]
        """As usual."""
        return None

    def exec_module(self, module):  # type: ignore[no-untyped-def]
        """Run the changed source."""
        exec(compile(self.mutant.source(), str(self.mutant.file), "exec"), module.__dict__)


def survives(mutant: Mutant | None, files: list[str]) -> bool:
    """Whether all tests pass, in a process of its own; one that takes too long does not survive."""
    child = os.fork()
    if child == 0:
        os.setpgrp()
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
        if mutant is not None:
            sys.meta_path.insert(0, Changed(mutant))
        import pytest

        arguments = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *files]
        os._exit(int(pytest.main(arguments)))
    deadline = time.monotonic() + LIMIT
    while time.monotonic() < deadline:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def tests(room: str) -> list[str]:
    """The files that must find the mutants of a room."""
    return [str(ROOT / "tests" / f"test_{name}.py") for name in TESTS[room].split()]


def reasons() -> dict[str, str]:
    """Survivors that are explained: name -> reason."""
    lines = [line for line in REASONS.read_text().splitlines() if line and not line.startswith("#")]
    return {name.strip(): reason.strip() for name, _, reason in (line.rpartition(" | ") for line in lines)}


def main() -> int:
    """The command line; returns its exit code."""
    parser = argparse.ArgumentParser("mutants", description="Which faults put into the core do the tests not find?")
    parser.add_argument("rooms", nargs="*", default=list(TESTS), help=f"of {', '.join(TESTS)}")
    parser.add_argument("--seconds", type=float, default=900.0, help="when to stop (900)")
    parser.add_argument("--seed", type=int, default=0, help="of the order (0)")
    parser.add_argument("--only", default="", help="files whose path contains this")
    given = parser.parse_args()
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import hypothesis  # noqa: F401  # before the fork, since they take long
    import torch

    torch.set_num_threads(1)
    return judge(list(queue(given.rooms, given.only, given.seed)), given.seconds)


def queue(rooms: list[str], only: str, seed: int) -> list[tuple[str, Mutant]]:
    """(room, mutant) in an order drawn from the seed."""
    found = [
        (room, mutant)
        for room in rooms
        for file in sorted((ROOT / "dadiff" / room).rglob("*.py"))
        if only in str(file)
        for mutant in mutants(file)
    ]
    random.Random(seed).shuffle(found)
    return found


def judge(found: list[tuple[str, Mutant]], seconds: float) -> int:
    """Try mutants until the time is over, and say how many lived."""
    for room in {room for room, _ in found}:
        if not survives(None, tests(room)):
            print(f"the tests of {room} fail without any mutant: run them first")
            return 1
    explained, begun, killed, alive = reasons(), time.monotonic(), 0, []
    for room, mutant in found:
        if time.monotonic() - begun > seconds:
            break
        if mutant.name in explained:
            continue
        if survives(mutant, tests(room)):
            alive.append(mutant.name)
            print(f"survived  {mutant.file.relative_to(ROOT)}:{mutant.line}  {mutant.name}", flush=True)
        else:
            killed += 1
    tried = killed + len(alive)
    print(f"{killed} of {tried} mutants found ({killed / max(tried, 1):.0%}), of {len(found)} that there are")
    return int(killed < ENOUGH * tried)


if __name__ == "__main__":
    raise SystemExit(main())

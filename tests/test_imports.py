"""Imports go downwards only: the table of rooms in CONTRIBUTING.md, walked and held."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "dadiff"
HEAVY = {"torch", "mlflow", "control", "cvxpy", "casadi", "matplotlib", "numba"}
OPEN = {"terminal", "errors", "randomness", "folders", "threads", "outside", "memory", "commands", "compiling"}


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


FILES = {str(file.relative_to(ROOT)): file for file in sorted(PACKAGE.rglob("*.py"))}


@cache
def table() -> dict[str, tuple[set[str], set[str]]]:
    """Room -> (rooms that it may import, third parties), as CONTRIBUTING.md says."""
    rows: dict[str, tuple[set[str], set[str]]] = {}
    for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines():
        if not line.startswith("| `dadiff/"):
            continue
        names, _, below, parties = (cell.strip() for cell in line.strip("|").split("|"))
        siblings = set(re.findall(r"`dadiff/(\w+)", names))
        direct = set(rows) if below.startswith("all above") else set(re.findall(r"\w+", below))
        direct -= set(re.findall(r"\w+", below.partition("but")[2]))
        direct &= set(rows)
        reached = direct.union(*(rows[room][0] for room in direct)) | siblings | OPEN
        rows |= {room: (reached, set(re.findall(r"\w+", parties))) for room in siblings}
    return rows


def imported(file: Path) -> set[str]:
    """Dotted names of what a file imports, at its top and inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_every_room_is_in_the_table():
    assert {room_of(file) for file in FILES.values()} == set(table())


@pytest.mark.parametrize("name", FILES)
def test_a_file_imports_only_what_its_room_may(name):
    room = room_of(FILES[name])
    rooms, parties = table().get(room, (set(), set()))
    for module in imported(FILES[name]):
        top, *rest = module.split(".")
        if top == "dadiff" and rest[0] != "__version__":
            assert rest[0] in rooms, f"{room} may not import {module}"
        elif top != "dadiff" and top not in sys.stdlib_module_names:
            assert top in parties, f"{room} may not import {module}"


def loaded_by(statement: str) -> set[str]:
    """Which heavy packages are loaded once a fresh interpreter has run a statement."""
    code = f"{statement}\nimport sys; print(*sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_light_rooms_load_nothing_heavy():
    light = (
        "trajectory",
        "systems",
        "experts.lqr",
        "tasks",
        "behaviours",
        "datasets",
        "diffusion.samplers",
        "evaluation",
    )
    light += ("store", "config", "running.identity", "tracking", "denoisers", "launching", "reporting.cli", "cli")
    assert loaded_by("import " + ", ".join(f"dadiff.{room}" for room in light)) == set()


def test_only_one_room_knows_the_order_of_states_and_inputs():
    """Elsewhere nobody computes n(T+1), the length of the states in a flat trajectory."""
    for name, file in FILES.items():
        if name != "dadiff/trajectory/layout.py":
            assert not re.search(r"state_dim \* \((self\.)?horizon \+ 1\)", file.read_text()), name


def test_nothing_catches_everything_or_asserts():
    for name, file in FILES.items():
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ExceptHandler):
                broad = node.type is None or (isinstance(node.type, ast.Name) and node.type.id == "BaseException")
                reraises = isinstance(node.body[-1], ast.Raise)
                assert not broad or reraises, f"{name}:{node.lineno} catches everything"
            if isinstance(node, ast.Assert):
                pytest.fail(f"{name}:{node.lineno} asserts; input errors are dadiff.errors types")

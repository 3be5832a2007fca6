"""Small faults for a source: operators, comparisons, numbers, conditions and signs, one changed at a time."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

ROOT = Path(__file__).parent.parent
SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.Lt: ast.LtE,
    ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or,
    ast.Or: ast.And,
}  # fmt: skip
OPPOSITES: dict[type, type] = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
"""For comparisons with a real number or a named threshold, of which a tie is no case."""

REAL = {"norm", "abs", "sqrt", "hypot"}
"""Functions whose values are real numbers."""

ROUNDING = 1e-5
"""Real numbers below it are what rounding is allowed, and may as well be twice that."""

SHAPES = ("reshape", "_like")
"""Calls of which shapes alone count: -2 says what -1 does, and an entry what any other does."""

HARMLESS = ("optimize", "strict")
"""Keywords that say how something is computed or checked, and not what."""


@dataclass(frozen=True)
class Fault:
    """One change inside a function.

    Args:
        place: of the changed node in the order of `ast.walk`.
        lines: of the simple statement, or of the head of the compound one, that it stands in.
        function: the lines of the function.
        compiled: whether it is machine code, which cannot be replaced in a running process.
    """

    file: Path
    place: int
    line: int
    lines: range
    function: range
    change: str
    compiled: bool

    @property
    def name(self) -> str:
        """File, line of code and change: what a reason is listed under."""
        code = self.file.read_text().splitlines()[self.line - 1].strip()
        return f"{self.file.relative_to(ROOT)} | {code} | {self.change}"

    def codes(self) -> dict[tuple[str, int], CodeType]:
        """(qualified name, first line) -> code of every function of the changed file."""
        tree = ast.parse(self.file.read_text())
        change(list(ast.walk(tree))[self.place])
        module = compile(ast.fix_missing_locations(tree), str(self.file), "exec")
        return {(code.co_qualname, code.co_firstlineno): code for code in _within(module)}


def change(node: ast.AST) -> str | None:
    """Change a node in place; returns what was done, None if there is nothing to change.

    The sign of a whole number is left alone: it counts from an end, which in a matrix is either end; another is tried.
    """
    if isinstance(node, (ast.BinOp, ast.BoolOp, ast.AugAssign)) and type(node.op) in SWAPS:
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div) and _rounds(node.left, node.right):
            return None
        before, node.op = type(node.op), SWAPS[type(node.op)]()
        return f"{before.__name__} -> {type(node.op).__name__}"
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        swaps = SWAPS | OPPOSITES if _real(node.left) or _real(node.comparators[0]) else SWAPS
        before, node.ops[0] = type(node.ops[0]), swaps[type(node.ops[0])]()
        return f"{before.__name__} -> {type(node.ops[0]).__name__}"
    if isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)) and not _rounds(node):
        before = node.value
        node.value = (not before) if isinstance(before, bool) else before + 1 if isinstance(before, int) else 2 * before
        return f"{before} -> {node.value}" if node.value != before else None
    if isinstance(node, (ast.If, ast.IfExp)):
        node.test = ast.UnaryOp(ast.Not(), node.test)
        return "condition -> not"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not _whole(node.operand):
        node.op = ast.UAdd()
        return "minus -> plus"
    return None


def _whole(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int)


def _real(node: ast.AST) -> bool:
    constants = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant))
    names = (part.id for part in ast.walk(node) if isinstance(part, ast.Name))
    called = {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}
    return any(isinstance(value, float) for value in constants) or any(map(str.isupper, names)) or bool(called & REAL)


def _rounds(*nodes: ast.AST) -> bool:
    values = (node.value for node in nodes if isinstance(node, ast.Constant))
    return any(isinstance(value, float) and 0 < abs(value) < ROUNDING for value in values)


def faults(file: Path) -> Iterator[Fault]:
    """All of a file's functions. Messages, types and defaults of parameters are left alone."""
    tree = ast.parse(file.read_text())
    places = {id(node): place for place, node in enumerate(ast.walk(tree))}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            compiled = any(isinstance(mark, ast.Name) and mark.id == "compiled" for mark in function.decorator_list)
            for node, lines in _read(function):
                if what := change(copy.deepcopy(node)):
                    line = getattr(node, "lineno", lines.start)
                    yield Fault(file, places[id(node)], line, lines, _lines(function), what, compiled)


def _read(function: ast.FunctionDef) -> Iterator[tuple[ast.AST, range]]:
    """Nodes of a function's body whose changes a test should find, and the lines of their statement."""
    todo: list[tuple[ast.AST, range]] = [(part, _head(part)) for part in function.body]
    while todo:
        node, lines = todo.pop()
        if isinstance(node, (ast.FunctionDef, ast.Raise, ast.JoinedStr)):
            continue  # a function within is visited as itself
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr.endswith(SHAPES):
            continue
        if isinstance(node, ast.keyword) and node.arg in HARMLESS:
            continue
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "check_fits":
            continue  # an estimate of memory is to be of the right order
        yield node, lines
        skipped = {id(node.annotation)} if isinstance(node, ast.AnnAssign) else set()
        for part in ast.iter_child_nodes(node):
            if id(part) not in skipped:
                todo.append((part, _head(part) if isinstance(part, ast.stmt) else lines))


def _head(node: ast.AST) -> range:
    """The lines of a statement without those that it holds."""
    body = getattr(node, "body", None)
    return range(node.lineno, body[0].lineno) if isinstance(body, list) else _lines(node)


def _lines(node: ast.AST) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)  # type: ignore[attr-defined]


def _within(code: CodeType) -> Iterator[CodeType]:
    for const in code.co_consts:
        if isinstance(const, CodeType):
            yield const
            yield from _within(const)

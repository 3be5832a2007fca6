"""Tables for the terminal."""

from __future__ import annotations

import io

from rich.console import Console
from rich.table import Table


def plain_table(first: str, *titles: str) -> Table:
    """A table without rules, whose first column gives way where the terminal is narrow."""
    table = Table(box=None, pad_edge=False, header_style="")
    table.add_column(first, overflow="fold", min_width=16)
    for title in titles:
        table.add_column(title, min_width=max(map(len, title.split())))
    return table


def text(table: Table) -> str:
    """As plain text, as wide as the terminal; 80 columns where there is none."""
    console = Console(file=io.StringIO(), highlight=False)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())

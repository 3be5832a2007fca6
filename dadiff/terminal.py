"""Tables for the terminal."""

from __future__ import annotations

import io

from rich.console import Console
from rich.table import Table


def plain_table(*titles: str) -> Table:
    """A table without rules, whose first column gives way last."""
    table = Table(box=None, pad_edge=False, header_style="")
    for title in titles:
        table.add_column(title, overflow="fold", min_width=20 if title == titles[0] and len(titles) > 1 else None)
    return table


def text(table: Table) -> str:
    """As plain text, as wide as the terminal; 80 columns where there is none."""
    console = Console(file=io.StringIO(), highlight=False)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())

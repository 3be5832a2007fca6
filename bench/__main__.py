"""All measurements, each beside a peer or a floor from the same run: `make bench`. Leave the machine alone meanwhile.

    python -m bench [--out FOLDER] [part ...]

Prints a table, and writes it with the figure to `bench.json`, `bench.md` and `bench.svg` in the folder (outputs). With
`--out docs` they are the ones that the documentation shows, and what it says of them is written anew, too.
`projections` and `waiting` are parts of their own, which only print what they find.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from bench.machine import described
from bench.rows import Row
from bench.show import draw, markdown, table
from dadiff import threads
from dadiff.reporting.publishing import fill_documents

PARTS = {  # part: threads; None leaves them to torch
    "learning": None,
    "planning": None,
    "optima": 1,
    "one_plan": 1,
    "projecting": 1,
    "nonlinear": 1,
    "overhead": None,
    "reports": None,
}
PRINTING = ("projections", "waiting")
"""One thread, but that which asks how many; a minute or more each."""

DOCS = Path(__file__).absolute().parent.parent / "docs"


def main() -> None:
    """Measure every part in a process of its own."""
    threads.settle()
    parser = argparse.ArgumentParser("python -m bench")
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS, *PRINTING], help="all but those that print")
    parser.add_argument("--out", type=Path, default=Path("outputs"), help="folder to write to (outputs)")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.part:
        print(json.dumps([asdict(row) for row in import_module(f"bench.{given.part}").measure()]))
        return
    measure(given.parts or list(PARTS), given.out)


def measure(parts: Sequence[str], folder: Path) -> None:
    """Print and write what the parts find."""
    machine, rows = described(), list[Row]()
    for part in parts:
        print(f"measuring: {part}", file=sys.stderr, flush=True)
        if part in PRINTING:
            subprocess.run([sys.executable, "-m", f"bench.{part}"], check=True, env=os.environ | threads.limits(1))
        else:
            rows += measured(part)
    folder.mkdir(exist_ok=True)
    shown = [asdict(row) | {"ratio": row.ratio} for row in rows]
    (folder / "bench.json").write_text(json.dumps({"machine": machine, "rows": shown}, indent=1) + "\n")
    (folder / "bench.md").write_text(markdown(rows, machine))
    draw(rows, folder / "bench.svg")
    if folder.absolute() == DOCS:
        fill_documents(DOCS.parent / "reports" / "published")
    print(f"{table(rows)}\n{machine}\nwritten to {folder}: bench.json, bench.md, bench.svg")


def measured(part: str) -> list[Row]:
    """One part's rows."""
    count = PARTS[part]
    environment = os.environ | (threads.limits(count) if count else {})
    command = [sys.executable, "-m", "bench", "--part", part]
    done = subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True)
    return [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]


if __name__ == "__main__":
    main()

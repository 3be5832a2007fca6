"""All measurements, each beside a peer or a floor from the same run: `make bench`. Leave the machine alone meanwhile.

    python -m bench [part ...]      # learning planning optima one_plan projecting overhead nonlinear projections

Prints a table, and writes `outputs/bench.json` and `outputs/bench.svg`.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from bench.rows import Row
from bench.show import draw, table
from dadiff import threads

PARTS = {  # part: threads; None leaves them to torch
    "learning": None,
    "planning": None,
    "optima": 1,
    "one_plan": 1,
    "projecting": 1,
    "overhead": None,
}
PRINTING = ("nonlinear", "projections")  # these print what they find; one thread
OUTPUTS = Path("outputs")


def main() -> None:
    """Measure every part in a process of its own."""
    threads.settle()
    if len(sys.argv) == 3 and sys.argv[1] == "--part":
        rows = import_module(f"bench.{sys.argv[2]}").measure()
        print(json.dumps([asdict(row) for row in rows]))
        return
    before, rows = os.getloadavg()[0], []
    for part in sys.argv[1:] or [*PARTS, *PRINTING]:
        print(f"measuring: {part}", file=sys.stderr, flush=True)
        if part in PRINTING:
            subprocess.run([sys.executable, "-m", f"bench.{part}"], check=True, env=os.environ | threads.limits(1))
        else:
            rows += measured(part)
    machine = {"cores": threads.cores(), "processor": platform.processor() or platform.machine(), "load_before": before}
    OUTPUTS.mkdir(exist_ok=True)
    shown = [asdict(row) | {"ratio": row.ratio} for row in rows]
    (OUTPUTS / "bench.json").write_text(json.dumps({"machine": machine, "rows": shown}, indent=1) + "\n")
    draw(rows, OUTPUTS / "bench.svg")
    print(table(rows))
    print(f"on {machine['cores']} cores, load {before:.1f} before; written to {OUTPUTS / 'bench.json'} and bench.svg")


def measured(part: str) -> list[Row]:
    """One part's rows."""
    count = PARTS[part]
    environment = os.environ | (threads.limits(count) if count else {})
    command = [sys.executable, "-m", "bench", "--part", part]
    done = subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True)
    return [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]


if __name__ == "__main__":
    main()

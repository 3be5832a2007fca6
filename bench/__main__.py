"""All measurements, one after the other: `make bench`. Leave the machine alone meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys

from dadiff import threads

PARTS = {  # module: threads; the batched solver's many small operations are slower with two
    "bench.sampling": None,
    "bench.training": None,
    "bench.obstacles": 1,
    "bench.fleet": 1,
    "bench.nonlinear": 1,
    "bench.projections": 1,
}


def main() -> None:
    """Run each part in a process of its own."""
    threads.settle()
    for module in sys.argv[1:] or PARTS:
        count = PARTS.get(module)
        environment = os.environ | (threads.limits(count) if count else {})
        print(f"--- {module}", flush=True)
        subprocess.run([sys.executable, "-m", module], check=True, env=environment)


if __name__ == "__main__":
    main()

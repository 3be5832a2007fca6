"""All measurements, one after the other: `make bench`. Leave the machine alone meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys

PARTS = {  # module: threads; the batched solver's many small operations are slower with two
    "bench.sampling": None,
    "bench.training": None,
    "bench.obstacles": 1,
    "bench.fleet": 1,
}


def main() -> None:
    """Run each part in a process of its own."""
    for module in sys.argv[1:] or PARTS:
        threads = PARTS.get(module)
        environment = os.environ | ({"OMP_NUM_THREADS": str(threads)} if threads else {})
        print(f"--- {module}", flush=True)
        subprocess.run([sys.executable, "-m", module], check=True, env=environment)


if __name__ == "__main__":
    main()

"""What a projection onto known dynamics costs by size: fitting it, binding it to a new x_init, applying it.

    python bench/projections.py            # about half a minute on two cores

Both forms are timed at every size, and the least time of each is taken: other work only adds.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from dadiff.behaviours import Dynamics, Pin, Stages, sets
from dadiff.trajectory import TrajectoryLayout

SIZES = ((4, 2, 30), (4, 2, 100), (4, 2, 300), (12, 4, 100), (40, 10, 100))
DENSE_FITS_UP_TO = 2000  # beyond, a fit takes many seconds


def least(function: Callable[[], object], repeats: int) -> float:
    """Milliseconds."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        function()
        times.append(time.perf_counter() - begun)
    return 1e3 * min(times)


def stages(state_dim: int, input_dim: int, horizon: int) -> Stages:
    """Of a random stable system."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((state_dim, state_dim))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    return Stages.constant(A, rng.standard_normal((state_dim, input_dim)), None, horizon)


def measure(state_dim: int, input_dim: int, horizon: int, kind: str) -> str:
    """One line."""
    dynamics, rng = stages(state_dim, input_dim, horizon), np.random.default_rng(1)
    layout = TrajectoryLayout(state_dim, input_dim, horizon)
    sets.DENSE_UP_TO = layout.size if kind == "dense" else 0
    x_init, plan, many = (rng.standard_normal((rows, layout.size)) for rows in (1, 1, 1000))
    pins = [Pin.initial_state(layout, x_init[:, :state_dim])]

    def fit() -> Dynamics:
        known = Dynamics(layout, dynamics)
        known.bind(pins=pins)(plan)
        return known

    known = fit()
    project = known.bind(pins=pins)
    fitted = least(fit, 2 if layout.size > 600 else 5)
    bound, one = least(lambda: known.bind(pins=pins), 20), least(lambda: project(plan), 20)
    residual = np.abs(dynamics.residual(layout, project(many))).max()
    return (
        f"n={state_dim:3} T={horizon:4} d={layout.size:5} {kind:6}  fit {fitted:8.1f}  bind {bound:5.2f}  "
        f"one plan {one:6.2f}  1000 plans {least(lambda: project(many), 3):7.1f} ms  residual {residual:.0e}"
    )


def main() -> None:
    """Print the figures."""
    for size in SIZES:
        for kind in ("dense", "blocks"):
            if kind == "blocks" or size[0] * (size[2] + 1) + size[1] * size[2] <= DENSE_FITS_UP_TO:
                print(measure(*size, kind), flush=True)


if __name__ == "__main__":
    main()

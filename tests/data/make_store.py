"""Writes the small store that the report's tests read: `python tests/data/make_store.py`.

Its numbers are made up. Vanilla has error 1, projections at every step 0.2 or so, projection once at the end 0.6; one
cell diverged, one failed, one was never run, and two resolved to the same configuration.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from made_up import MadeUp, chain_table, example_arrays

from dadiff.store import SweptRun

STORE = Path(__file__).parent / "store"
CONDITIONS = {"schedule": {"C1": True, "C2": True, "C3": True}}
TIMES = {"sampling_seconds": 2.0, "projection_seconds": 2e-5, "projection_calls": 200, "network_calls": 180}


def lqr() -> None:
    """Three training seeds, and the exact denoiser with the chain of Theorem 1."""
    store = MadeUp(STORE, "lqr_made_up")
    methods = {
        ("none", None): 1.0,
        ("known", "post_hoc"): 0.6,
        ("known", "normalised"): 0.2,
        ("hankel", "normalised"): 0.23,
        ("hankel_lowrank", "normalised"): 0.21,
    }
    for seed in range(3):
        for (projector, enforcement), level in methods.items():
            residual = {"dynamics_residual": 1e-28 if projector == "known" else 1e-4 * level}
            recording = {"recording__length": 100} if projector.startswith("hankel") else {}
            arrays = example_arrays(10, level) if seed == 0 else None
            store.run(level, levels=residual, metrics=TIMES, notes=CONDITIONS, projector=projector, seed=seed,
                      enforcement=enforcement, denoiser="mlp", arrays=arrays, **recording)  # fmt: skip
    store.run(projector="known", enforcement="literal", denoiser="mlp", status="diverged", step=7)
    store.run(
        projector="rollout",
        enforcement="normalised",
        denoiser="mlp",
        status="failed",
        reason="ran out of <memory> & $time$",
    )
    store.run(projector="identified", enforcement="normalised", denoiser="mlp", stored=False)
    exact = {"denoiser": "gaussian", "notes": CONDITIONS, "metrics": TIMES}
    store.run(0.1, projector="known", enforcement="normalised", chain=chain_table(40, grows=True), **exact)
    store.run(0.1, projector="none", chain=chain_table(40, grows=False), **exact)
    twin = next(cell for cell in store.cells if cell.axes["projector"] == "known")
    store.sweep(SweptRun(twin.key, "the same again", twin.axes))


def lengths() -> None:
    """Error against S: truncated gets better, as printed gets worse."""
    store = MadeUp(STORE, "hankel_length_made_up", cases=4, samples=2, horizon=6)
    store.run(1.0, projector="none", denoiser="gaussian", system__process_noise=0.01)
    store.run(0.1, projector="known", enforcement="normalised", denoiser="gaussian", system__process_noise=0.01)
    for length in (100, 300, 1000):
        for recording in range(3):
            for projector, level in (("hankel", 1 - 30 / length), ("hankel_lowrank", 0.1 + 10 / length)):
                store.run(level, projector=projector, enforcement="normalised", denoiser="gaussian",
                          recording__length=length, recording__seed=recording, system__process_noise=0.01,
                          recording__process_noise=0.01,
                          metrics={"principal_angle": level / 3, "projector_distance": level / 2})  # fmt: skip
    store.sweep()


def obstacles() -> None:
    """T = 40 with dips at t = 5 and t = 33."""
    store = MadeUp(STORE, "obstacles_made_up", cases=4, samples=2, horizon=40)
    t = np.arange(41)
    shape = (0.2 + t / 40) * (1 - 0.7 * np.isin(t, [5, 33]))
    for projector, level in (("none", 1.0), ("known", 0.2), ("hankel", 0.2)):
        store.run(level, shape=shape, task="obstacles", projector=projector, denoiser="mlp",
                  enforcement="normalised" if projector != "none" else None,
                  per_plan={"collision_rollout": 0.3 * level, "waypoint_distance_1_rollout": 0.2 * level},
                  arrays=example_arrays(40, level, obstacles=True))  # fmt: skip
    store.sweep()


def fleet() -> None:
    """Eight robots, each a few times easier or harder."""
    store = MadeUp(STORE, "fleet_made_up", cases=4, samples=1, horizon=6)
    robots = np.geomspace(0.3, 3, 8)
    arrays = {k: np.stack([v] * 3) for k, v in example_arrays(6, 0.5).items() if not k.startswith(("chain", "noised"))}
    arrays["robots"] = np.array([0, 3, 7])
    for enforcement, initial_state, level in (
        ("post_hoc", "free", 0.5),
        ("normalised", "free", 0.1),
        ("normalised", "fixed", 0.003),
    ):
        store.run(level, robots=robots, task="fleet", projector="known", enforcement=enforcement, denoiser="mlp",
                  initial_state=initial_state, arrays=arrays)  # fmt: skip
    store.run(5.0, robots=robots, task="fleet", projector="none", denoiser="mlp", arrays=arrays)
    store.sweep()


if __name__ == "__main__":
    shutil.rmtree(STORE, ignore_errors=True)
    for part in (lqr, lengths, obstacles, fleet):
        part()
    shutil.rmtree(STORE / "runs" / ".locks", ignore_errors=True)

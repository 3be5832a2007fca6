"""Made-up runs in the stored format, whose truth a test chooses: errors are a stated level times noise."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dadiff.store import Provenance, Record, Results, Sweep, Sweeps, SweptRun
from dadiff.tasks.environments import Environments, condition, encode

PER_STEP = ("planned_state_error", "planned_input_error", "rollout_state_error", "gap", "dynamics_residual")


class MadeUp:
    """A results folder that grows run by run, and the sweep that its runs belong to."""

    def __init__(self, folder: Path, name: str = "lqr_made_up", *, cases: int = 6, samples: int = 3, horizon: int = 10):
        self.folder, self.name, self.sizes = folder, name, (cases, samples)
        self.horizon, self.cells = horizon, []
        self.task = {"max_waypoints": 2} if name.startswith("obstacles") else {}

    def run(
        self,
        level: float = 1.0,
        *,
        status: str = "finished",
        levels: dict[str, float] | None = None,
        metrics: dict[str, float] | None = None,
        per_plan: dict[str, float] | None = None,
        shape: np.ndarray | None = None,
        robots: np.ndarray | None = None,
        spread: float = 0.1,
        chain: pd.DataFrame | None = None,
        arrays: dict[str, np.ndarray] | None = None,
        notes: dict[str, Any] | None = None,
        reason: str | None = None,
        step: int | None = None,
        stored: bool = True,
        **axes: Any,
    ) -> str:
        """One run; its key.

        Args:
            level: mean of every error; `levels` gives other ones by metric, `shape` (T+1,) varies them over time,
                `robots` (r,) over robots.
            axes: with __ for dots; `seed` also draws the cases' difficulty, which all runs of a seed share.
        """
        axes = {name.replace("__", "."): value for name, value in axes.items()}
        axes = {"task": "lqr", "projector": "none", "enforcement": None, "schedule": "paper_linear", "seed": 0, **axes}
        if axes["projector"] != "none":
            axes.setdefault("initial_state", "free")
        key = hashlib.sha256(json.dumps(axes, sort_keys=True).encode()).hexdigest()[:16]
        name = "/".join(str(axes[part]) for part in ("task", "projector", "enforcement", "seed"))
        self.cells.append(SweptRun(key, name, axes, status if stored else "waiting", reason))
        if not stored:
            return key
        record = self._record(key, name, status, axes, metrics or {}, notes or {}, reason, step, robots)
        tables = {"chain": chain} if chain is not None else {}
        if status == "finished":
            draw = Draw(self.sizes, self.horizon, int(axes["seed"]), key, spread, robots)
            if robots is not None:
                tables["robots"] = robot_table(len(robots))
            tables["per_step"] = draw.per_step({m: (levels or {}).get(m, level) for m in PER_STEP}, shape)
            tables["per_plan"] = draw.per_plan(
                {"initial_state_error": level, "cost_ratio": 1 + level, **(per_plan or {})}
            )
        Results(self.folder).write(record, tables=tables, arrays=arrays)
        return key

    def _record(self, key, name, status, axes, metrics, notes, reason, step, robots) -> Record:
        counts = {"cases": self.sizes[0], "samples": self.sizes[1]}
        links = {"cases": f"data{axes['seed']}", "denoiser": f"net{axes['seed']}"}
        if axes.get("denoiser") == "gaussian":
            del links["denoiser"]
        if "recording.length" in axes:
            links["recording"] = f"recording{axes.get('recording.seed', axes['seed'])}"
        return Record(
            key, name, status, reason, step, {"task": {"horizon": self.horizon, **self.task}, "axes": axes}, axes,
            metrics, notes, counts if robots is None else {**counts, "robots": len(robots)}, links,
            Provenance(seconds=1.0, device="cpu", commit="0123456789abcdef"),
        )  # fmt: skip

    def sweep(self, *extra: SweptRun) -> None:
        """Write the sweep's record."""
        command = f"dadiff +sweeps={self.name}"
        Sweeps(self.folder).write(Sweep(self.name, command, {"projector": "none,known"}, [*self.cells, *extra]))


class Draw:
    """Random tables: (robots, cases, samples, T+1) levels times lognormal noise, cases shared within a seed."""

    def __init__(
        self, sizes: tuple[int, int], horizon: int, seed: int, key: str, spread: float, robots: np.ndarray | None
    ):
        self.horizon, self.robots = horizon, robots
        scale = np.ones(1) if robots is None else robots
        difficulty = np.exp(0.5 * np.random.default_rng(seed).standard_normal(sizes[0]))
        noise = np.random.default_rng(int(key[:8], 16)).standard_normal((len(scale), *sizes, horizon + 1))
        self.factor = (scale[:, None, None] * difficulty[:, None])[..., None] * np.exp(spread * noise)

    def _table(self, columns: dict[str, np.ndarray], names: tuple[str, ...]) -> pd.DataFrame:
        shape = next(iter(columns.values())).shape
        index = dict(zip(names, np.indices(shape, dtype=np.int32).reshape(len(shape), -1), strict=True))
        if self.robots is None:
            del index["robot"]
        return pd.DataFrame({**index, **{k: v.ravel().astype(np.float32) for k, v in columns.items()}})

    def per_step(self, levels: dict[str, float], shape: np.ndarray | None) -> pd.DataFrame:
        """The table along time; inputs and residuals are nan at T."""
        curve = np.linspace(0.5, 1.5, self.horizon + 1) if shape is None else shape
        columns = {name: level * self.factor * curve for name, level in levels.items()}
        for name in ("planned_input_error", "dynamics_residual"):
            columns[name][..., -1] = np.nan
        return self._table(columns, ("robot", "case", "sample", "t"))

    def per_plan(self, levels: dict[str, float]) -> pd.DataFrame:
        """The table with one row a plan."""
        columns = {name: level * self.factor[..., 0] for name, level in levels.items()}
        for name in (name for name in levels if name.endswith("cost_ratio")):
            columns[name] = 1 + (levels[name] - 1) * self.factor[..., 0]
        return self._table(columns, ("robot", "case", "sample"))


def robot_table(count: int) -> pd.DataFrame:
    """The first half inside the training ranges, the others further and further outside."""
    distance = np.maximum(np.arange(count) - count // 2 + 1, 0) / count
    group = np.where(distance > 0, "extrapolation", "interpolation")
    return pd.DataFrame({"robot": np.arange(count), "group": group, "distance": distance})


def chain_table(steps: int, *, grows: bool) -> pd.DataFrame:
    """A falling distance, which at a third of the projections grows for some plans if it is said to."""
    i = np.arange(steps - 1, -1, -1)
    rows = {
        "i": np.repeat(i, 2),
        "stage": np.tile(["predict", "project"], steps),
        "on_support": np.repeat(50 + 1e4 * (i / steps) ** 2, 2),
        "off_support": np.repeat(1e-6 + (i / steps) ** 3, 2),
        "grew": np.where(np.arange(2 * steps) % 6 == 5, 0.4 * grows, 0.0),
    }
    table = pd.DataFrame(rows)
    growth = np.where(table["grew"] > 0, 5.0, -1.0)
    return table.assign(growth=growth, growth_error=0.5, step_growth=growth, step_growth_error=0.5)


def example_arrays(horizon: int, error: float, *, obstacles: bool = False) -> dict[str, np.ndarray]:
    """Smooth optima in the plane, plans that miss them by `error`, and a chain; E has obstacles if told to."""
    rng, cases, samples = np.random.default_rng(0), 2, 2
    t = np.linspace(0, 1, horizon + 1)
    start, target, bend = (width * rng.uniform(-1, 1, (cases, 1, 2)) for width in (1, 4, 2))
    positions = start + (target - start) * t[:, None] + bend * np.sin(np.pi * t)[:, None]
    states = np.concatenate([positions, np.gradient(positions, axis=1) * 10], axis=-1)
    wander = np.cumsum(rng.standard_normal((cases, samples, horizon + 1, 4)), axis=2) * np.sqrt(error / horizon)
    steps = np.array([0, 20, 50, 200])
    noise = rng.standard_normal((4, horizon + 1, 4))
    keep = np.exp(-((steps / 60) ** 2))[:, None, None]
    inputs = np.zeros((cases, samples, horizon, 2))
    E = _environment(states, horizon)
    if not obstacles:
        del E["waypoints"], E["obstacles"]
    return {
        "states": states[:, None] + wander,
        "rollout_states": states[:, None] + 1.5 * wander,
        "inputs": inputs,
        "reference_states": states,
        "reference_inputs": inputs[:, 0],
        **{f"environment_{name}": values for name, values in E.items()},
        "chain_steps": steps[::-1],
        "chain_states": (keep * states[0] + (1 - keep) * noise)[::-1],
        "noised_states": (keep * states[0] + (1 - keep) * noise)[::-1],
    }


def _environment(states: np.ndarray, horizon: int) -> dict[str, np.ndarray]:
    cases, times = len(states), np.array([horizon // 8, horizon - horizon // 6])
    middle = states[:, [horizon // 2, horizon // 3], :2]
    e = Environments(
        states[:, 0], states[:, -1, :2], states[:, times, :2], np.tile(times, (cases, 1)), np.ones((cases, 2), bool),
        middle + np.array([0.9, -0.7]), np.full((cases, 2), 0.5), np.ones((cases, 2), bool),
    )  # fmt: skip
    return condition(2, 2).unpack(encode(e, horizon))

"""What is kept of a run: long tables of scores, headline means, and what was seen along the chain."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from dadiff.tasks import Scores

if TYPE_CHECKING:
    from dadiff.diffusion.chain import Stage, Tensor

Distance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

SHOWN_SIGNAL = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)


def merged(*scores: Scores) -> Scores:
    """All scores in one."""
    parts = {field.name: [getattr(score, field.name) for score in scores] for field in fields(Scores)}
    return Scores(**{name: dict(ChainMap(*values)) for name, values in parts.items()})


def long_table(values: dict[str, np.ndarray], axes: tuple[str, ...]) -> pd.DataFrame:
    """Arrays of one shape as a table with a row an entry; `axes` names the last dimensions, robots come first."""
    shape = next(iter(values.values())).shape
    names = ("robot", *axes) if len(shape) > len(axes) else axes
    index = np.indices(shape, dtype=np.int32).reshape(len(shape), -1)
    columns = {name: column.ravel().astype(np.float32) for name, column in values.items()}
    return pd.DataFrame({**dict(zip(names, index, strict=True)), **columns})


def tables(scores: Scores) -> dict[str, pd.DataFrame]:
    """`per_step`, `per_plan` and the task's own tables."""
    return {
        **{name: pd.DataFrame(columns) for name, columns in scores.tables.items()},
        "per_step": long_table(scores.per_step, ("case", "sample", "t")),
        "per_plan": long_table(scores.per_plan, ("case", "sample")),
    }


def headline(scores: Scores) -> dict[str, float]:
    """The mean of every score over robots, cases, samples and time, leaving out where it is not defined."""
    defined = {name: v[~np.isnan(v)] for name, v in {**scores.per_step, **scores.per_plan}.items()}
    return {name: float(v.mean()) if v.size else float("nan") for name, v in defined.items()} | scores.headline


@dataclass
class ChainRecorder:
    """The Mahalanobis distance of Theorem 1 after each prediction and each projection, averaged over plans.

    Growth is that of the squared distance on the support over the half-step, its mean over the plans and the standard
    error of that mean; `step_growth` is that since the step before, so on a step's last row it is the whole step's.

    Args:
        distance: of plans (k, d) in physical units, on and off the support.
        plans: indices of the k plans that are followed.
        to_physical: from the sampler's coordinates.
    """

    distance: Distance
    plans: np.ndarray
    to_physical: Callable[[np.ndarray], np.ndarray]
    rows: list[dict[str, Any]] = field(default_factory=list)
    _seen: list[tuple[int, np.ndarray]] = field(default_factory=list)

    def __call__(self, j: int, stage: Stage, tau: Tensor) -> None:
        """Record one half-step that reached step j; the end is none."""
        if stage == "end":
            return
        on, off = self.distance(self.to_physical(tau[self.plans].cpu().numpy()))
        last = self._seen[-1][1] if self._seen else np.full_like(on, np.nan)
        step = next((seen for i, seen in reversed(self._seen) if i != j), np.full_like(on, np.nan))
        grew = float("nan") if not self._seen else float((on > last * (1 + 1e-9)).mean())
        row = {"i": j, "stage": stage, "on_support": on.mean(), "off_support": off.mean(), "grew": grew}
        self.rows.append(row | _growth("growth", on - last) | _growth("step_growth", on - step))
        self._seen = [*self._seen[-1:], (j, on)]

    def table(self) -> pd.DataFrame:
        """One row a half-step."""
        return pd.DataFrame(self.rows)


def _growth(name: str, change: np.ndarray) -> dict[str, float]:
    error = change.std(ddof=1) / np.sqrt(len(change)) if len(change) > 1 else float("nan")
    return {name: float(change.mean()), f"{name}_error": float(error)}


@dataclass
class Snapshots:
    """One plan at a few steps of the chain, chosen by how much signal is left, for the panel of Fig. 1.

    Args:
        alpha_bar: of the schedule, (L+1,).
        plan: which plan, as an index into the leading dimensions.
    """

    alpha_bar: np.ndarray
    plan: tuple[int, ...]
    taken: dict[int, np.ndarray] = field(default_factory=dict)
    _last: float = float("inf")

    @property
    def steps(self) -> list[int]:
        """The steps nearest to the shown shares of signal sqrt(alpha_bar)."""
        signal = np.sqrt(self.alpha_bar)
        return sorted({int(np.abs(signal - s).argmin()) for s in SHOWN_SIGNAL}, reverse=True)

    def __call__(self, j: int, stage: Stage, tau: Tensor) -> None:
        """Keep the plan after projection, at the first visited step at or below each shown one."""
        if stage != "predict":
            if j == 0 or any(j <= step < self._last for step in self.steps):
                self.taken[j] = tau[self.plan].cpu().numpy().copy()
            self._last = j

    def stacked(self) -> tuple[np.ndarray, np.ndarray]:
        """(steps, plans (k, d)), in the order of the chain."""
        return np.array(list(self.taken)), np.array(list(self.taken.values()))

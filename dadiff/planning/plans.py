"""Plans: what a planner gives, in physical units, with the names and units of their channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dadiff.errors import DataError
from dadiff.trajectory.layout import TrajectoryLayout

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Plans:
    """Planned trajectories.

    Args:
        layout: of tau.
        tau: (*robots, *cases, samples, d), physical units.
        network_calls: how often the denoiser was called.
        diverged_at: the diffusion step at which a value left its bound, or None; such plans mean nothing.
        unconverged: plans whose projection did not reach the set; 0 for closed forms.
        time_step: seconds between two states, where they are known.
    """

    layout: TrajectoryLayout
    tau: np.ndarray = field(repr=False)
    network_calls: int
    diverged_at: int | None = None
    unconverged: int = 0
    time_step: float | None = None

    @property
    def states(self) -> np.ndarray:
        """x(0:T), (*robots, *cases, samples, T+1, n)."""
        return self.layout.states(self.tau)

    @property
    def inputs(self) -> np.ndarray:
        """u(0:T-1), (*robots, *cases, samples, T, m)."""
        return self.layout.inputs(self.tau)

    def table(self) -> pd.DataFrame:
        """A row for each plan and time: `plan`, `t`, seconds where they are known, and a column for each channel.

        Inputs are nan at t = T, where there is none. Plans are counted over all leading dimensions.
        """
        import pandas as pd

        T = self.layout.horizon
        states = self.states.reshape(-1, T + 1, self.layout.state_dim)
        inputs = self.inputs.reshape(-1, T, self.layout.input_dim)
        inputs = np.concatenate([inputs, np.full((len(inputs), 1, self.layout.input_dim), np.nan)], axis=1)
        plan, t = (index.ravel() for index in np.indices(states.shape[:2]))
        columns: dict[str, np.ndarray] = {"plan": plan, "t": t}
        if self.time_step is not None:
            columns["seconds"] = t * self.time_step
        for name, values in (("x", states), ("u", inputs)):
            columns |= {c: values[..., k].ravel() for k, c in enumerate(self.columns(name))}
        return pd.DataFrame(columns)

    def columns(self, name: str) -> list[str]:
        """How the entries of a channel are called: `px (m)`, or `x0` where nothing is named."""
        channel = self.layout.channel(name)
        labels = channel.labels or tuple(f"{name}{k}" for k in range(channel.dim))
        units = channel.units or ("",) * channel.dim
        return [f"{label} ({unit})" if unit else label for label, unit in zip(labels, units, strict=True)]

    def save(self, path: str | Path) -> Path:
        """Write `.csv` (the table) or `.npz` (states, inputs).

        Raises:
            DataError: for another suffix, or if the place cannot be written to.
        """
        path = Path(path)
        writers: dict[str, Callable[[], None]] = {
            ".csv": lambda: self.table().to_csv(path, index=False),
            ".npz": lambda: np.savez(path, states=self.states, inputs=self.inputs),
        }
        if path.suffix not in writers:
            raise DataError(f"{path}: a plan is written as .csv or .npz; found '{path.suffix}'")
        try:
            writers[path.suffix]()
        except OSError as error:
            raise DataError(f"{path}: cannot be written ({error.strerror}); name another place") from error
        return path

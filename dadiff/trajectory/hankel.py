"""Hankel matrices of long experiments (Section III-B).

A recording of length S holds x(0:S) and u(0:S-1): S inputs and S + 1 states. Its Hankel matrix of depth T has
S - T + 1 columns, one a window: column j is the trajectory that starts at x(j). (The paper's bounds, u(0:S) with
columns up to u(S-T+1), are off by one against this.)
"""

from __future__ import annotations

import numpy as np

from dadiff.errors import ExcitationError
from dadiff.trajectory.layout import TrajectoryLayout


def windows(signal: np.ndarray, depth: int) -> np.ndarray:
    """All windows of a signal (..., S, k): shape (..., S - depth + 1, depth, k)."""
    return np.moveaxis(np.lib.stride_tricks.sliding_window_view(signal, depth, axis=-2), -1, -2)


def minimum_length(layout: TrajectoryLayout, count: int = 1, spare: int = 0) -> int:
    """The S from which `count` recordings give the n + mT columns that span the dynamics, and `spare` ones more."""
    return layout.horizon - 1 + -(-(layout.rank + spare) // count)


def identity_length(layout: TrajectoryLayout, count: int = 1, spare: int = 0) -> int:
    """The S from which noisy columns fill R^d, so that H H† is the identity: d columns, and those that are `spare`."""
    return layout.horizon - 1 + -(-(layout.size + spare) // count)


def trajectory_matrix(states: np.ndarray, inputs: np.ndarray, layout: TrajectoryLayout, spare: int = 0) -> np.ndarray:
    """H = [H_{T+1}(x); H_T(u)] of shape (*robots, d, count (S - T + 1)), eq. (10).

    Args:
        states: (*robots, count, S+1, n), nan after the end of one that is shorter; the windows of several recordings
            stand side by side.
        inputs: (*robots, count, S, m).
        spare: columns that are needed beside n + mT: one where an offset is estimated from them, too.

    Raises:
        ExcitationError: if there are fewer than n + mT columns, and those that are spare.
    """
    count, length = inputs.shape[-3], inputs.shape[-2]
    columns = _whole(layout, states, inputs) if length >= layout.horizon else np.empty((0, layout.size))
    if (found := columns.shape[-2]) < layout.rank + spare:
        needed = f"n + mT{f' + {spare}' if spare else ''} = {layout.rank + spare}"
        raise ExcitationError(
            f"recording: S = {length} is too short: {count} x {length} inputs give {found} windows of "
            f"T = {layout.horizon}; {needed} are needed: record S >= {minimum_length(layout, count, spare)}"
        )
    return columns.swapaxes(-1, -2)


def _whole(layout: TrajectoryLayout, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """The windows (*robots, columns, d) that do not reach beyond the end of their recording."""
    made = layout.flatten(windows(states, layout.horizon + 1), windows(inputs, layout.horizon))
    columns = made.reshape(*made.shape[:-3], -1, layout.size)
    ended = np.isnan(columns).any(axis=-1)
    return columns[~ended] if ended.ndim == 1 and ended.any() else columns

"""Do inputs excite a system? What is learned from them is only what they excited, whatever the noise suggests."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from dadiff.errors import ExcitationError

MOST_CONDITION = 1e3
"""Of inputs that excite: white ones have a few, a sine of 12 bits 5,000."""

LEAST_VARIED = 1e-3
"""Of the size of an input, its deviation: less is the last digit of a converter."""

LEAST_CHANGES = 3
"""How often an input must change before it is said to be held in between."""

log = logging.getLogger(__name__)


def check_excited(inputs: np.ndarray, order: int, where: str) -> float:
    """Whether inputs (count, S, m), nan after the end of a run, are persistently exciting. Returns their condition.

    That of the block Hankel matrix of `order` steps with channels about their mean and scaled to one size: white inputs
    have a few, a single sine as much as rounding allows. An input that is constant or trembles is none, in every
    precision.

    Raises:
        ExcitationError: naming the weakest channel, and the number.
    """
    m = inputs.shape[-1]
    size, varied = np.sqrt(np.nanmean(inputs**2, (0, 1))), np.nanstd(inputs, (0, 1))
    share = np.divide(varied, size, out=np.zeros(m), where=size > 0)
    weakest = int(share.argmin())
    if share[weakest] < LEAST_VARIED:
        said = f"varies by {share[weakest]:.2g} of its size only" if size[weakest] else "is always 0"
        raise ExcitationError(
            f"{where}: input {weakest} (of 0 to {m - 1}) {said}: it does not excite the system; "
            "let every input vary on its own"
        )
    moved = (inputs - np.nanmean(inputs, (0, 1))) / varied
    if inputs.shape[1] < order:
        return float("nan")
    windows = np.lib.stride_tricks.sliding_window_view(moved, order, axis=1)  # (count, windows, m, order)
    H = windows.reshape(-1, m * order)
    H = H[~np.isnan(H).any(axis=-1)]
    if len(H) < m * order:
        return float("nan")  # too short, as the projector will say
    _, s, V = np.linalg.svd(H, full_matrices=False)
    condition = float(s[0] / max(s[-1], 1e-300))
    if condition > MOST_CONDITION:
        weakest = int(np.square(V[-1]).reshape(m, order).sum(1).argmax())
        rank = int((s > s[0] / MOST_CONDITION).sum())
        raise ExcitationError(
            f"{where}: the inputs do not excite the system: over {order} steps they have rank {rank} of {m * order}; "
            f"their weakest direction has {1 / condition:.2g} of the strongest, mostly in input {weakest}; "
            "let every input vary on its own and at many frequencies"
        )
    return condition


def held_for(inputs: Sequence[np.ndarray]) -> int:
    """For how many samples each value of the inputs (S, m) of some runs is held, at least; 1 where it is not."""
    changes = [np.flatnonzero((np.diff(u, axis=0) != 0).any(-1)) for u in inputs]
    apart = np.concatenate([np.diff(at) for at in changes])
    return int(apart.min()) if len(apart) >= LEAST_CHANGES else 1


def tell_held(inputs: Sequence[np.ndarray], where: str) -> int:
    """Say where inputs are held over several samples: what happens between is not excited. Returns for how many."""
    if (samples := held_for(inputs)) > 1:
        log.warning(
            "%s: every value of the inputs is held for %d samples or more; what is learned knows nothing of faster "
            "inputs: take every %dth sample, with the system's time step as long, or record with faster ones",
            where,
            samples,
            samples,
        )
    return samples

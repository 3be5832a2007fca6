"""What a stored model says of itself: everything that must agree before its weights mean anything. Light: no torch."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import CheckpointError
from dadiff.trajectory import Layout, TrajectoryLayout

if TYPE_CHECKING:
    from dadiff.denoisers.recipes import Recipe

FORMAT = 1

Description = Mapping[str, int | float | str]


def describe(recipe: Recipe, layout: TrajectoryLayout, condition: Layout, schedule: Schedule) -> Description:
    """Flat, in the letters of the paper: n, m, T, c, L, a digest of beta, and the recipe with its fields."""
    return {
        "format": FORMAT,
        "n": layout.state_dim,
        "m": layout.input_dim,
        "T": layout.horizon,
        "c": condition.size,
        "L": schedule.num_steps,
        "beta": hashlib.sha256(schedule.beta.tobytes()).hexdigest()[:16],
        "recipe": type(recipe).__name__,
        **asdict(recipe),  # type: ignore[call-overload]
    }


def require_equal(found: Mapping[str, object], expected: Description, where: str) -> None:
    """Raise `CheckpointError` naming every entry in which a stored description differs."""
    differing = [
        f"{name} = {found.get(name, 'none')} (expected {expected.get(name, 'none')})"
        for name in dict.fromkeys((*expected, *found))
        if found.get(name) != expected.get(name)
    ]
    if differing:
        raise CheckpointError(
            f"{where}: made with {', '.join(differing)}; use the configuration that made it, or train anew"
        )

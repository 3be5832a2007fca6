"""Are measured trajectories those of a system? Their one-step residual over its process noise tells.

r(t) = x(t+1) - f(x(t), u(t)) has the standard deviation of the noise if they are, and several times that if anything
is wrong; `dadiff.datasets.causes` says what. Where the system is unknown, they are held against the affine dynamics
that fit all of them best, and the noise that most of their steps leave.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dadiff.datasets.causes import EVERYTHING, Seen, cause_of
from dadiff.datasets.logs import Run
from dadiff.errors import DataError
from dadiff.systems import System, Unknown
from dadiff.trajectory.subspace import regression

WARNED, REFUSED, WARNED_LEARNED = 2.0, 5.0, 1.5
"""Ratios of the residual to the noise: good recordings have 1.0, a trim 2.5, another sampling rate 6, a glitch 177.
Held against dynamics that were fitted to them, with their own noise, data are odd earlier."""

ROUNDING, STEP_SHARE = 1e-7, 1e-3
"""Of the size of a state and of its steps: what a residual is held against where no noise is configured."""

BY_CHANCE = 6.0
"""Standard deviations by which the ratio of a single trajectory may exceed 1: one of ten thousand does by five."""

MEDIAN_OF_NOISE = 0.6745
"""The median of |w| for w ~ N(0, 1)."""

log = logging.getLogger(__name__)


OFFSET_BY_CHANCE = 5.0
"""Standard deviations of its mean by which a residual's mean may differ from 0."""

TRIMS, FAR_OFF = 4, 6.0
"""How often dynamics are fitted anew without the steps that are so many deviations off: jumps, glitches, padding."""

BETTER = 0.7
"""What inputs that are shifted by a sample must leave at most to be mentioned, the states' geometric mean."""

SMALL = 1e-12

LONG_ENOUGH = 4
"""How many steps for each coefficient a run has on which dynamics are fitted alone."""


@dataclass(frozen=True)
class Plant:
    """One robot: what trajectories are held against.

    Args:
        step: (x (..., n), u (..., m)) -> x_next (..., n), times being the last dimension but one.
        noise: standard deviation of w(t), (n,); 0 where none is known.
        name: of what it is, for messages.
        learned: whether it was fitted to the data, so that no units and no order can be wrong.
    """

    step: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(repr=False)
    noise: np.ndarray
    name: str = "the configured system"
    learned: bool = False

    @classmethod
    def of(cls, system: System, robot: int | None = None) -> Plant:
        """A system, or one robot of a fleet."""
        noise = np.broadcast_to(np.asarray(system.process_noise, dtype=np.float64), (system.state_dim,))
        if robot is None:
            return cls(lambda x, u: system.step(x, u, np.arange(x.shape[-2])), noise)
        fleet = system.robots

        def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
            all_x, all_u = (np.broadcast_to(values, (*fleet, *values.shape)) for values in (x, u))
            return system.step(all_x, all_u, np.arange(x.shape[-2]))[robot]

        return cls(step, noise)

    @classmethod
    def identified(cls, runs: Sequence[Run], name: str = "one linear system, as identified from them") -> Plant:
        """x(t+1) = A x + B u + c that fits runs best, with the noise that most steps of most runs have on their own."""
        theta, c, _ = _fitted(runs)
        enough = LONG_ENOUGH * (len(theta) + 1)
        alone = [[run] for run in runs if len(run[1]) >= enough] or [list(runs)]
        noise = np.median([_noise_of(own) for own in alone], axis=0)
        return cls(lambda x, u: np.concatenate([x, u], axis=-1) @ theta + c, noise, name, learned=True)

    @property
    def warned(self) -> float:
        """The ratio from which trajectories are odd."""
        return WARNED_LEARNED if self.learned else WARNED

    def with_offset(self, runs: Sequence[Run]) -> Plant:
        """The same, with the constant offset that runs show."""
        c = np.concatenate([self.residual(x, u) for x, u in runs]).mean(axis=0)
        return replace(self, step=lambda x, u: self.step(x, u) + c)

    def residual(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """x(t+1) - f(x(t), u(t)), (..., S, n)."""
        return x[..., 1:, :] - self.step(x[..., :-1, :], u)


def _fitted(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[A B]', c and the residuals of all steps, by least squares of those steps that are not far off."""
    phi = np.concatenate([np.concatenate([x[:-1], u], axis=-1) for x, u in runs])
    following = np.concatenate([x[1:] for x, _ in runs])
    moving = (following != phi[:, : following.shape[-1]]).any(axis=-1)  # what only repeats is padding
    kept = moving if 2 * moving.sum() > len(moving) else np.ones(len(phi), dtype=bool)
    for _ in range(TRIMS):
        theta, c, _ = regression(following[kept], phi[kept])
        left = following - phi @ theta - c
        usual = np.median(np.abs(left), axis=0) / MEDIAN_OF_NOISE
        kept = (np.abs(left) <= FAR_OFF * usual + ROUNDING * np.abs(following).max(axis=0)).all(axis=-1)
    return theta, c, left


def _noise_of(runs: Sequence[Run]) -> np.ndarray:
    """The deviation of w(t) that most steps have under the dynamics that fit runs best, (n,)."""
    theta, _, left = _fitted(runs)
    freedom = max(1 - (len(theta) + 1) / len(left), 0.1)
    return np.median(np.abs(left), axis=0) / MEDIAN_OF_NOISE / np.sqrt(freedom)


def tell_shifted(runs: Sequence[Run], where: str) -> None:
    """Say where inputs of an unknown system fit much better one sample later or earlier."""
    usable = [(x, u) for x, u in runs if len(u) > 2]
    if not usable:
        return
    size = np.maximum(_noise_of(usable), SMALL)
    moves = {"later: a delay?": (1, 0), "earlier: are they shifted?": (0, 1)}
    for word, (first, last) in moves.items():
        moved = [(x[first : len(x) - last], u[last : len(u) - first]) for x, u in usable]
        rest = float(np.exp(np.mean(np.log(np.maximum(_noise_of(moved) / size, SMALL)))))
        if rest < BETTER:
            log.warning(
                "%s: with inputs that act one sample %s the residual is %.2g times as large: mend the data, or make "
                "the last input a state",
                where,
                word,
                rest,
            )


@dataclass(frozen=True)
class Mismatch:
    """How far measured steps are from those of a plant.

    Args:
        ratio: root mean square over steps and states of residual / noise; of a single trajectory, where one stands out.
        worst: (trajectory, t) of the largest residual.
        cause: what is likely wrong; empty if nothing that is known explains it.
    """

    ratio: float
    worst: tuple[int, int]
    cause: str


def plant_of(system: System, runs: Sequence[Run], robot: int | None = None) -> Plant:
    """What runs are held against: the system, or where it is unknown what fits them best."""
    return Plant.identified(runs) if isinstance(system, Unknown) else Plant.of(system, robot)


def tell_offset(plant: Plant, runs: Sequence[Run], where: str) -> tuple[Plant, float]:
    """The plant with the offset that runs show, and the ratio of residual to noise without it.

    Says so where the offset is more than noise leaves by chance.
    """
    r = np.concatenate([plant.residual(x, u) for x, u in runs])
    c, by_chance = r.mean(axis=0), r.std(axis=0) * OFFSET_BY_CHANCE / np.sqrt(len(r))
    ratio = max(mismatch(plant, x[None], u[None]).ratio for x, u in runs)
    if (np.abs(c) > by_chance).any():
        log.warning(
            "%s: the robot has an offset that %s has not, c = [%s]; without it the residual is %.3g times the noise: "
            "plans are made with the offset and scored without; give the system its c, or use system=unknown",
            where,
            plant.name,
            ", ".join(f"{value:.3g}" for value in c),
            ratio,
        )
    return plant.with_offset(runs), ratio


def judge(
    plant: Plant,
    states: np.ndarray,
    inputs: np.ndarray,
    where: str,
    allow_mismatch: bool,
    names: Sequence[str] = (),
    *,
    any_units: bool = False,
) -> float:
    """Hold trajectories against a plant. Returns the ratio of their residual to its noise.

    Args:
        states, inputs: (count, S+1, n) and (count, S, m).
        where: the file or folder that they are from.
        allow_mismatch: warn where it would be refused.
        names: of the trajectories, where they have any.
        any_units: warn where all that is wrong is one factor of states and inputs under dynamics without an offset:
            these are the same in all units.

    Raises:
        DataError: if the ratio is `REFUSED` or more, naming the file, the place and the likely cause.
    """
    found = mismatch(plant, states, inputs)
    if found.ratio < plant.warned:
        return found.ratio
    k, t = found.worst
    place = f"in {names[k]} at" if names else f"in trajectory {k} at" if len(states) > 1 else "at"
    told = (
        f"{where}: the data do not obey {plant.name}: x(t+1) - f(x(t), u(t)) is {found.ratio:.3g} times "
        f"{_held_against(plant, states, inputs)}, most {place} t = {t}{'; ' + found.cause if found.cause else ''}"
    )
    if any_units and found.cause.startswith(EVERYTHING) and _same_in_all_units(plant, states, inputs):
        told += "; dynamics without an offset are the same in all units, so they are learned from it as it is"
    elif found.ratio >= REFUSED and not allow_mismatch:
        raise DataError(f"{told}; mend the data or the system, or set allow_mismatch=true")
    log.warning("%s", told)
    return found.ratio


def _same_in_all_units(plant: Plant, states: np.ndarray, inputs: np.ndarray) -> bool:
    """Whether f(2 x, 2 u) is 2 f(x, u), and a noise is there to tell units by."""
    x, u = states[..., :-1, :], inputs
    return bool(
        (plant.noise > 0).all() and np.allclose(plant.step(2 * x, 2 * u), 2 * plant.step(x, u), rtol=ROUNDING, atol=0)
    )


def _held_against(plant: Plant, states: np.ndarray, inputs: np.ndarray) -> str:
    """The process noise; where none is configured, what it would be if the residual were noise."""
    if plant.learned or (plant.noise > 0).all():
        return "its process noise"
    found = ", ".join(f"{value:.2g}" for value in plant.residual(states, inputs).std(axis=(0, 1)))
    return f"{STEP_SHARE:g} of a step, as system.process_noise is 0 (if the residual is noise, set it to [{found}])"


def judge_runs(plant: Plant, runs: Sequence[Run], where: str, allow_mismatch: bool) -> float:
    """As `judge`, of runs of different lengths: the largest ratio."""
    named = [f"{where}, run {k}" if len(runs) > 1 else where for k in range(len(runs))]
    return max(
        judge(plant, x[None], u[None], name, allow_mismatch, any_units=True)
        for (x, u), name in zip(runs, named, strict=True)
    )


def mismatch(system: System | Plant, states: np.ndarray, inputs: np.ndarray) -> Mismatch:
    """The one-step residual of trajectories (count, S+1, n), (count, S, m) over the noise, and its cause."""
    plant = system if isinstance(system, Plant) else Plant.of(system)
    scale = scale_of(plant, states)
    r = plant.residual(states, inputs) / scale
    each = np.sqrt(np.mean(np.square(r), axis=(1, 2)))
    by_chance = 1 + BY_CHANCE / np.sqrt(2 * r[0].size)
    odd = np.flatnonzero(each > max(plant.warned, by_chance))
    overall = float(np.sqrt(np.mean(np.square(each))))
    ratio = max(overall, float(each.max())) if len(odd) else overall
    size = np.linalg.norm(r, axis=-1)
    k, t = (int(place) for place in np.unravel_index(int(size.argmax()), size.shape))
    shown = odd if len(odd) else np.arange(len(each))
    seen = Seen(plant.step, states[shown], inputs[shown], scale, plant.learned)
    cause = cause_of(seen) if ratio >= plant.warned else ""
    alone = len(odd) and len(odd) < len(each)
    apart = f"the other {len(each) - len(odd)} of {len(each)} trajectories obey it" if alone else ""
    return Mismatch(ratio, (k, t), "; ".join(filter(None, (cause, apart))))


def scale_of(plant: Plant, states: np.ndarray) -> np.ndarray:
    """What residuals are held against, (n,): the noise; where none is configured, a share of the steps."""
    steps = STEP_SHARE * np.sqrt(np.mean(np.diff(states, axis=1) ** 2, (0, 1)))
    rounding = ROUNDING * np.maximum(np.abs(states).max((0, 1)), 1e-9)
    return np.maximum(np.where(plant.noise > 0, plant.noise, steps), rounding)

"""Why measured steps are not those of a system: what fits the residual away names the cause.

A trim, another sampling rate, a sample of delay, glued episodes, a glitch, zeros for lost samples, another order or
units of states and inputs, actuators of another strength, and dynamics that are others altogether.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dadiff.trajectory.subspace import regression

EXPLAINED = 0.5
"""A cause is named if it takes away this share of the residual at least."""

SENTINELS = (-9999.0, -999.0, 9999.0, 999.0)

MOST_ORDERED, PART = 6, 200
"""States whose orders are all tried, on so many steps."""

FACTORS = {0.1: "deci", 0.01: "centi", 1e-3: "milli", 10.0: "deca", 100.0: "hecto", 1e3: "kilo",
           np.pi / 180: "degrees", 180 / np.pi: "radians"}  # fmt: skip
"""By what values may have to be multiplied, and what they are in then."""

EVERYTHING = "everything"
"""How the cause begins that is one factor of states and inputs."""

NOISE = (0.8, 1.3)
"""Ratios that noise leaves."""

ON_A_GRID = 1e-3
"""By what share of a step values may be off it."""

SAME_STRENGTH = 0.05
"""By how much the strength of an input may differ from 1 and be the same."""


@dataclass(frozen=True)
class Seen:
    """Trajectories, and the step that they are held against.

    Args:
        step: (x (..., n), u (..., m)) -> x_next (..., n).
        states, inputs: (count, S+1, n) and (count, S, m).
        scale: what residuals are held against, (n,).
        learned: whether the step was fitted to trajectories, so that units, order and offset are no question.
    """

    step: Callable[[np.ndarray, np.ndarray], np.ndarray] = field(repr=False)
    states: np.ndarray = field(repr=False)
    inputs: np.ndarray = field(repr=False)
    scale: np.ndarray
    learned: bool = False

    def left(self, states: np.ndarray, inputs: np.ndarray) -> float:
        """The ratio of residual to noise of these trajectories instead."""
        return _rms(replace(self, states=states, inputs=inputs).residual)

    @cached_property
    def residual(self) -> np.ndarray:
        """r / scale, (count, S, n)."""
        return (self.states[:, 1:] - self.step(self.states[:, :-1], self.inputs)) / self.scale

    @property
    def ratio(self) -> float:
        """Root mean square of the residual."""
        return _rms(self.residual)

    @property
    def enough(self) -> float:
        """What a cause must leave at most."""
        return min(max(EXPLAINED * self.ratio, 1.5), self.ratio)


def cause_of(seen: Seen) -> str:
    """The explanation that leaves the least residual, if it takes away enough; empty if none does.

    What is specific goes before what explains much in whatever is wrong: units of everything, dynamics of its own.
    """
    if lost := _lost_samples(seen):
        return lost
    specific = (_offset, _few_steps, _delay, _rate, _order, _units, _rounded)
    known = (specific, (_strength,), (_units_of_all,), (_own_dynamics,))
    for causes in ((_few_steps,), (_strength,), (_own_dynamics,)) if seen.learned else known:
        found = {word: rest for cause in causes for word, rest in cause(seen).items() if rest < seen.enough}
        if found:
            return min(found, key=lambda word: round(abs(np.log(max(found[word], 1e-9))), 1))
    return ""


def _rms(r: np.ndarray) -> float:
    return float(np.sqrt(np.mean(r**2)))


def _offset(seen: Seen) -> Mapping[str, float]:
    """A trim, gravity, an ambient temperature: the same residual at every step."""
    mean = seen.residual.mean((0, 1))
    words = f"a constant offset of {_listed(mean)} noises a step fits: a trim or an operating point?"
    return {f"{words} projector.offset=estimated learns it": _rms(seen.residual - mean)}


def _delay(seen: Seen) -> Mapping[str, float]:
    if seen.inputs.shape[1] < 3:
        return {}
    states, inputs = seen.states, seen.inputs
    return {
        "inputs that act one sample later fit: a delay?": seen.left(states[:, 1:], inputs[:, :-1]),
        "inputs that act one sample earlier fit: are they shifted?": seen.left(states[:, :-1], inputs[:, 1:]),
    }


def _rate(seen: Seen) -> Mapping[str, float]:
    """Steps k times as long as the system's."""
    model = (seen.step(seen.states[:, :-1], seen.inputs) - seen.states[:, :-1]) / seen.scale
    told = (seen.states[:, 1:] - seen.states[:, :-1]) / seen.scale
    k = float((model * told).sum() / max(float((model**2).sum()), 1e-300))
    return {f"steps {k:.3g} times as long fit: another sampling rate?": _rms(told - k * model)}


def _few_steps(seen: Seen) -> Mapping[str, float]:
    """Jumps at a few steps: resets between glued episodes, or single glitches, which come back at the next step."""
    size, n = np.linalg.norm(seen.residual, axis=-1), seen.states.shape[-1]
    order = np.sort(size.ravel())
    few = max(1, size.size // 20)
    rest = float(np.sqrt((order[:-few] ** 2).sum() / max(1, size.size - few) / n)) if size.size > few else 0.0
    _, steps = np.nonzero(size > 10 * max(rest, 1e-12) * np.sqrt(n))
    where = ", ".join(map(str, steps[:5])) + (", ..." if len(steps) > 5 else "")
    back = len(steps) > 1 and bool((np.diff(steps) == 1).any())
    kind = "single glitches?" if back else "glued episodes or resets? say where they end in episode_ends"
    return {f"all but the jumps at t = {where} fit: {kind}": rest} if len(steps) else {}


def _lost_samples(seen: Seen) -> str:
    """Rows in place of samples that were lost or never were; empty if they do not explain the residual."""
    states, r = seen.states, seen.residual
    empty = (states == 0).all(-1) | np.isin(states, SENTINELS).any(-1)
    empty[:, 0] &= ~(states[:, 0] == 0).all(-1)  # a start at rest is none
    same = np.flip(np.logical_and.accumulate(np.flip((np.diff(states, axis=1) == 0).all(-1), 1), axis=1), 1)
    repeated = np.pad(same, ((0, 0), (1, 0)))
    kinds = {
        "samples that are zero or a sentinel fit: lost samples?": empty,
        "samples at the ends, which repeat the one before, fit: padding?": repeated,
    }
    for word, lost in kinds.items():
        kept = r[~(lost[:, 1:] | lost[:, :-1])]
        if lost.any() and kept.size and _rms(kept) <= max(EXPLAINED * seen.ratio, 1.5):
            return f"all but {int(lost.sum())} {word}"
    return ""


def _order(seen: Seen) -> Mapping[str, float]:
    """The same states or inputs in another order."""
    states, inputs, found = seen.states, seen.inputs, dict[str, float]()
    n, m = states.shape[-1], inputs.shape[-1]
    if m == 2:
        found["inputs in the other order fit: another order of inputs?"] = seen.left(states, inputs[..., ::-1])
    if 1 < n <= MOST_ORDERED:
        x, u = states[:, : PART + 1], inputs[:, :PART]
        orders = [list(order) for order in itertools.permutations(range(n))][1:]
        best = min(orders, key=lambda order: seen.left(x[..., order], u))
        found[f"states in the order {best} fit: another order of states?"] = seen.left(states[..., best], inputs)
    return found


def _units(seen: Seen) -> Mapping[str, float]:
    """A state or an input in units that are 10, 100, 1000 or 57.3 times smaller or larger."""
    states, inputs, found = seen.states, seen.inputs, dict[str, float]()
    for factor, unit in FACTORS.items():
        taken = f"taken {factor:.4g} times fits: other units ({unit})?"
        for j in range(states.shape[-1]):
            found[f"state {j} {taken}"] = seen.left(_times(states, j, factor), inputs)
        for j in range(inputs.shape[-1]):
            found[f"input {j} {taken}"] = seen.left(states, _times(inputs, j, factor))
    return _as_noise(found)


def _units_of_all(seen: Seen) -> Mapping[str, float]:
    """All inputs, states or both in such units: said late, since smaller numbers leave less whatever is wrong."""
    states, inputs, found = seen.states, seen.inputs, dict[str, float]()
    for factor, unit in FACTORS.items():
        taken = f"taken {factor:.4g} times fits: other units ({unit})?"
        found[f"every input {taken}"] = seen.left(states, factor * inputs)
        found[f"every state {taken}"] = seen.left(factor * states, inputs)
        found[f"{EVERYTHING} {taken}"] = seen.left(factor * states, factor * inputs)
    return _as_noise(found)


def _rounded(seen: Seen) -> Mapping[str, float]:
    """States that are written down, or measured, in steps that are coarser than the noise."""
    values = seen.states.reshape(-1, seen.states.shape[-1])
    steps = np.array([_step_of(np.unique(column)) for column in values.T])
    if (steps < seen.scale).all():
        return {}
    rest = np.maximum(np.abs(seen.residual) - steps / seen.scale, 0)
    words = f"states that are rounded to steps of {_listed(steps)} explain it: record finer, or raise process_noise?"
    return {words: max(_rms(rest), 1.0)}


def _step_of(levels: np.ndarray) -> float:
    """The step of which sorted values are multiples; 0 if there is none."""
    step = float(np.diff(levels).min(initial=np.inf))
    counts = levels / step
    return step if np.isfinite(step) and np.abs(counts - np.round(counts)).max() < ON_A_GRID else 0.0


def _strength(seen: Seen) -> Mapping[str, float]:
    """Every input acting k times as strongly as the system says, each with its own k."""
    x, u, m = seen.states[:, :-1], seen.inputs, seen.inputs.shape[-1]
    rest = seen.step(x, 0 * u)
    acting = [(seen.step(x, u * (np.arange(m) == j)) - rest) / seen.scale for j in range(m)]
    target, columns = ((seen.states[:, 1:] - rest) / seen.scale).reshape(-1), [part.reshape(-1) for part in acting]
    k = np.linalg.lstsq(np.stack(columns, axis=-1), target, rcond=None)[0]
    if any(np.abs(k / factor - 1).max() < SAME_STRENGTH for factor in (1.0, *FACTORS)):
        return {}  # the units of all inputs
    left = _rms(target - np.stack(columns, axis=-1) @ k)
    words = f"inputs that act {_listed(k)} times as strongly fit: an actuator that was changed, or another robot?"
    return _as_noise({words: left})


def _own_dynamics(seen: Seen) -> Mapping[str, float]:
    """Affine dynamics of its own: the data are sound, and of something else."""
    n, m = seen.states.shape[-1], seen.inputs.shape[-1]
    phi = np.concatenate([seen.states[:, :-1], seen.inputs], axis=-1).reshape(-1, n + m)
    if len(phi) <= 2 * (n + m + 1):
        return {}
    _, _, left = regression(seen.states[:, 1:].reshape(-1, n), phi)
    words = "dynamics x(t+1) = A x + B u + c of their own fit: another robot or model, or a state that is missing?"
    return {words: _rms(left / seen.scale)}


def _as_noise(found: Mapping[str, float]) -> dict[str, float]:
    """Those that leave what is noise: smaller numbers leave less, and explain nothing."""
    return {word: rest for word, rest in found.items() if NOISE[0] < rest < NOISE[1]}


def _times(values: np.ndarray, j: int, factor: float) -> np.ndarray:
    scaled = values.copy()
    scaled[..., j] *= factor
    return scaled


def _listed(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2g}" for value in values) + ")"

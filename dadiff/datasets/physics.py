"""Are measured trajectories those of the configured system? Their one-step residual over its process noise tells.

r(t) = x(t+1) - f(x(t), u(t)) has the standard deviation of the noise if they are, and several times that if anything
is wrong: a trim, another sampling rate, a sample of delay, glued episodes, a glitch, zeros for lost samples. What
fits the residual away names the cause.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dadiff.errors import DataError, ExcitationError
from dadiff.systems import System

WARNED, REFUSED = 2.0, 5.0
"""Ratios of the residual to the noise: good recordings have 1.0, a trim 2.5, another sampling rate 6, a glitch 177."""

EXPLAINED = 0.5
"""A cause is named if it takes away this share of the residual at least."""

ROUNDING, STEP_SHARE = 1e-7, 1e-3
"""Of the size of a state and of its steps: what a residual is held against where no noise is configured."""

SENTINELS = (-9999.0, -999.0, 9999.0, 999.0)
MOST_CONDITION = 1e3
"""Of inputs that excite: white ones have a few, a sine of 12 bits 5,000."""

MOST_ORDERED, PART = 6, 200
"""States whose orders are all tried, on so many steps."""

FACTORS = [factor for size in (10.0, 100.0, 1000.0, 180 / np.pi) for factor in (size, 1 / size)]
NOISE = (0.8, 1.3)
"""Ratios that noise leaves."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Mismatch:
    """How far measured steps are from those of a system.

    Args:
        ratio: root mean square over steps and states of residual / noise.
        worst: (trajectory, t) of the largest residual.
        cause: what is likely wrong; empty if nothing that is known explains it.
    """

    ratio: float
    worst: tuple[int, int]
    cause: str


def judge(system: System, states: np.ndarray, inputs: np.ndarray, where: str, allow_mismatch: bool) -> float:
    """Hold trajectories against a system. Returns the ratio of their residual to its noise.

    Args:
        states, inputs: (count, S+1, n) and (count, S, m).
        where: the file or folder that they are from.
        allow_mismatch: warn where it would be refused.

    Raises:
        DataError: if the ratio is `REFUSED` or more, naming the file, the place and the likely cause.
    """
    found = mismatch(system, states, inputs)
    if found.ratio < WARNED:
        return found.ratio
    k, t = found.worst
    told = (
        f"{where}: the data do not obey the configured system: x(t+1) - f(x(t), u(t)) is {found.ratio:.3g} times "
        f"its process noise, most in trajectory {k} at t = {t}{'; ' + found.cause if found.cause else ''}"
    )
    if found.ratio >= REFUSED and not allow_mismatch:
        raise DataError(f"{told}; mend the data or the system, or set allow_mismatch=true")
    log.warning("%s", told)
    return found.ratio


def check_excited(inputs: np.ndarray, order: int, where: str) -> float:
    """Whether inputs (count, S, m) are persistently exciting of an order. Returns their condition.

    That of the block Hankel matrix of `order` steps with channels scaled to one size: white inputs have a few, an
    input that is constant, trembles or follows a single sine has as much as rounding allows, in every precision.

    Raises:
        ExcitationError: naming the weakest channel, and the number.
    """
    m = inputs.shape[-1]
    size = np.sqrt(np.mean(inputs**2, (0, 1)))
    if not size.all():
        raise ExcitationError(f"{where}: input {int(size.argmin())} is always 0; let every input vary on its own")
    windows = np.lib.stride_tricks.sliding_window_view(inputs / size, order, axis=1)  # (count, windows, m, order)
    H = windows.reshape(-1, m * order)
    if len(H) < m * order:
        return float("nan")  # too short, as the projector will say
    _, s, V = np.linalg.svd(H, full_matrices=False)
    condition = float(s[0] / max(s[-1], 1e-300))
    if condition > MOST_CONDITION:
        weakest = int(np.square(V[-1]).reshape(m, order).sum(1).argmax())
        raise ExcitationError(
            f"{where}: the inputs do not excite the system: over {order} steps their weakest direction has "
            f"{1 / condition:.2g} of the strongest, mostly in input {weakest}; let every input vary on its own and "
            "at many frequencies"
        )
    return condition


def mismatch(system: System, states: np.ndarray, inputs: np.ndarray) -> Mismatch:
    """The one-step residual of trajectories (count, S+1, n), (count, S, m) over the system's noise, and its cause."""
    scale = _scale(system, states)
    r = residual(system, states, inputs) / scale
    ratio = _rms(r)
    size = np.linalg.norm(r, axis=-1)
    worst = np.unravel_index(int(size.argmax()), size.shape)
    cause = _cause(system, states, inputs, scale, ratio) if ratio >= WARNED else ""
    return Mismatch(ratio, (int(worst[0]), int(worst[1])), cause)


def residual(system: System, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """x(t+1) - f(x(t), u(t)), (count, S, n)."""
    return states[:, 1:] - system.step(states[:, :-1], inputs)


def _scale(system: System, states: np.ndarray) -> np.ndarray:
    """What residuals are held against, (n,): the noise; where none is configured, a share of the steps."""
    noise = np.broadcast_to(np.asarray(system.process_noise, dtype=np.float64), (states.shape[-1],))
    steps = STEP_SHARE * np.sqrt(np.mean(np.diff(states, axis=1) ** 2, (0, 1)))
    rounding = ROUNDING * np.maximum(np.abs(states).max((0, 1)), 1e-9)
    return np.maximum(np.where(noise > 0, noise, steps), rounding)


def _rms(r: np.ndarray) -> float:
    return float(np.sqrt(np.mean(r**2)))


def _cause(system: System, states: np.ndarray, inputs: np.ndarray, scale: np.ndarray, ratio: float) -> str:
    """The explanation that leaves the least residual, if it takes away enough."""

    def left(x: np.ndarray, u: np.ndarray) -> float:
        return _rms(residual(system, x, u) / scale)

    r = residual(system, states, inputs) / scale
    if lost := _lost_samples(states, r, ratio):
        return lost
    found = {
        **_offset(r),
        **_few_steps(r),
        **_delay(states, inputs, left),
        **_rate(system, states, inputs, scale),
        **_order(states, inputs, left),
        **_units(states, inputs, left),
    }
    explaining = {word: rest for word, rest in found.items() if rest < min(max(EXPLAINED * ratio, 1.5), ratio)}
    explaining = explaining or dict(_units_of_all(states, inputs, left))
    return min(explaining, key=lambda word: round(abs(np.log(max(explaining[word], 1e-9))), 1), default="")


def _offset(r: np.ndarray) -> Mapping[str, float]:
    """A trim, gravity, an ambient temperature: the same residual at every step."""
    mean = r.mean((0, 1))
    return {f"a constant offset of {_listed(mean)} noises a step fits: a trim or an operating point?": _rms(r - mean)}


def _delay(states: np.ndarray, inputs: np.ndarray, left: Callable[..., float]) -> Mapping[str, float]:
    if inputs.shape[1] < 3:
        return {}
    return {
        "inputs that act one sample later fit: a delay?": left(states[:, 1:], inputs[:, :-1]),
        "inputs that act one sample earlier fit: are they shifted?": left(states[:, :-1], inputs[:, 1:]),
    }


def _rate(system: System, states: np.ndarray, inputs: np.ndarray, scale: np.ndarray) -> Mapping[str, float]:
    """Steps k times as long as the system's."""
    model = (system.step(states[:, :-1], inputs) - states[:, :-1]) / scale
    told = (states[:, 1:] - states[:, :-1]) / scale
    k = float((model * told).sum() / max(float((model**2).sum()), 1e-300))
    return {f"steps {k:.3g} times as long fit: another sampling rate?": _rms(told - k * model)}


def _few_steps(r: np.ndarray) -> Mapping[str, float]:
    """Jumps at a few steps: resets between glued episodes, or single glitches, which come back at the next step."""
    size = np.linalg.norm(r, axis=-1)
    order = np.sort(size.ravel())
    few = max(1, size.size // 20)
    rest = float(np.sqrt((order[:-few] ** 2).sum() / max(1, size.size - few) / r.shape[-1])) if size.size > few else 0.0
    _, steps = np.nonzero(size > 10 * max(rest, 1e-12) * np.sqrt(r.shape[-1]))
    where = ", ".join(map(str, steps[:5])) + (", ..." if len(steps) > 5 else "")
    back = len(steps) > 1 and bool((np.diff(steps) == 1).any())
    kind = "single glitches?" if back else "glued episodes or resets? say where they end in episode_ends"
    return {f"all but the jumps at t = {where} fit: {kind}": rest} if len(steps) else {}


def _lost_samples(states: np.ndarray, r: np.ndarray, ratio: float) -> str:
    """Rows in place of samples that were lost or never were; empty if they do not explain the residual."""
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
        if lost.any() and kept.size and _rms(kept) <= max(EXPLAINED * ratio, 1.5):
            return f"all but {int(lost.sum())} {word}"
    return ""


def _order(states: np.ndarray, inputs: np.ndarray, left: Callable[..., float]) -> Mapping[str, float]:
    """The same states or inputs in another order."""
    n, m, found = states.shape[-1], inputs.shape[-1], dict[str, float]()
    if m == 2:
        found["inputs in the other order fit: another order of inputs?"] = left(states, inputs[..., ::-1])
    if 1 < n <= MOST_ORDERED:
        x, u = states[:, : PART + 1], inputs[:, :PART]
        orders = [list(order) for order in itertools.permutations(range(n))][1:]
        best = min(orders, key=lambda order: left(x[..., order], u))
        found[f"states in the order {best} fit: another order of states?"] = left(states[..., best], inputs)
    return found


def _units(states: np.ndarray, inputs: np.ndarray, left: Callable[..., float]) -> Mapping[str, float]:
    """A state or an input in units that are 10, 100, 1000 or 57.3 times smaller or larger."""
    found: dict[str, float] = {}
    for factor in FACTORS:
        taken = f"taken {factor:.4g} times fits: other units?"
        for j in range(states.shape[-1]):
            found[f"state {j} {taken}"] = left(_times(states, j, factor), inputs)
        for j in range(inputs.shape[-1]):
            found[f"input {j} {taken}"] = left(states, _times(inputs, j, factor))
    return _as_noise(found)


def _units_of_all(states: np.ndarray, inputs: np.ndarray, left: Callable[..., float]) -> Mapping[str, float]:
    """All inputs, states or both in such units: said last, since smaller numbers leave less whatever is wrong."""
    found: dict[str, float] = {}
    for factor in FACTORS:
        taken = f"taken {factor:.4g} times fits: other units?"
        found[f"every input {taken}"] = left(states, factor * inputs)
        found[f"every state {taken}"] = left(factor * states, inputs)
        found[f"everything {taken}"] = left(factor * states, factor * inputs)
    return _as_noise(found)


def _as_noise(found: Mapping[str, float]) -> dict[str, float]:
    """Those that leave what is noise: smaller numbers leave less, and explain nothing."""
    return {word: rest for word, rest in found.items() if NOISE[0] < rest < NOISE[1]}


def _times(values: np.ndarray, j: int, factor: float) -> np.ndarray:
    scaled = values.copy()
    scaled[..., j] *= factor
    return scaled


def _listed(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2g}" for value in values) + ")"

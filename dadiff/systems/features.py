"""Dynamics that are linear in features: x(t+1) = x(t) + Theta phi(x, u), the model that regression learns.

phi is put together from terms, in this order; s(x) stands for the state features:

    identity        x and u
    trigonometric   sin and cos of chosen entries of x
    products        s_i s_j of the above, without the squares of cosines
    turning         each state that is no angle, times sin and cos: what rates do to an angle within a step
    control_affine  u_k times sin and cos where there are any, and times x otherwise
    constant        1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.nonlinear import affine
from dadiff.systems.system import System, Times

Term = Literal["constant", "identity", "trigonometric", "products", "turning", "control_affine"]


@dataclass(frozen=True)
class Features:
    """phi of x (..., n) and u (..., m), see the module.

    Args:
        states, inputs: n and m.
        terms: which ones.
        angles: indices of the states that sines and cosines are taken of.

    Raises:
        ConfigError: if the terms have no angles to act on, or the angles are no states.
    """

    states: int
    inputs: int
    terms: Sequence[Term] = ("constant", "identity")
    angles: Sequence[int] = ()

    def __post_init__(self) -> None:
        if ("trigonometric" in self.terms) != bool(len(self.angles)):
            raise ConfigError(
                f"features: terms are {', '.join(self.terms)} and angles {list(self.angles)}; trigonometric terms need "
                "the indices of the states that are angles, and only they do"
            )
        if "turning" in self.terms and "trigonometric" not in self.terms:
            raise ConfigError("features: turning multiplies sines and cosines; name trigonometric and the angles, too")
        if any(not 0 <= k < self.states for k in self.angles):
            raise ConfigError(f"features: angles are {list(self.angles)}; the states are 0 to {self.states - 1}")

    @property
    def count(self) -> int:
        """p."""
        return self(np.zeros(self.states), np.zeros(self.inputs)).shape[-1]

    @property
    def degrees(self) -> np.ndarray:
        """Of each feature, (p,): 0 of the constant, 1 of states, inputs, sines and cosines, 2 of products."""
        parts = self._parts(np.zeros(self.states), np.zeros(self.inputs))
        return np.concatenate([np.full(part.shape[-1], degree) for degree, part in parts])

    def __call__(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """phi, (..., p)."""
        return np.concatenate([part for _, part in self._parts(x, u)], axis=-1)

    def _parts(self, x: np.ndarray, u: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Terms of one degree each."""
        s = self._of_states(x)
        parts = [(1, s), (1, u)] if "identity" in self.terms else [(1, s)]
        if "products" in self.terms:
            i, j = self._pairs(s.shape[-1])
            parts.append((2, s[..., i] * s[..., j]))
        if "turning" in self.terms:
            parts.append((2, _outer(x[..., self._others], self._steering(s))))
        if "control_affine" in self.terms:
            parts.append((2, _outer(u, self._steering(s))))
        if "constant" in self.terms:
            parts.append((0, np.ones((*x.shape[:-1], 1))))
        return parts

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """dphi/dx (..., p, n) and dphi/du (..., p, m)."""
        s, ds, lead = self._of_states(x), self._states_jacobian(x), x.shape[:-1]
        n, m = self.states, self.inputs

        def none(rows: int, columns: int) -> np.ndarray:
            return np.zeros((*lead, rows, columns))

        blocks = [(ds, none(s.shape[-1], m))]
        if "identity" in self.terms:
            blocks.append((none(m, n), np.broadcast_to(np.eye(m), (*lead, m, m))))
        if "products" in self.terms:
            i, j = self._pairs(s.shape[-1])
            by_x = s[..., i, None] * ds[..., j, :] + s[..., j, None] * ds[..., i, :]
            blocks.append((by_x, none(len(i), m)))
        steering, slope = self._steering(s), self._steering(ds.swapaxes(-1, -2)).swapaxes(-1, -2)
        if "turning" in self.terms:
            still, rows = x[..., self._others], np.eye(n)[self._others]
            by_x = still[..., :, None, None] * slope[..., None, :, :] + rows[:, None, :] * steering[..., None, :, None]
            by_x = by_x.reshape(*lead, -1, n)
            blocks.append((by_x, none(by_x.shape[-2], m)))
        if "control_affine" in self.terms:
            by_x = (u[..., :, None, None] * slope[..., None, :, :]).reshape(*lead, -1, n)
            blocks.append((by_x, (np.eye(m)[:, None, :] * steering[..., None, :, None]).reshape(*lead, -1, m)))
        if "constant" in self.terms:
            blocks.append((none(1, n), none(1, m)))
        dx, du = zip(*blocks, strict=True)
        return np.concatenate(dx, axis=-2), np.concatenate(du, axis=-2)

    @property
    def _others(self) -> list[int]:
        """The states that are no angles."""
        return [k for k in range(self.states) if k not in self.angles]

    def _of_states(self, x: np.ndarray) -> np.ndarray:
        angles = x[..., list(self.angles)]
        own = [x] if "identity" in self.terms else []
        return np.concatenate([*own, np.sin(angles), np.cos(angles)], axis=-1)

    def _states_jacobian(self, x: np.ndarray) -> np.ndarray:
        """ds/dx, (..., q, n)."""
        unit = np.eye(self.states)
        angles, rows = x[..., list(self.angles)], unit[list(self.angles)]
        own = [np.broadcast_to(unit, (*x.shape[:-1], *unit.shape))] if "identity" in self.terms else []
        return np.concatenate([*own, np.cos(angles)[..., None] * rows, -np.sin(angles)[..., None] * rows], axis=-2)

    def _pairs(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Which of the state features are multiplied: all but cos with itself, since sin^2 + cos^2 = 1."""
        i, j = np.triu_indices(count)
        kept = (i != j) | (i < count - len(self.angles))
        return i[kept], j[kept]

    def _steering(self, s: np.ndarray) -> np.ndarray:
        """Of state features (..., q) those that inputs are multiplied by."""
        return s[..., -2 * len(self.angles) :] if len(self.angles) else s


def _outer(u: np.ndarray, s: np.ndarray) -> np.ndarray:
    """u_k s_l for all k and l, flat."""
    return (u[..., :, None] * s[..., None, :]).reshape(*u.shape[:-1], -1)


@dataclass(frozen=True)
class Regressed(System):
    """x(t+1) = x(t) + Theta phi(x(t), u(t)).

    Args:
        features: phi.
        theta: (*robots, n, p).

    Raises:
        ShapeError: if theta does not fit the features.
    """

    features: Features
    theta: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        if self.theta.ndim not in (2, 3) or self.theta.shape[-2:] != (self.features.states, self.features.count):
            raise ShapeError(
                f"system: theta has shape {self.theta.shape}; expected (*robots, {self.features.states}, "
                f"{self.features.count}) for these features"
            )
        self.check()

    @property
    def state_dim(self) -> int:
        """n."""
        return self.features.states

    @property
    def input_dim(self) -> int:
        """m."""
        return self.features.inputs

    @property
    def robots(self) -> tuple[int, ...]:
        """Of theta."""
        return self.theta.shape[:-2]

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """See the class."""
        phi = self.features(x, u)
        return x + (self._theta(phi.ndim) @ phi[..., None])[..., 0]

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `System.linearise`."""
        by_x, by_u = self.features.jacobian(x, u)
        theta = self._theta(x.ndim)
        return affine(np.eye(self.state_dim) + theta @ by_x, theta @ by_u, self.step(x, u), x, u)

    def take(self, index: Sequence[int] | np.ndarray) -> Regressed:
        """The robots at `index`."""
        return replace(self, theta=self.theta[index])

    def _theta(self, dimensions: int) -> np.ndarray:
        """theta beside points of so many dimensions: robots first."""
        between = (1,) * (dimensions - 1 - len(self.robots))
        return self.theta.reshape(*self.robots, *between, *self.theta.shape[-2:])

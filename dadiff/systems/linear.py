"""Linear systems x(t+1) = A x(t) + B u(t) + c + w(t), eq. (1) of the paper with an offset, and those that vary in time.

A fleet of 30 and a system that varies over 30 steps have arrays of the same shape. They are told apart by type and by
`robots`, never by shape: `Linear(A (R, n, n), ..., robots=R)` is the one, `TimeVarying(A (T, n, n), ...)` the other.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError, ShapeError
from dadiff.systems.system import System, Times, robots_of
from dadiff.systems.unknown import LEARNED, Unknown
from dadiff.trajectory.response import along, beside, simulate, trajectory_map


@dataclass(frozen=True)
class AffineSystem(System):
    """Whose step is x -> A_t x + B_t u + c_t.

    Args:
        A, B, c: see the subclasses; c=None is 0.
        robots: R where arrays have a first dimension of R robots, kept as (R,); () for a single system.

    Raises:
        ShapeError: if A is not square, B or c do not fit it, or their leading dimensions are not those of the type.
        ConfigError: if an entry is not finite.
    """

    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    c: np.ndarray = field(default=None, repr=False)  # type: ignore[arg-type]
    robots: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        A, B = stacked(self.A, "A"), stacked(self.B, "B")
        c = np.zeros(A.shape[:-1]) if self.c is None else stacked(self.c, "c")
        for name, value in (("A", A), ("B", B), ("c", c), ("robots", robots_of(self.robots))):
            object.__setattr__(self, name, value)
        self._check_dimensions()
        if A.shape[-1:] != A.shape[-2:-1] or B.shape[:-1] != A.shape[:-1] or c.shape != A.shape[:-1]:
            lead = "".join(f"{size}, " for size in A.shape[:-2])
            raise ShapeError(
                f"system: A has shape {A.shape}, B {B.shape} and c {c.shape}; "
                f"expected ({lead}n, n), ({lead}n, m) and ({lead}n)"
            )
        if not all(np.isfinite(M).all() for M in (A, B, c)):
            raise ConfigError("system: A, B or c holds a value that is not finite")
        self.check()

    @abstractmethod
    def _check_dimensions(self) -> None:
        """Raise unless A has the leading dimensions of this type."""

    @property
    def state_dim(self) -> int:
        """n."""
        return self.A.shape[-1]

    @property
    def input_dim(self) -> int:
        """m."""
        return self.B.shape[-1]

    @abstractmethod
    def at(self, t: Times) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A (*robots, *t.shape, n, n), B and c at times t, or without the dimensions of t where nothing varies."""

    @abstractmethod
    def matrices(self, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A (*robots, T, n, n), B (*robots, T, n, m) and c (*robots, T, n) for t = 0..T-1."""

    def trajectory_map(self, horizon: int) -> np.ndarray:
        """F of shape (*robots, d, n + mT), eq. (4)."""
        A, B, _ = self.matrices(horizon)
        return trajectory_map(A, B)

    def offset(self, horizon: int) -> np.ndarray:
        """The trajectory from rest without inputs, (*robots, d): tau = F [x(0); u(0:T-1)] + offset."""
        x_init, inputs = (np.zeros((*self.robots, *s)) for s in ((self.state_dim,), (horizon, self.input_dim)))
        return self.layout(horizon).flatten(self.simulate(x_init, inputs), inputs)


@dataclass(frozen=True)
class Linear(AffineSystem):
    """Time-invariant: one system, or a fleet of them.

    Args:
        A: (n, n), or (R, n, n) with robots=R.
        B: (n, m), or (R, n, m).
        c: (n,), or (R, n); None for 0.

    Example:
        >>> Linear([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], time_step=0.1).state_dim
        2
    """

    def _check_dimensions(self) -> None:
        if self.A.shape[:-2] != self.robots or len(self.robots) > 1 or self.A.ndim < 2:
            count = self.A.shape[0] if self.A.ndim else 0
            raise ShapeError(
                f"system: A has shape {self.A.shape}; a Linear system has (n, n), with robots=R (R, n, n), here robots "
                f"is {self.robots[0] if self.robots else None}; for {count} robots give robots={count}, "
                f"for matrices that vary over T = {count} steps use TimeVarying"
            )

    def take(self, index: Sequence[int] | np.ndarray) -> Self:
        """See `System.take`."""
        if not self.robots:
            return super().take(index)
        A, B, c = self.A[index], self.B[index], self.c[index]
        return replace(self, A=A, B=B, c=c, robots=A.shape[:1])

    def at(self, t: Times) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A, B and c, whatever the time."""
        return self.A, self.B, self.c

    def matrices(self, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for every step, without copies."""
        parts = ((self.A, 2), (self.B, 2), (self.c, 1))
        A, B, c = (np.broadcast_to(np.expand_dims(M, -1 - k), (*self.robots, horizon, *M.shape[-k:])) for M, k in parts)
        return A, B, c

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """A x + B u + c."""
        return along(self.A, x) + along(self.B, u) + beside(self.c, x)

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(A, B, c) at every point, without copies."""
        lead, ones = x.shape[:-1], (1,) * (x.ndim - 1 - len(self.robots))
        A, B, c = (
            np.broadcast_to(M.reshape(*self.robots, *ones, *M.shape[-k:]), (*lead, *M.shape[-k:]))
            for M, k in ((self.A, 2), (self.B, 2), (self.c, 1))
        )
        return A, B, c

    def simulate(self, x_init: np.ndarray, inputs: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """As `System.simulate`; what inputs and offset add is found for all steps at once."""
        if self.c.any():
            noise = beside(self.c, inputs) + (0.0 if noise is None else noise)
        return simulate(self.A, self.B, x_init, inputs, noise)


@dataclass(frozen=True)
class TimeVarying(AffineSystem):
    """A_t, B_t and c_t for t = 0..T-1: one system, or a fleet of them.

    Args:
        A: (T, n, n), or (R, T, n, n) with robots=R.
        B: (T, n, m), or (R, T, n, m).
        c: (T, n), or (R, T, n); None for 0.
    """

    @property
    def horizon(self) -> int:
        """T, for how many steps the matrices are given."""
        return self.A.shape[-3]

    def _check_dimensions(self) -> None:
        if self.A.shape[:-3] != self.robots or len(self.robots) > 1 or self.A.ndim < 3:
            raise ShapeError(
                f"system: A has shape {self.A.shape}; a TimeVarying system has (T, n, n), with robots=R (R, T, n, n), "
                f"here robots is {self.robots[0] if self.robots else None}; for a fleet whose matrices do not vary use "
                "Linear with robots=R"
            )

    def at(self, t: Times) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A, B and c at times t.

        Raises:
            ShapeError: for a time at which no matrices are given.
        """
        times, robots = np.asarray(t), (slice(None),) * len(self.robots)
        if times.size and not (times.min() >= 0 and times.max() < self.horizon):
            raise ShapeError(
                f"system: it is given for steps 0..{self.horizon - 1}, asked for step {int(times.max())}; "
                "give matrices for more steps or choose a shorter horizon"
            )
        index: tuple[slice | np.ndarray, ...] = (*robots, times)
        return self.A[index], self.B[index], self.c[index]

    def matrices(self, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Those of the first T steps."""
        return self.at(np.arange(horizon))

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """A_t x + B_t u + c_t."""
        A, B, c = self.at(t)
        if np.ndim(t) == 0:
            return along(A, x) + along(B, u) + beside(c, x)
        A, B, c = self.linearise(x, u, t)
        return (A @ x[..., None] + B @ u[..., None])[..., 0] + c

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(A_t, B_t, c_t) at every point, without copies but of the times."""
        lead, R, times = x.shape[:-1], len(self.robots), np.shape(t)
        ones = (1,) * (len(lead) - R - len(times))
        A, B, c = (
            np.broadcast_to(M.reshape(*self.robots, *ones, *times, *M.shape[-k:]), (*lead, *M.shape[-k:]))
            for M, k in zip(self.at(t), (2, 2, 1), strict=True)
        )
        return A, B, c


def require_affine(system: object, what: str) -> AffineSystem:
    """The system, if it is linear with an offset.

    Args:
        what: asks for it, for the message.

    Raises:
        ConfigError: if it is any other.
        NotApplicableError: if it is unknown.
    """
    if isinstance(system, Unknown):
        raise NotApplicableError(f"{what} needs the system, which is unknown; {LEARNED}")
    if not isinstance(system, AffineSystem):
        raise ConfigError(
            f"{what} needs a linear system, found {type(system).__name__}; use one that is Linear or TimeVarying"
        )
    return system


def stacked(matrices: object, name: str) -> np.ndarray:
    """One array from a matrix, an array of them, or a list of rows, or of one matrix a robot or a step."""
    shapes = {np.shape(M) for M in matrices} if isinstance(matrices, list | tuple) else set()
    if len(shapes) > 1:
        raise ShapeError(f"system: parts of {name} have shapes {sorted(shapes)}; rows, robots and steps must be alike")
    return np.asarray(matrices, dtype=np.float64)

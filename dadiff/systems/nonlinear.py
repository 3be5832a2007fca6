"""Nonlinear systems: a step function, or continuous dynamics and an integrator, and their Jacobians.

`Nonlinear` knows its derivatives: by the chain rule through the integrator from an analytic Jacobian, or by torch's
forward mode. `Simulated` asks only for steps and takes central differences. Both evaluate whole batches at once.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from dadiff.errors import ConfigError, ShapeError
from dadiff.systems.system import System, Times, robots_of

Integrator = Literal["none", "euler", "rk4"]
Function = Callable[[Any, Any], Any]
Jacobian = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

STAGES: dict[str, tuple[tuple[float, float], ...]] = {
    "euler": ((0.0, 1.0),),
    "rk4": ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)),
}
"""Of explicit Runge-Kutta methods whose stages look at the stage before only: (its share of h, weight in the step)."""


@dataclass(frozen=True, kw_only=True)
class Continuous(System):
    """dx/dt = f(x, u) with u held over a time step h, integrated explicitly.

    Args:
        integrator: rk4, or euler.
    """

    integrator: Literal["euler", "rk4"] = "rk4"

    def __post_init__(self) -> None:
        if self.time_step is None:
            raise ConfigError("system: continuous dynamics need a time_step (seconds), found none")
        if self.integrator not in STAGES:
            raise ConfigError(f"system: integrator is {self.integrator!r}; expected one of {', '.join(STAGES)}")
        self.check()

    @abstractmethod
    def derivative(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt, (*robots, ..., n)."""

    @abstractmethod
    def derivative_jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """df/dx (*robots, ..., n, n) and df/du (*robots, ..., n, m)."""

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """x + h sum_s w_s k_s with k_s = f(x + h a_s k_{s-1}, u)."""
        return integrate(self.derivative, x, u, self.time_step or 0.0, self.integrator)

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By the chain rule through the integrator's stages, see `System.linearise`."""
        from dadiff.systems.chain_rule import through_stages

        n, m, h, lead = self.state_dim, self.input_dim, self.time_step or 0.0, x.shape[:-1]
        shares, weights = h * np.array(STAGES[self.integrator]).T
        f_x, f_u = np.empty((len(shares), *lead, n, n)), np.empty((len(shares), *lead, n, m))
        k, following = np.zeros_like(x), x.copy()
        for s, (share, weight) in enumerate(zip(shares, weights, strict=True)):
            at = x + share * k
            f_x[s], f_u[s] = self.derivative_jacobian(at, u)
            k = self.derivative(at, u)
            following += weight * k
        A, B = through_stages(f_x.reshape(len(shares), -1, n, n), f_u.reshape(len(shares), -1, n, m), shares, weights)
        return affine(A.reshape(*lead, n, n), B.reshape(*lead, n, m), following, x, u)


def integrate(f: Function, x: Any, u: Any, h: float, integrator: Integrator) -> Any:
    """One step of dx/dt = f(x, u) over h seconds with u held; f itself for `none`. Numpy or torch."""
    if integrator == "none":
        return f(x, u)
    k, total = 0.0, x
    for share, weight in STAGES[integrator]:
        k = f(x + share * h * k, u)
        total = total + weight * h * k
    return total


def affine(
    A: np.ndarray, B: np.ndarray, following: np.ndarray, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, B, c) with c = f(x, u) - A x - B u."""
    c = following - (A @ x[..., None] + B @ u[..., None])[..., 0]
    return A, B, c


@dataclass(frozen=True)
class _Given(System):
    """A system by a function that the user gives, of stated sizes."""

    function: Function = field(repr=False)
    states: int
    inputs: int
    robots: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def state_dim(self) -> int:
        """n."""
        return self.states

    @property
    def input_dim(self) -> int:
        """m."""
        return self.inputs

    def _check_function(self) -> None:
        """Raise unless the function gives (*robots, ..., n) for a batch of zeros."""
        object.__setattr__(self, "robots", robots_of(self.robots))
        self.check()
        x, u = np.zeros((*self.robots, 3, self.states)), np.zeros((*self.robots, 3, self.inputs))
        if (found := self.step(x, u).shape) != x.shape:
            raise ShapeError(
                f"system: the function maps states {x.shape} and inputs {u.shape} to {found}; expected {x.shape}: it "
                "works on batches, with the entries of state and input along the last dimension"
            )


@dataclass(frozen=True)
class Nonlinear(_Given):
    """x(t+1) = f(x, u), or dx/dt = f(x, u) with an integrator, with exact derivatives.

    Args:
        function: f, on batches: (*robots, ..., n), (*robots, ..., m) -> (*robots, ..., n). In torch; in numpy where
            `jacobian` is given.
        states, inputs: n and m.
        integrator: `none` where f is the step itself; `rk4` or `euler` where it is dx/dt (then time_step is needed).
        jacobian: (x, u) -> (df/dx, df/du) of the *step*, in numpy; None differentiates f with torch's forward mode.
        robots: R where arrays have a first dimension of R robots.

    Example:
        >>> pendulum = Nonlinear(lambda x, u: torch.stack([x[..., 1], u[..., 0] - torch.sin(x[..., 0])], -1),
        ...                      2, 1, integrator="rk4", time_step=0.1)
    """

    integrator: Integrator = field(default="none", kw_only=True)
    jacobian: Jacobian | None = field(default=None, kw_only=True, repr=False)

    def __post_init__(self) -> None:
        if self.integrator != "none" and self.time_step is None:
            raise ConfigError(f"system: integrator {self.integrator} needs a time_step (seconds), found none")
        self._check_function()
        if self.jacobian is None:
            self._check_derivative()

    def _check_derivative(self) -> None:
        """Raise unless torch can differentiate the function, which it cannot where that leaves torch for numpy."""
        try:
            self.linearise(np.zeros((*self.robots, 3, self.states)), np.zeros((*self.robots, 3, self.inputs)))
        except (RuntimeError, TypeError, AttributeError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(
                f"system: torch cannot differentiate the function ({reason}); write it in torch, give jacobian=..., or "
                "use Simulated, which takes differences"
            ) from error

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """f(x, u), integrated over a time step where f is a rate."""
        if self.jacobian is not None:
            return self._move(x, u)
        import torch

        return np.asarray(self._move(torch.as_tensor(x), torch.as_tensor(u)))

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `System.linearise`."""
        if self.jacobian is not None:
            return affine(*self.jacobian(x, u), self._move(x, u), x, u)
        J, following = forward_jacobian(self._move, x, u)
        return affine(J[..., : self.states], J[..., self.states :], following, x, u)

    def _move(self, x: Any, u: Any) -> Any:
        return integrate(self.function, x, u, self.time_step or 0.0, self.integrator)


def forward_jacobian(f: Function, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[df/dx, df/du] (..., n, n + m) and f(x, u) (..., n) by torch's forward mode.

    Points do not see one another, so that one tangent for each of n + m directions serves the whole batch.
    """
    import torch

    point = torch.cat([torch.as_tensor(x), torch.as_tensor(u)], dim=-1)
    n = x.shape[-1]

    def joint(xu: torch.Tensor) -> torch.Tensor:
        return f(xu[..., :n], xu[..., n:])

    def along(direction: torch.Tensor) -> torch.Tensor:
        return torch.func.jvp(joint, (point,), (direction.expand_as(point),))[1]

    columns = torch.func.vmap(along, out_dims=-1)(torch.eye(point.shape[-1], dtype=point.dtype))
    return columns.numpy(), joint(point).numpy()


@dataclass(frozen=True)
class Simulated(_Given):
    """x(t+1) = f(x, u) from any simulator: central differences, 2 (n + m) calls on the whole batch a linearisation.

    Args:
        function: f in numpy, on batches: (*robots, ..., n), (*robots, ..., m) -> (*robots, ..., n).
        states, inputs: n and m.
        difference: step of the differences, relative to max(1, |entry|).
        robots: as for `Nonlinear`.
    """

    difference: float = field(default=1e-6, kw_only=True)

    def __post_init__(self) -> None:
        if not 0 < self.difference < 1:
            raise ConfigError(f"system: difference is {self.difference}; expected a small positive number")
        self._check_function()

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """f(x, u)."""
        return np.asarray(self.function(x, u), dtype=np.float64)

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(f(p + h e) - f(p - h e)) / 2h along every entry of p = [x; u], see `System.linearise`."""
        point, n = np.concatenate([x, u], axis=-1), x.shape[-1]
        h = self.difference * np.maximum(1.0, np.abs(point))
        J = np.empty((*x.shape, point.shape[-1]))
        for j in range(point.shape[-1]):
            ends = []
            for sign in (1.0, -1.0):
                moved = point.copy()
                moved[..., j] += sign * h[..., j]
                ends.append(self.step(moved[..., :n], moved[..., n:], t))
            J[..., j] = (ends[0] - ends[1]) / (2 * h[..., j, None])
        return affine(J[..., :n], J[..., n:], self.step(x, u, t), x, u)

"""`Bounded`: the trajectories of a linear system that keep within bounds on states and inputs.

    argmin |tau - tau_hat|^2_{W^-1}   s.t.  G tau = g,  low <= tau <= high,   W diagonal

has the dual solution tau = clip(tau_hat - W G' lambda), lambda the root of F(lambda) = G tau - g, which is the gradient
of the concave dual. Semismooth Newton takes it in a few steps, plan by plan: the Jacobian -G W D G', with D = 1 where
nothing is clipped, is block tridiagonal, and is factorised in O(T).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dadiff.behaviours.pins import Pin, Pinned
from dadiff.behaviours.projection import Projection, ProjectionInfo, check_shape
from dadiff.behaviours.sets import Dynamics
from dadiff.behaviours.stages import BlockTridiagonal, Stages
from dadiff.errors import ShapeError
from dadiff.systems.system import Bounds
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout

STEPS, HALVINGS = 60, 25
TOLERANCE = 1e-10
"""Of G tau - g, relative to 1 + max |tau|."""


@dataclass(frozen=True)
class Bounded:
    """The trajectories of `dynamics` whose entries keep within bounds.

    Args:
        dynamics: without bounds.
        low, high: (d,), in physical units, infinite where there is no bound.

    Raises:
        ShapeError: if there is not one bound for each entry.
    """

    dynamics: Dynamics
    low: np.ndarray = field(repr=False)
    high: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        if self.low.shape != (self.layout.size,) or self.high.shape != self.low.shape:
            raise ShapeError(
                f"projection: bounds have shapes {self.low.shape} and {self.high.shape}; expected ({self.layout.size},)"
            )

    @classmethod
    def by(cls, dynamics: Dynamics, bounds: Bounds) -> Bounded:
        """The bounds of a system, the same at all times."""
        layout = dynamics.layout
        states, inputs = bounds.of_states(layout.state_dim), bounds.of_inputs(layout.input_dim)
        steps = layout.horizon
        low, high = (
            layout.flatten(np.tile(x, (steps + 1, 1)), np.tile(u, (steps, 1)))
            for x, u in zip(states, inputs, strict=True)
        )
        return cls(dynamics, low, high)

    @property
    def layout(self) -> TrajectoryLayout:
        """Of the trajectories."""
        return self.dynamics.layout

    @property
    def notes(self) -> dict[str, float]:
        """Of the dynamics."""
        return self.dynamics.notes

    def bind(
        self, coordinates: Coordinates | None = None, pins: Sequence[Pin] = (), device: str | None = None
    ) -> BoxProjection:
        """The projection onto the set; it computes on the CPU, whatever the device. Pins hold beyond the bounds."""
        where = coordinates or physical(self.layout)
        return BoxProjection(self, where, Pinned.of(pins, self.layout, self.dynamics.robots), pins)


class BoxProjection(Projection):
    """The projection onto a `Bounded` set.

    In the metric of a covariance C, the dynamics are projected onto in C first, and what that gives is brought between
    the bounds in the metric of the variances of C.

    Args:
        target: the set.
        where: the coordinates.
        pinned, pins: of the plans.
    """

    def __init__(self, target: Bounded, where: Coordinates, pinned: Pinned, pins: Sequence[Pin]) -> None:
        self._set, self._where, self._pinned = target, where, pinned
        self._shape = (*target.dynamics.robots, target.layout.size)
        self._unbounded = target.dynamics.bind(where, pins)
        self.info = ProjectionInfo(self._unbounded.info.rank, "bounded")

    def __call__(
        self,
        tau: Array,
        metric: Covariance | None = None,
        start: Array | None = None,
        noise: Array | None = None,
    ) -> Array:
        """The nearest trajectory within the bounds; `info` says of how many plans there is none.

        Args:
            tau: (*robots, plans..., d), in the coordinates that the set was bound in.
            metric: C in those coordinates; None is the identity.
            start, noise: of no use here.
        """
        check_shape(tau, self._shape)
        if not isinstance(tau, np.ndarray):
            return tau.new_tensor(self(tau.detach().cpu().numpy(), metric))
        where, reached = self._where, tau if metric is None else self._unbounded(tau, metric)
        variances = np.ones(self._shape[-1]) if metric is None else _variances(metric)
        problem = self._problem(where.to_physical(reached), variances * where.scale**2)
        found, steps = problem.solve()
        missed = problem.missed(found)
        self.info = ProjectionInfo(
            self.info.rank, "bounded", steps, float(missed.max()), int((missed > problem.tolerance).sum())
        )
        return where.to_scaled(found.reshape(tau.shape))

    def on(self, device: str) -> BoxProjection:
        """Itself: it has nothing to move."""
        return self

    @property
    def affine(self) -> bool:
        """True: what is scaled may leave the bounds."""
        return True

    def _problem(self, tau_hat: np.ndarray, weights: np.ndarray) -> Box:
        """Every plan for itself, in physical units, with its robot's stages."""
        *robots, d = self._shape
        flat = tau_hat.reshape(*robots, -1, d)
        lead, places = flat.shape[:-1], self._pinned.places
        values = np.broadcast_to(self._pinned.values, (*lead, len(places)))
        low, high, W = (np.broadcast_to(bound, flat.shape).copy() for bound in (self._set.low, self._set.high, weights))
        low[..., places], high[..., places], W[..., places] = values, values, 0
        each = (np.broadcast_to(M[..., None, :, :, :], (*lead, *M.shape[-3:])) for M in self._matrices())
        A, B, c = (M.reshape(-1, *M.shape[len(lead) :]) for M in each)
        arrays = (M.reshape(-1, d) for M in (flat, W, low, high))
        return Box(self._set.layout, Stages(A, B, c[..., 0]), *arrays)

    def _matrices(self) -> tuple[np.ndarray, ...]:
        stages = self._set.dynamics.stages
        return stages.A, stages.B, stages.c[..., None]


def _variances(metric: Covariance) -> np.ndarray:
    """The diagonal of C, (*robots, 1, d)."""
    total = metric.diagonal + np.square(metric.factor).sum(axis=-1)
    return total[..., None, :]


@dataclass(frozen=True)
class Box:
    """The problem of many plans, each with stages and bounds of its own.

    Args:
        stages: of (plans,) robots.
        tau_hat, weights, low, high: (plans, d), in physical units; weight 0 where low = high.
    """

    layout: TrajectoryLayout
    stages: Stages
    tau_hat: np.ndarray = field(repr=False)
    weights: np.ndarray = field(repr=False)
    low: np.ndarray = field(repr=False)
    high: np.ndarray = field(repr=False)

    @property
    def tolerance(self) -> np.ndarray:
        """Of each plan, (plans,)."""
        return TOLERANCE * (1 + np.abs(self.tau_hat).max(axis=-1))

    def take(self, index: np.ndarray) -> Box:
        """Some of the plans."""
        arrays = (self.tau_hat[index], self.weights[index], self.low[index], self.high[index])
        return Box(self.layout, self.stages.take(index), *arrays)

    def primal(self, multipliers: np.ndarray) -> np.ndarray:
        """clip(tau_hat - W G' lambda) of lambda (plans, T, 1, n)."""
        pull = self.stages.adjoint(self.layout, multipliers)[:, 0]
        return np.clip(self.tau_hat - self.weights * pull, self.low, self.high)

    def gradient(self, tau: np.ndarray) -> np.ndarray:
        """G tau - g, (plans, T, 1, n)."""
        return self.stages.residual(self.layout, tau[:, None])

    def missed(self, tau: np.ndarray) -> np.ndarray:
        """max |G tau - g| of each plan, (plans,)."""
        return np.abs(self.gradient(tau)).max(axis=(-3, -2, -1))

    def dual(self, multipliers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The dual's value (plans,), the primal point and the gradient."""
        tau = self.primal(multipliers)
        F = self.gradient(tau)
        moved = np.square(tau - self.tau_hat)
        distance = np.divide(moved, self.weights, out=np.zeros_like(moved), where=self.weights > 0).sum(axis=-1)
        return distance / 2 + (multipliers * F).sum(axis=(-3, -2, -1)), tau, F

    def solve(self) -> tuple[np.ndarray, int]:
        """The primal points (plans, d), and the largest number of steps that a plan took."""
        multipliers = np.zeros((len(self.tau_hat), self.layout.horizon, 1, self.layout.state_dim))
        todo, steps = np.arange(len(self.tau_hat)), 0
        for steps in range(STEPS + 1):
            todo = todo[self.take(todo).missed(self.take(todo).primal(multipliers[todo])) > self.tolerance[todo]]
            if not len(todo) or steps == STEPS:
                break
            multipliers[todo] = self.take(todo).newton(multipliers[todo])
        return self.primal(multipliers), steps

    def newton(self, multipliers: np.ndarray) -> np.ndarray:
        """One Newton step on the dual, shortened until it rises."""
        value, tau, F = self.dual(multipliers)
        free = (tau > self.low) & (tau < self.high)
        size = np.abs(F).max(axis=(-3, -2, -1))
        scale = self.weights.max(axis=-1) * np.clip(1e-6 * size, 1e-12, 1e-6)  # vanishes with the residual
        factorised = BlockTridiagonal.of(self.stages, self.layout, self.weights * free, scale)
        step = factorised.solve(F)[0]
        slope = (step * F).sum(axis=(-3, -2, -1))
        length = np.ones(len(value))
        for _ in range(HALVINGS):
            risen = self.dual(multipliers + length[:, None, None, None] * step)[0]
            short = risen < value + 1e-4 * length * slope - 1e-13 * np.abs(value)
            if not short.any():
                break
            length[short] /= 2
        return multipliers + length[:, None, None, None] * step

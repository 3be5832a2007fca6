"""Robots in MuJoCo: the simulator's step as the dynamics, whole batches at once on several threads.

    x = [joint positions; joint velocities; activations],   u = [controls],   x(t+1) = frame_skip steps of the simulator

Each step starts without a memory of the one before (the constraint solver is started cold), so that it is a function
of x and u. Derivatives are forward differences: 1 + n + m steps a point, in one batched `mujoco.rollout`. Contacts and
joint limits make them steep, not wrong.
"""

from __future__ import annotations

import copy
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dadiff import threads
from dadiff.errors import ConfigError
from dadiff.outside import digest_of
from dadiff.systems import mjcf, rendering
from dadiff.systems.families import Family, Ranges, Robots
from dadiff.systems.mjcf import Mjcf
from dadiff.systems.nonlinear import affine
from dadiff.systems.system import Bounds, Limits, System, Times

if TYPE_CHECKING:
    from mujoco import MjData, MjModel
    from mujoco.rollout import Rollout

FACTORS = ("mass", "damping", "gear")
LARGEST = 1e8
"""Of a state or input: beyond it a trajectory has diverged, and is nan."""

ALONE = 64
"""Points that one thread steps sooner than several are woken."""


@dataclass(frozen=True, kw_only=True)
class MujocoRobot(System):
    """A MuJoCo model whose masses, dampings and gears are multiplied by factors.

    Args:
        mjcf: the model.
        frame_skip: steps of the simulator in a time step.
        difference: step of the forward differences, relative to max(1, |entry|).
        mass: factor of the masses and inertias of all bodies: a number, or (R,) for R robots, all alike.
        damping: of the damping of all joints, likewise.
        gear: of the gears of all actuators, likewise.

    Example:
        >>> mujoco_robot("reacher", joints=["joint0", "joint1"]).state_names
        ('joint0', 'joint1', 'joint0 velocity', 'joint1 velocity')
    """

    mjcf: Mjcf
    frame_skip: int = 2
    difference: float = 3e-8
    mass: float | np.ndarray = field(default=1.0, repr=False)
    damping: float | np.ndarray = field(default=1.0, repr=False)
    gear: float | np.ndarray = field(default=1.0, repr=False)

    def __post_init__(self) -> None:
        if self.frame_skip < 1 or not 0 < self.difference < 1:
            raise ConfigError(
                f"system: frame_skip is {self.frame_skip} and difference {self.difference}; expected at least 1, and a "
                "small positive number"
            )
        for name in FACTORS:
            if not (np.asarray(getattr(self, name)) > 0).all() or np.shape(getattr(self, name)) != self.robots:
                raise ConfigError(f"system: {name} is {getattr(self, name)}; factors are positive, one for each robot")
        self.check()

    @property
    def state_dim(self) -> int:
        """n."""
        return self._model.nq + self._model.nv + self._model.na

    @property
    def input_dim(self) -> int:
        """m."""
        return self._model.nu

    @property
    def robots(self) -> tuple[int, ...]:
        """(R,) where factors are arrays."""
        return np.shape(self.mass)

    def step(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> np.ndarray:
        """The simulator, frame_skip times; nan where a state or input is not finite or beyond `LARGEST`."""
        lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        points = np.concatenate([np.broadcast_to(part, (*lead, part.shape[-1])) for part in (x, u)], axis=-1)
        return self._stepped(points.reshape(-1, points.shape[-1])).reshape(*lead, self.state_dim)

    def linearise(self, x: np.ndarray, u: np.ndarray, t: Times = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(f(p + h e) - f(p)) / h along every entry of p = [x; u], see `System.linearise`."""
        lead, n, size = x.shape[:-1], self.state_dim, self.state_dim + self.input_dim
        point = np.concatenate([x, u], axis=-1).reshape(-1, 1, size)
        h = self.difference * np.maximum(1.0, np.abs(point))
        moved = point + np.concatenate([np.zeros((1, size)), np.eye(size)]) * h
        following = self._stepped(moved.reshape(-1, size)).reshape(len(point), size + 1, n)
        J = (following[:, 1:] - following[:, :1]).swapaxes(-1, -2) / h
        J = J.reshape(*lead, n, size)
        return affine(J[..., :n], J[..., n:], following[:, 0].reshape(*lead, n), x, u)

    def outline(self, states: np.ndarray) -> np.ndarray:
        """See `dadiff.systems.rendering`."""
        points = rendering.outline(self._model, states.reshape(-1, self.state_dim))
        return points.reshape(*states.shape[:-1], *points.shape[1:])

    def position(self, states: np.ndarray) -> np.ndarray:
        """The end of its outline."""
        return self.outline(states)[..., -1, :]

    @property
    def plane(self) -> tuple[str, ...]:
        """Two axes of the world."""
        return tuple(f"{rendering.WORLD[k]} [m]" for k in rendering.plane_of(self._model))

    def frames(self, states: np.ndarray) -> np.ndarray | None:
        """Rendered where EGL or OSMesa is installed."""
        return rendering.frames(self._model, states)

    def _stepped(self, points: np.ndarray) -> np.ndarray:
        """States (N, n) after [x; u] (N, n + m), the robots one after the other."""
        n = self.state_dim
        there = np.isfinite(points).all(axis=-1) & (np.abs(points) <= LARGEST).all(axis=-1)
        followed = np.full((len(points), n), np.nan)
        if there.any():
            owner = np.repeat(np.arange(len(self._models)), len(points) // len(self._models))[there]
            followed[there] = self._rolled_out([self._models[k] for k in owner.tolist()], points[there])
        return followed

    def _rolled_out(self, models: list[MjModel], points: np.ndarray) -> np.ndarray:
        n = self.state_dim
        states = np.concatenate([np.zeros((len(points), 1)), points[:, :n]], axis=-1)  # time comes first
        inputs = np.repeat(points[:, None, n:], self.frame_skip, axis=1)
        workers = threads.own() if len(points) > ALONE else 1
        workers = workers if workers > 1 else 0  # which is the calling thread itself
        with self._memory.lent(self._model, workers) as data:
            reached, _ = _pool(os.getpid(), workers).rollout(models, data, states, inputs)
        return reached[:, -1, 1:]

    @cached_property
    def _model(self) -> MjModel:
        return self.mjcf.compiled()

    @cached_property
    def _models(self) -> list[MjModel]:
        """One for each robot."""
        factors = (np.atleast_1d(getattr(self, name)).tolist() for name in FACTORS)
        return [varied(self._model, *values) for values in zip(*factors, strict=True)]

    @cached_property
    def _memory(self) -> _Memory:
        return _Memory()

    def __getstate__(self) -> dict[str, Any]:
        """Its fields: the simulator is made anew wherever it is sent."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def varied(model: MjModel, mass: float, damping: float, gear: float) -> MjModel:
    """A copy whose masses and inertias, dampings and gears are multiplied."""
    own, package = copy.copy(model), mjcf.mujoco()
    own.body_mass *= mass
    own.body_inertia *= mass
    own.dof_damping *= damping
    own.actuator_gear *= gear
    package.mj_setConst(own, package.MjData(own))
    return own


class _Memory:
    """The simulator's working memory, one for each thread, for one caller at a time."""

    def __init__(self) -> None:
        self._kept: list[MjData] = []
        self._lock = threading.Lock()

    @contextmanager
    def lent(self, model: MjModel, workers: int) -> Iterator[list[MjData]]:
        """As many as there are threads, at least one."""
        with self._lock:
            while len(self._kept) < max(1, workers):
                self._kept.append(mjcf.mujoco().MjData(model))
            yield self._kept[: max(1, workers)]


@lru_cache(maxsize=4)
def _pool(process: int, workers: int) -> Rollout:
    """The threads that step the simulator; a forked process has its own."""
    from mujoco.rollout import Rollout

    return Rollout(nthread=workers)


def mujoco_robot(
    path: str,
    joints: Sequence[str] = (),
    frame_skip: int = 2,
    process_noise: float | Sequence[float] = 0.0,
    bounds: Limits | None = None,
) -> MujocoRobot:
    """A single robot as its model is written.

    Args:
        path: a model of gymnasium's wheel by its name, or the path of an MJCF file.
        joints: those that move; the others become rigid. None stands for all.
        frame_skip: steps of the simulator in a time step.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: in place of the model's ranges: any of input_low, input_high, state_low, state_high.

    Raises:
        ConfigError, DataError: if there is no such model, or it is not taken; see `dadiff.systems.mjcf`.
        MissingExtraError: if mujoco is not installed.
    """
    model = mjcf.read(path, joints)
    return MujocoRobot(
        mjcf=model, frame_skip=frame_skip, process_noise=process_noise, **_description(model, frame_skip, bounds)
    )


def _description(model: Mjcf, frame_skip: int, bounds: Limits | None) -> dict[str, Any]:
    """Time step, bounds, names and units, as the model has them."""
    compiled = model.compiled()
    own, given = mjcf.bounds_of(compiled), Bounds.of(bounds)
    merged = replace(own, **{name: getattr(given, name) for name in bounds or {}})
    return {"time_step": frame_skip * compiled.opt.timestep, "bounds": merged, **mjcf.described(compiled)}


@dataclass(frozen=True, kw_only=True)
class MujocoRobots(MujocoRobot, Robots):
    """A fleet of one model, see `MujocoRobot`."""

    def _taken(self, index: Sequence[int] | np.ndarray) -> dict[str, Any]:
        return {name: getattr(self, name)[index] for name in FACTORS}


@dataclass(frozen=True)
class MujocoFamily(Family[MujocoRobots]):
    """Robots of one MuJoCo model that differ in mass, damping and gear; see `MujocoRobot`.

    Args:
        path: a model of gymnasium's wheel by its name, or the path of an MJCF file.
        joints: those that move; the others become rigid. None stands for all.
        frame_skip: steps of the simulator in a time step.
        mass, damping, gear: ranges of the factors, positive; equal bounds hold one fixed.
        process_noise: standard deviation of w(t) per step, a number or one for each state.
        bounds: in place of the model's ranges: any of input_low, input_high, state_low, state_high.
    """

    path: str
    joints: Sequence[str] = ()
    frame_skip: int = 2
    mass: Sequence[float] = (1.0, 1.0)
    damping: Sequence[float] = (1.0, 1.0)
    gear: Sequence[float] = (1.0, 1.0)
    process_noise: float | Sequence[float] = 0.0
    bounds: Limits | None = None

    state_names: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if any(bounds[0] <= 0 for bounds in self.ranges.bounds.values()) or self.frame_skip < 1:
            raise ConfigError(
                f"system: the ranges are {dict(self.ranges.bounds)} and frame_skip is {self.frame_skip}; factors are "
                "positive, and at least one step of the simulator is taken"
            )

    @property
    def ranges(self) -> Ranges:
        """Of the factors."""
        return Ranges({name: getattr(self, name) for name in FACTORS})

    @cached_property
    def _model(self) -> Mjcf:
        return mjcf.read(self.path, self.joints)

    def fingerprint(self) -> str:
        """A hash of the model's files, wherever they lie."""
        return digest_of(mjcf.files_of(self.path))

    def robots(self, values: np.ndarray) -> MujocoRobots:
        """The robots with factors (robots, 3)."""
        named: dict[str, Any] = self.named(values)
        return MujocoRobots(
            mjcf=self._model,
            frame_skip=self.frame_skip,
            process_noise=self.process_noise,
            parameters=named,
            distance=self.ranges.distance(values),
            family=self,
            **named,
            **_description(self._model, self.frame_skip, self.bounds),
        )

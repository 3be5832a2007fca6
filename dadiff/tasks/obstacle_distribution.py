"""From where environments of the obstacle task are drawn, so that obstacles are mostly in the way.

Waypoints due early lie where the initial velocity leads, late ones around the target; discs lie on the
obstacle-free optimum with some probability, else anywhere in the box. Centres are redrawn until they leave room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dadiff.errors import InfeasibleError
from dadiff.tasks.environments import Environments, join

_DRIFT = 0.75  # metres around p_0 + t v_0 for early waypoints
ANNULUS = (0.5, 2.0)  # metres from the target for late waypoints
_ASIDE = 0.35  # metres, deviation along the path's normal of discs put on it
_CLEAR_OF_POINTS, _CLEAR_OF_DISCS = 0.15, 0.3  # metres beyond the (inflated) radii
_REDRAWS, _ROUNDS = 100, 20  # of one centre; of environments that found no place for one


@dataclass(frozen=True)
class ObstacleDistribution:
    """Where environments come from.

    Args:
        horizon: T.
        time_step: in seconds.
        times: when waypoints are due, in steps, ascending.
        slots: waypoint and obstacle slots, (W, O); at least as many as are used.
        obstacles: fewest and most obstacles.
        radius: smallest and largest, in metres.
        start: x_init ~ U[-start, start]^4.
        box: target and discs in U[-box, box]^2.
        margin: by which discs are inflated, in metres.
        near: probability that a disc is put on the obstacle-free optimum.
        plan: the obstacle-free optimum of environments, (N, T+1, 2).
    """

    horizon: int
    time_step: float
    times: tuple[int, ...]
    slots: tuple[int, int]
    obstacles: tuple[int, int]
    radius: tuple[float, float]
    start: float
    box: float
    margin: float
    near: float
    plan: Callable[[Environments], np.ndarray]

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Environments, dict[str, float]]:
        """`count` environments; and how many were redrawn whole, and centres redrawn per environment.

        Raises:
            InfeasibleError: if discs of these sizes and this number hardly ever fit.
        """
        parts: list[Environments] = []
        missing, drawn, redraws = count, 0, 0
        for _ in range(_ROUNDS):
            environments, placed, tries = self._draw(missing, rng)
            parts.append(environments.take(np.flatnonzero(placed)))
            drawn, redraws, missing = drawn + missing, redraws + tries, missing - int(placed.sum())
            if not missing:
                notes = {"environments_redrawn": drawn - count, "centres_redrawn_mean": redraws / max(count, 1)}
                return join(parts), notes
        raise InfeasibleError(
            f"task: {missing} of {count} environments found no place for their obstacles in {_ROUNDS} rounds; "
            "lower max_obstacles or radius_range, or widen box"
        )

    def _draw(self, count: int, rng: np.random.Generator) -> tuple[Environments, np.ndarray, int]:
        """Environments, whether all their discs found a place (N,), and how many centres were redrawn."""
        environments = self._without_obstacles(count, rng)
        number = rng.integers(self.obstacles[0], self.obstacles[1] + 1, size=count)
        environments.present[:] = np.arange(self.slots[1]) < number[:, None]
        radius = rng.uniform(*self.radius, size=environments.radius.shape)
        environments.radius[:] = radius * environments.present
        path = self.plan(environments)
        placed, redraws = np.ones(count, dtype=bool), 0
        for j in range(self.slots[1]):
            pending = np.flatnonzero(environments.present[:, j])
            for _ in range(_REDRAWS):
                environments.centre[pending, j] = self._centres(path[pending], rng)
                pending = pending[~self._leaves_room(environments.take(pending), j)]
                redraws += len(pending)
                if not len(pending):
                    break
            placed[pending] = False
        return environments, placed, redraws

    def _without_obstacles(self, count: int, rng: np.random.Generator) -> Environments:
        waypoints, discs = self.slots
        x_init = rng.uniform(-self.start, self.start, size=(count, 4))
        target = rng.uniform(-self.box, self.box, size=(count, 2))
        waypoint, time = np.zeros((count, waypoints, 2)), np.zeros((count, waypoints))
        due = np.tile(np.arange(waypoints) < len(self.times), (count, 1))
        for k, t in enumerate(self.times):
            time[:, k] = t
            waypoint[:, k] = self._early(t, x_init, rng) if 2 * t < self.horizon else self._late(target, rng)
        empty = np.zeros((count, discs))
        return Environments(x_init, target, waypoint, time, due, np.zeros((count, discs, 2)), empty, empty > 0)

    def _early(self, t: int, x_init: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        drift = rng.uniform(-_DRIFT, _DRIFT, size=(len(x_init), 2))
        return x_init[:, :2] + t * self.time_step * x_init[:, 2:] + drift

    def _late(self, target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """In the annulus around the target, inside the box."""
        result, pending = np.empty_like(target), np.arange(len(target))
        while len(pending):
            distance, angle = rng.uniform(*ANNULUS, size=len(pending)), rng.uniform(0, 2 * np.pi, size=len(pending))
            offset = distance * np.stack([np.cos(angle), np.sin(angle)])
            result[pending] = target[pending] + offset.T
            pending = pending[(np.abs(result[pending]) > self.box).any(axis=1)]
        return result

    def _centres(self, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N, 2): on the path (N, T+1, 2), aside of it by a normal deviate, or anywhere."""
        low = 2 + min((t for t in self.times if 2 * t < self.horizon), default=0)
        high = max((t for t in self.times if 2 * t >= self.horizon), default=self.horizon) - 2
        rows, t = np.arange(len(path)), rng.integers(min(low, self.horizon - 1), max(low, high) + 1, size=len(path))
        t = np.minimum(t, self.horizon - 1)
        along = path[rows, t + 1] - path[rows, t - 1]
        normal = along[:, ::-1] * [-1, 1] / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        on_path = path[rows, t] + _ASIDE * rng.standard_normal((len(path), 1)) * normal
        anywhere = rng.uniform(-self.box, self.box, size=(len(path), 2))
        return np.where(rng.uniform(size=(len(path), 1)) < self.near, on_path, anywhere)

    def _leaves_room(self, e: Environments, j: int) -> np.ndarray:
        """(N,), whether disc j is clear of p(0), p(1), waypoints, target, and of the discs before it."""
        centre, radius = e.centre[:, j, None], e.radius[:, j, None]
        start = e.x_init[:, None, :2]
        points = np.concatenate([start, start + self.time_step * e.x_init[:, None, 2:], e.target[:, None]], axis=1)
        least = radius + self.margin + _CLEAR_OF_POINTS
        clear = (np.linalg.norm(points - centre, axis=-1) >= least).all(axis=1)
        clear &= ((np.linalg.norm(e.waypoint - centre, axis=-1) >= least) | ~e.due).all(axis=1)
        between = np.linalg.norm(e.centre[:, :j] - centre, axis=-1) - radius - e.radius[:, :j]
        return clear & (between >= _CLEAR_OF_DISCS).all(axis=1)

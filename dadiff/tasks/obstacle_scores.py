"""Scores of paths among discs: collisions at and between samples, clearance, waypoints, and sides taken.

Between samples the double integrator by forward Euler moves on straight lines, so distances to segments are exact.
Discs are the true ones, without the planning margin. Positions are (N, S, T+1, 2): S plans an environment.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dadiff.tasks.environments import Environments

NEAR = 0.5
"""Metres from a disc within which the expert's path makes its side worth asking for."""


def collision_scores(environments: Environments, positions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Per plan: collision (0/1), collision_at_samples (0/1), depth and clearance in metres, each (N, S).

    Also (N, S, T+1) whether p(t) lies inside a disc. Clearance is nan where there is no disc.
    """
    at_samples = _nearest(environments, _distance(environments, positions))
    between = _nearest(environments, _segment_distance(environments, positions))
    clearance = between.min(axis=-1)
    scores = {
        "collision": (clearance < 0).astype(float),
        "collision_at_samples": (at_samples.min(axis=-1) < 0).astype(float),
        "depth": np.maximum(-clearance, 0),
        "clearance": np.where(np.isfinite(clearance), clearance, np.nan),
    }
    return scores, (at_samples < 0).astype(float)


def waypoint_scores(environments: Environments, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Distance in metres to each waypoint at its time, and to the target at T; nan where there is no waypoint."""
    e, rows = environments, np.arange(environments.count)
    scores = {}
    for k in range(e.due.shape[1]):
        if e.due[:, k].any():
            at = positions[rows, :, e.time[:, k].astype(int)]
            distance = np.linalg.norm(at - e.waypoint[:, None, k], axis=-1)
            scores[f"waypoint_distance_{k + 1}"] = np.where(e.due[:, None, k], distance, np.nan)
    scores["waypoint_distance_target"] = np.linalg.norm(positions[:, :, -1] - e.target[:, None], axis=-1)
    return scores


def success_scores(scores: Mapping[str, np.ndarray], tolerance: float, suffix: str = "_rollout") -> np.ndarray:
    """1 for each plan that keeps clear of the discs and passes within a tolerance of waypoints and target, (N, S).

    Args:
        scores: `collision` and the `waypoint_distance`s, their names with the suffix.
        tolerance: in metres.
    """
    distances = [v for name, v in scores.items() if name.startswith("waypoint_distance") and name.endswith(suffix)]
    reached = np.all([~(distance > tolerance) for distance in distances], axis=0)  # nan where there is no waypoint
    return (reached & (scores[f"collision{suffix}"] == 0)).astype(float)


def choice(cost: np.ndarray, clearance: np.ndarray) -> np.ndarray:
    """Which plan of an environment to take, (N, S), knowing their costs and clearances only, (N, S) each.

    The cheapest of those that keep clear of the discs; where none does, the one that enters them least.
    """
    clear = ~(clearance < 0)  # nan where there is no disc
    cheapest = np.where(clear, cost, np.inf).argmin(axis=1)
    taken = np.where(clear.any(axis=1), cheapest, np.where(clear, 0.0, clearance).argmax(axis=1))
    return np.arange(cost.shape[1]) == taken[:, None]


def side_scores(environments: Environments, positions: np.ndarray, expert: np.ndarray) -> dict[str, np.ndarray]:
    """Of the discs near the expert's path (N, T+1, 2): shares passed on its side, and left of the plan, (N, S).

    A path turns about a disc's centre by an angle that differs by 2 pi between its two sides; two paths take the
    same side where their angles differ by less than pi. The disc is left where the angle is positive. nan where no
    disc is near.
    """
    expert = expert[:, None]
    distance = _segment_distance(environments, expert) - environments.radius[:, None, None]
    near = ((distance.min(axis=2) < NEAR) & environments.present[:, None]).astype(float)  # (N, 1, O)
    angle, angle_of_expert = _angle_about(environments, positions), _angle_about(environments, expert)
    same = np.abs(angle - angle_of_expert) < np.pi
    count = near.sum(axis=-1)

    def share(which: np.ndarray) -> np.ndarray:
        return np.where(count > 0, (near * which).sum(axis=-1) / np.maximum(count, 1), np.nan)

    return {"side_agreement": share(same), "left_share": share(angle > 0)}


def _offset(environments: Environments, positions: np.ndarray) -> np.ndarray:
    """p(t) - o_j, (N, S, T+1, O, 2)."""
    return positions[..., None, :] - environments.centre[:, None, None]


def _distance(environments: Environments, positions: np.ndarray) -> np.ndarray:
    """|p(t) - o_j|, (N, S, T+1, O)."""
    return np.linalg.norm(_offset(environments, positions), axis=-1)


def _segment_distance(environments: Environments, positions: np.ndarray) -> np.ndarray:
    """From o_j to the segment p(t)..p(t+1), (N, S, T, O)."""
    start = _offset(environments, positions[:, :, :-1])
    along = np.diff(positions, axis=2)[..., None, :]
    length = np.square(along).sum(axis=-1)
    share = np.clip(-(start * along).sum(axis=-1) / np.where(length > 0, length, 1.0), 0, 1)
    return np.linalg.norm(start + share[..., None] * along, axis=-1)


def _nearest(environments: Environments, distance: np.ndarray) -> np.ndarray:
    """Distance to the nearest disc's rim, (N, S, ...), inf without discs, from distances to centres (N, S, ..., O)."""
    rim = distance - environments.radius[:, None, None]
    return np.where(environments.present[:, None, None], rim, np.inf).min(axis=-1, initial=np.inf)


def _angle_about(environments: Environments, positions: np.ndarray) -> np.ndarray:
    """By what angle a path turns about each centre, anticlockwise, (N, S, O)."""
    offset = _offset(environments, positions)
    before, after = offset[:, :, :-1], offset[:, :, 1:]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    return np.arctan2(cross, (before * after).sum(axis=-1)).sum(axis=2)

"""Compiled: steps of planar quadrotors, point after point; one plan alone waits for no array of one entry."""

from __future__ import annotations

import math

import numpy as np

from dadiff.compiling import compiled


@compiled
def steps(x: np.ndarray, u: np.ndarray, parameters: np.ndarray, gravity: float, stages: np.ndarray) -> np.ndarray:
    """x + sum_s w_s k_s with k_s = f(x + share_s k_{s-1}, u), see `PlanarQuadrotor`.

    Args:
        x: (R, N, 6), u: (R, N, 2).
        parameters: a, b and c of each robot, (R, 3).
        stages: shares and weights, (S, 2), in seconds.
    """
    following, k = x.copy(), np.empty(6)
    for robot, point in np.ndindex(x.shape[:2]):
        a, b, c = parameters[robot]
        now, to = x[robot, point], following[robot, point]
        thrust, turn = gravity + a * u[robot, point, 0], b * u[robot, point, 1]
        k[:] = 0.0
        for share, weight in stages:
            angle, vx, vz, w = (
                now[2] + share * k[2],
                now[3] + share * k[3],
                now[4] + share * k[4],
                now[5] + share * k[5],
            )
            k[0], k[1], k[2], k[5] = vx, vz, w, turn
            k[3] = -thrust * math.sin(angle) - c * vx
            k[4] = thrust * math.cos(angle) - gravity - c * vz
            for i in range(6):
                to[i] += weight * k[i]
    return following

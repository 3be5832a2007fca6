"""Compiled: steps of planar quadrotors and their derivatives, point after point; see `PlanarQuadrotor`.

One plan alone waits for no arrays of one entry, and a batch for none that leave the cache.
"""

from __future__ import annotations

import math

import numpy as np

from dadiff.compiling import compiled


@compiled
def steps(x: np.ndarray, u: np.ndarray, parameters: np.ndarray, gravity: float, stages: np.ndarray) -> np.ndarray:
    """x + sum_s w_s k_s with k_s = f(x + share_s k_{s-1}, u).

    Args:
        x: (R, N, 6), u: (R, N, 2).
        parameters: a, b and c of each robot, (R, 3).
        stages: shares and weights, (S, 2), in seconds.
    """
    following, k = x.copy(), np.empty(6)
    for robot, point in np.ndindex(x.shape[:2]):
        k[:] = 0.0
        for share, weight in stages:
            _rate(x[robot, point], u[robot, point], parameters[robot], gravity, share, k)
            _add(following[robot, point], weight, k)
    return following


@compiled
def linearised(
    x: np.ndarray, u: np.ndarray, parameters: np.ndarray, gravity: float, stages: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[A, B] = [I, 0] + sum_s w_s dk_s (R, N, 6, 8) with dk_s = [f_x, f_u] + share_s f_x dk_{s-1}, and the step."""
    following, k = x.copy(), np.empty(6)
    J, before, now = np.zeros((*x.shape, 8)), np.empty((6, 8)), np.empty((6, 8))
    for robot, point in np.ndindex(x.shape[:2]):
        (a, b, c), k[:], before[:] = parameters[robot], 0.0, 0.0
        for i in range(6):
            J[robot, point, i, i] = 1.0
        for share, weight in stages:
            thrust, sin, cos = _rate(x[robot, point], u[robot, point], parameters[robot], gravity, share, k)
            now[:] = 0.0
            now[0, 3], now[1, 4], now[2, 5], now[5, 7] = 1.0, 1.0, 1.0, b
            now[3, 2], now[3, 3], now[3, 6] = -thrust * cos, -c, -a * sin
            now[4, 2], now[4, 4], now[4, 6] = -thrust * sin, -c, a * cos
            for j in range(8):
                now[0, j] += share * before[3, j]
                now[1, j] += share * before[4, j]
                now[2, j] += share * before[5, j]
                now[3, j] += share * (-thrust * cos * before[2, j] - c * before[3, j])
                now[4, j] += share * (-thrust * sin * before[2, j] - c * before[4, j])
            _add(following[robot, point], weight, k)
            for i in range(6):
                _add(J[robot, point, i], weight, now[i])
            before, now = now, before
    return J, following


@compiled
def _rate(
    x: np.ndarray, u: np.ndarray, parameters: np.ndarray, gravity: float, share: float, k: np.ndarray
) -> tuple[float, float, float]:
    """k <- f(x + share k, u); and thrust, sine and cosine there."""
    a, b, c = parameters
    thrust, angle = gravity + a * u[0], x[2] + share * k[2]
    sin, cos = math.sin(angle), math.cos(angle)
    k[0], k[1], k[2] = x[3] + share * k[3], x[4] + share * k[4], x[5] + share * k[5]
    k[3] = -thrust * sin - c * k[0]
    k[4] = thrust * cos - gravity - c * k[1]
    k[5] = b * u[1]
    return thrust, sin, cos


@compiled
def _add(to: np.ndarray, weight: float, k: np.ndarray) -> None:
    for i in range(len(to)):
        to[i] += weight * k[i]

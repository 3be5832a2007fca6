"""Compiled: the derivative of an explicit Runge-Kutta step from those of its stages, point after point."""

from __future__ import annotations

import numpy as np

from dadiff.compiling import compiled


@compiled
def through_stages(
    f_x: np.ndarray, f_u: np.ndarray, shares: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A and B of x + sum_s weights_s k_s with k_s = f(x + shares_s k_{s-1}, u).

        dk_s = [f_x, f_u] + shares_s f_x dk_{s-1},    [A, B] = [I, 0] + sum_s weights_s dk_s

    Args:
        f_x: (S, N, n, n), f_u: (S, N, n, m), at the stages; where f_x is 0 nothing is computed.
        shares, weights: (S,), in seconds.

    Returns:
        (N, n, n) and (N, n, m).
    """
    S, N, n, m = f_u.shape
    A, B = np.zeros((N, n, n)), np.zeros((N, n, m))
    before, now = np.zeros((n, n + m)), np.zeros((n, n + m))
    for point in range(N):
        for i in range(n):
            A[point, i, i] = 1.0
        for s in range(S):
            for i in range(n):
                for c in range(n):
                    now[i, c] = f_x[s, point, i, c]
                for c in range(m):
                    now[i, n + c] = f_u[s, point, i, c]
                if shares[s] != 0.0:
                    for j in range(n):
                        slope = shares[s] * f_x[s, point, i, j]
                        if slope != 0.0:
                            for c in range(n + m):
                                now[i, c] += slope * before[j, c]
                for c in range(n):
                    A[point, i, c] += weights[s] * now[i, c]
                for c in range(m):
                    B[point, i, c] += weights[s] * now[i, n + c]
            before, now = now, before
    return A, B

"""The compiled inner loops of the batched expert: one environment after the other, plain loops over time and discs.

The augmented Lagrangian of collision avoidance, for the positions p(2..T) = q, K = T - 1,

    L(p) = f(p) + sum_{t,j} (s_tj^2 - lambda_tj^2) / (2 mu),     s = max(0, lambda + mu g)
    f(p) = sum_t w(t) |p(t) - v(t)|^2 + kappa sum_t |p(t+2) - 2 p(t+1) + p(t)|^2,     kappa = rho / dt^4
    g_tj = (r_j^2 - |p(t) - o_j|^2) / 2

The constraint g <= 0 is smooth everywhere, dg/dp = -(p - o) and d2g/dp2 = -I. So the Hessian's block at t is that of f
plus sum_j mu [s_tj > 0] (p - o_j)(p - o_j)' - s_tj I (Gauss-Newton leaves out the last term), and the Hessian stays
block pentadiagonal, with multiples of the identity off the diagonal: M = L D L' over time takes O(T).

Absent discs have r = 0: g <= 0 always. Everything is in this one file, as numba's cache does not notice changes in
another. Machine code is kept where numba finds a place to write: beside this file, or else in the user's cache. Plain
loops and no array expressions: they take half as long to compile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dadiff.compiling import compiled

_PENALTY, _PENALTY_GROWTH, _ENOUGH_FALL = 3.0, 10.0, 0.25
_SETTLED = 1e-10  # Newton decrement, in units of cost, at which multipliers move on
_FORESEEN = 0.1  # share of L by which Newton's model may still lower it where a start is given up
_ARMIJO, _BACKTRACKS = 1e-4, 30


class One(NamedTuple):
    """One environment.

    Args:
        goal: v, (T+1, 2).
        weight: w, (T+1,).
        centre: o, (O, 2).
        radius: r, (O,); 0 stands for no obstacle.
        kappa: weight of the squared second differences.
    """

    goal: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    kappa: float


@compiled
def force(one: One, p: np.ndarray, multiplier: np.ndarray, penalty: float, s: np.ndarray) -> None:
    """s = max(0, lambda + mu g), (K, O), into s: what the discs push back with, and the next multipliers."""
    for k in range(len(s)):
        for j in range(len(one.radius)):
            x, y = p[k + 2, 0] - one.centre[j, 0], p[k + 2, 1] - one.centre[j, 1]
            g = (one.radius[j] ** 2 - x * x - y * y) / 2
            s[k, j] = max(multiplier[k, j] + penalty * g, 0.0)


@compiled
def cost(one: One, p: np.ndarray) -> float:
    """f(p)."""
    total = 0.0
    for t in range(len(p)):
        for axis in range(2):
            total += one.weight[t] * (p[t, axis] - one.goal[t, axis]) ** 2
            if t >= 2:
                total += one.kappa * (p[t, axis] - 2 * p[t - 1, axis] + p[t - 2, axis]) ** 2
    return total


@compiled
def lagrangian(one: One, p: np.ndarray, multiplier: np.ndarray, penalty: float, s: np.ndarray) -> float:
    """L(p), with s at p."""
    total = 0.0
    for k in range(len(s)):
        for j in range(len(one.radius)):
            total += s[k, j] ** 2 - multiplier[k, j] ** 2
    return cost(one, p) + total / (2 * penalty)


@compiled
def gradient(one: One, p: np.ndarray, s: np.ndarray, out: np.ndarray) -> None:
    """dL/dq, (K, 2), into out, with s at p."""
    K = len(out)
    for axis in range(2):
        for k in range(K):
            out[k, axis] = 2 * one.weight[k + 2] * (p[k + 2, axis] - one.goal[k + 2, axis])
            for j in range(len(one.radius)):
                out[k, axis] -= s[k, j] * (p[k + 2, axis] - one.centre[j, axis])
        for k in range(K):
            bend = 2 * one.kappa * (p[k + 2, axis] - 2 * p[k + 1, axis] + p[k, axis])
            out[k, axis] += bend
            if k >= 1:
                out[k - 1, axis] -= 2 * bend
            if k >= 2:
                out[k - 2, axis] += bend


@compiled
def blocks(one: One, p: np.ndarray, s: np.ndarray, penalty: float, concave: float, out: np.ndarray) -> None:
    """The diagonal blocks [[a, b], [b, d]] of the Hessian as (a, b, d), (K, 3), into out.

    Args:
        concave: 1 for Newton's, 0 for that of Gauss-Newton.
    """
    K = len(out)
    for k in range(K):
        # D'D of second differences has 6 on its diagonal, less at the end, where no later difference reaches
        a = d = 2 * one.weight[k + 2] + 2 * one.kappa * (1.0 if k == K - 1 else 5.0 if k == K - 2 else 6.0)
        b = 0.0
        for j in range(len(one.radius)):
            if s[k, j] > 0:
                x, y = p[k + 2, 0] - one.centre[j, 0], p[k + 2, 1] - one.centre[j, 1]
                a += penalty * x * x - concave * s[k, j]
                b += penalty * x * y
                d += penalty * y * y - concave * s[k, j]
        out[k, 0], out[k, 1], out[k, 2] = a, b, d


@compiled
def band(K: int, kappa: float) -> tuple[np.ndarray, np.ndarray]:
    """What stands beside the diagonal of the Hessian, 2 kappa times D'D at [k, k-1] and [k, k-2], each (K,)."""
    first, second = np.empty(K), np.empty(K)
    for k in range(K):
        first[k], second[k] = -4 * kappa if k == K - 1 else -8 * kappa, 2 * kappa
    return first, second


@compiled
def factorise(
    diagonal: np.ndarray, first: np.ndarray, second: np.ndarray, inverse: np.ndarray, lower: np.ndarray
) -> bool:
    """L D L' of the matrix with M[k,k] = diagonal[k], M[k,k-1] = first[k] I, M[k,k-2] = second[k] I.

    With C[k] = M[k,k-1] - second[k] L[k-1,k-2]', the recursion over k = 0..K-1 is

        L[k,k-1] = C[k] D[k-1]^-1,   D[k] = M[k,k] - L[k,k-1] C[k]' - second[k]^2 D[k-2]^-1

    Args:
        diagonal: symmetric blocks as (a, b, d), (K, 3).
        first, second: (K,), of which the first one and the first two entries are not read.
        inverse: D[k]^-1 as (a, b, d), (K, 3), written.
        lower: L[k,k-1] by rows, (K, 4), written from k = 1 on; L[k,k-2] = second[k] D[k-2]^-1 need not be stored.

    Returns:
        Whether the matrix is positive definite. If not, the factors are incomplete.
    """
    for k in range(len(diagonal)):
        a, b, d = diagonal[k, 0], diagonal[k, 1], diagonal[k, 2]
        if k >= 1:
            c00 = c11 = first[k]
            c01 = c10 = 0.0
            if k >= 2:
                l00, l01, l10, l11 = lower[k - 1, 0], lower[k - 1, 1], lower[k - 1, 2], lower[k - 1, 3]
                c00, c01, c10, c11 = c00 - second[k] * l00, -second[k] * l10, -second[k] * l01, c11 - second[k] * l11
            ia, ib, id_ = inverse[k - 1, 0], inverse[k - 1, 1], inverse[k - 1, 2]
            l00, l01 = c00 * ia + c01 * ib, c00 * ib + c01 * id_
            l10, l11 = c10 * ia + c11 * ib, c10 * ib + c11 * id_
            lower[k, 0], lower[k, 1], lower[k, 2], lower[k, 3] = l00, l01, l10, l11
            a -= l00 * c00 + l01 * c01
            b -= l00 * c10 + l01 * c11
            d -= l10 * c10 + l11 * c11
        if k >= 2:
            a -= second[k] ** 2 * inverse[k - 2, 0]
            b -= second[k] ** 2 * inverse[k - 2, 1]
            d -= second[k] ** 2 * inverse[k - 2, 2]
        determinant = a * d - b * b
        if not (a > 0 and determinant > 0):
            return False
        inverse[k, 0], inverse[k, 1], inverse[k, 2] = d / determinant, -b / determinant, a / determinant
    return True


@compiled
def substitute(inverse: np.ndarray, lower: np.ndarray, second: np.ndarray, x: np.ndarray) -> None:
    """x <- M^-1 x, for x (K, 2) and the factors of M: forward, divide by the pivots, backward."""
    K = len(x)
    z = np.empty((K, 2))
    for k in range(K):
        y0, y1 = x[k, 0], x[k, 1]
        if k >= 1:
            y0 -= lower[k, 0] * x[k - 1, 0] + lower[k, 1] * x[k - 1, 1]
            y1 -= lower[k, 2] * x[k - 1, 0] + lower[k, 3] * x[k - 1, 1]
        if k >= 2:
            y0 -= second[k] * z[k - 2, 0]
            y1 -= second[k] * z[k - 2, 1]
        x[k, 0], x[k, 1] = y0, y1
        z[k, 0], z[k, 1] = inverse[k, 0] * y0 + inverse[k, 1] * y1, inverse[k, 1] * y0 + inverse[k, 2] * y1
    for k in range(K - 1, -1, -1):
        z0, z1 = z[k, 0], z[k, 1]
        if k + 2 < K:
            e0, e1 = second[k + 2] * x[k + 2, 0], second[k + 2] * x[k + 2, 1]
            z0 -= inverse[k, 0] * e0 + inverse[k, 1] * e1
            z1 -= inverse[k, 1] * e0 + inverse[k, 2] * e1
        if k + 1 < K:
            z0 -= lower[k + 1, 0] * x[k + 1, 0] + lower[k + 1, 2] * x[k + 1, 1]
            z1 -= lower[k + 1, 1] * x[k + 1, 0] + lower[k + 1, 3] * x[k + 1, 1]
        x[k, 0], x[k, 1] = z0, z1


@compiled
def newton(one: One, p: np.ndarray, s: np.ndarray, penalty: float, step: np.ndarray) -> None:
    """step <- H^-1 step, for a gradient (K, 2): Newton's H where it is positive definite, else that of Gauss-Newton."""
    K = len(step)
    diagonal, inverse, lower = np.empty((K, 3)), np.empty((K, 3)), np.empty((K, 4))
    first, second = band(K, one.kappa)
    blocks(one, p, s, penalty, 1.0, diagonal)
    if not factorise(diagonal, first, second, inverse, lower):
        blocks(one, p, s, penalty, 0.0, diagonal)
        factorise(diagonal, first, second, inverse, lower)
    substitute(inverse, lower, second, step)


@compiled
def move(p: np.ndarray, step: np.ndarray, size: float) -> None:
    """p(2..T) += size step."""
    for k in range(len(step)):
        for axis in range(2):
            p[k + 2, axis] += size * step[k, axis]


@compiled
def descend(one: One, p: np.ndarray, multiplier: np.ndarray, penalty: float, s: np.ndarray) -> tuple[float, float]:
    """One damped Newton step of p, in place; returns L there and half the decrement g' H^-1 g before it.

    The first a = 1, 1/2, ... is taken with which p - a H^-1 g decreases L enough (Armijo). On return, s is that at p.
    """
    K = len(s)
    slope, step = np.empty((K, 2)), np.empty((K, 2))
    force(one, p, multiplier, penalty, s)
    start = lagrangian(one, p, multiplier, penalty, s)
    gradient(one, p, s, slope)
    gradient(one, p, s, step)
    newton(one, p, s, penalty, step)
    decrement = 0.0
    for k in range(K):
        decrement += (slope[k, 0] * step[k, 0] + slope[k, 1] * step[k, 1]) / 2
    size, taken, slack = 1.0, 0.0, 1e-12 * (1 + abs(start))  # slack for rounding, near convergence
    for _ in range(1 + _BACKTRACKS):
        move(p, step, taken - size)
        taken = size
        force(one, p, multiplier, penalty, s)
        value = lagrangian(one, p, multiplier, penalty, s)
        if value <= start - 2 * _ARMIJO * size * decrement + slack:
            break
        size /= 2
    return value, decrement


@compiled
def violation_of(s: np.ndarray, multiplier: np.ndarray, penalty: float) -> float:
    """max |max(g, -lambda / mu)|, how far the multipliers' conditions are from being met, with s at p."""
    largest = 0.0
    for k in range(len(s)):
        for j in range(s.shape[1]):
            largest = max(largest, abs(s[k, j] - multiplier[k, j]))
    return largest / penalty


@compiled
def minimise_one(one: One, p: np.ndarray, ceiling: float, iterations: int, tolerance: float) -> bool:
    """Move p (T+1, 2) to a local optimum; whether the method of multipliers converged there. See `batched.minimise`."""
    multiplier = np.zeros((len(p) - 2, len(one.radius)))
    s, penalty, violation = np.zeros(multiplier.shape), _PENALTY, np.inf
    for _ in range(iterations):
        value, decrement = descend(one, p, multiplier, penalty, s)
        if decrement <= _FORESEEN * value and value - 2 * decrement > ceiling:
            return False
        if decrement > _SETTLED:
            continue
        now = violation_of(s, multiplier, penalty)
        if now <= tolerance:
            return True
        multiplier, s = s, multiplier
        if now > _ENOUGH_FALL * violation:
            penalty *= _PENALTY_GROWTH
        violation = now
    return False


@compiled
def minimise(
    p: np.ndarray,
    goal: np.ndarray,
    weight: np.ndarray,
    centre: np.ndarray,
    radius: np.ndarray,
    kappa: float,
    ceiling: np.ndarray,
    iterations: int,
    tolerance: float,
) -> np.ndarray:
    """`minimise_one` of N environments, p (N, T+1, 2) in place; (N,) whether it converged."""
    converged = np.zeros(len(p), dtype=np.bool_)
    for i in range(len(p)):
        one = One(goal[i], weight[i], centre[i], radius[i], kappa)
        converged[i] = minimise_one(one, p[i], ceiling[i], iterations, tolerance)
    return converged


@compiled
def minimise_cost(p: np.ndarray, goal: np.ndarray, weight: np.ndarray, kappa: float) -> None:
    """argmin f of N environments into p[:, 2:], (N, T+1, 2): one Newton step from any p, as f is quadratic."""
    centre, radius = np.empty((0, 2)), np.empty(0)
    s, step = np.empty((p.shape[1] - 2, 0)), np.empty((p.shape[1] - 2, 2))
    for i in range(len(p)):
        one = One(goal[i], weight[i], centre, radius, kappa)
        gradient(one, p[i], s, step)
        newton(one, p[i], s, 1.0, step)
        move(p[i], step, -1.0)

"""The compiled loops of `dadiff.experts.nearest`: one plan after the other. Letters as there.

Time by time a plan is s(t) = [x(t); u(t)] with k = n + m entries, where u(T) is pinned to 0:

    E s(t+1) = F(t) s(t) + c(t),    E = [I 0],    F(t) = [A(t) B(t)]

The Jacobian D(t) of the projection of s(t) is diagonal but for the two entries that half-planes are about.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dadiff.compiling import compiled

_ARMIJO, _BACKTRACKS = 1e-4, 40
_FLOOR, _DAMPING = 1e-13, 1e-6  # added to G D G', relative to its largest entry; the second vanishes with the residual
_FOUND, _NOT_CONVERGED, _INFEASIBLE = 0, 1, 2
_PATIENCE = 5  # Newton steps before a proof of infeasibility is looked for: multipliers that diverge are one
_FAR = 1e3  # how far a proof of infeasibility looks where an entry has no bound, in units of 1 + the largest estimate
_SLACK = 1e-12  # by which a point may lie outside of a line: rounding, relative to offset and to what is projected
_PARALLEL = 1e-12


class Problem(NamedTuple):
    """One plan's, or of N plans with a leading N, or fewer where plans that follow each other share.

    s_hat, weight, low, high: (T+1, k); F: (T, n, k); c: (T, n); half-planes: normal (T+1, K, 2), offset (T+1, K) on the
    entries `first` and `second`.
    """

    s_hat: np.ndarray
    weight: np.ndarray
    low: np.ndarray
    high: np.ndarray
    F: np.ndarray
    c: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    first: int
    second: int


class Point(NamedTuple):
    """What multipliers give: s (T+1, k), D as its diagonal (T+1, k) and the pair's `cross` (T+1,), residual (T, n)."""

    s: np.ndarray
    D: np.ndarray
    cross: np.ndarray
    residual: np.ndarray


@compiled
def pull(problem: Problem, multiplier: np.ndarray, t: int, j: int) -> float:
    """The factor of s(t)_j in lambda' r: that of F(t)' lambda(t) - E' lambda(t-1)."""
    n = multiplier.shape[1]
    total = -multiplier[t - 1, j] if t > 0 and j < n else 0.0
    if t < len(multiplier):
        for i in range(n):
            total += problem.F[t, i, j] * multiplier[t, i]
    return total


@compiled
def lines_at(problem: Problem, t: int, far: float, lines: np.ndarray) -> int:
    """Half-planes at time t, and bounds on their two entries, at most at `far`, as rows of `lines`; their number."""
    count = 0
    for h in range(problem.offset.shape[1]):
        if problem.offset[t, h] > -np.inf:
            lines[count] = problem.normal[t, h, 0], problem.normal[t, h, 1], problem.offset[t, h]
            count += 1
    for axis, j in enumerate((problem.first, problem.second)):
        for sign in (1.0, -1.0):
            bound = max(problem.low[t, j] if sign > 0 else -problem.high[t, j], -far)
            if bound > -np.inf:
                lines[count] = sign * (axis == 0), sign * (axis == 1), bound
                count += 1
    return count


@compiled
def respond(problem: Problem, multiplier: np.ndarray, at: Point) -> float:
    """The nearest s for given multipliers, with D and the residual, into `at`; the dual's value, or nan."""
    lines, value = np.empty((problem.offset.shape[1] + 4, 3)), 0.0
    i, j, paired = problem.first, problem.second, problem.offset.shape[1] > 0
    for t in range(at.s.shape[0]):
        for k in range(at.s.shape[1]):
            at.s[t, k] = problem.s_hat[t, k] - pull(problem, multiplier, t, k) / problem.weight[t, k]
        p, q = at.s[t, i], at.s[t, j]
        for k in range(at.s.shape[1]):
            free = problem.low[t, k] < at.s[t, k] < problem.high[t, k]
            at.D[t, k] = 1 / problem.weight[t, k] if free else 0.0
            at.s[t, k] = min(max(at.s[t, k], problem.low[t, k]), problem.high[t, k])
        at.cross[t] = 0.0
        if paired:
            count = lines_at(problem, t, np.inf, lines)
            found = nearest_point(lines, count, p, q, problem.weight[t, i], problem.weight[t, j])
            at.s[t, i], at.s[t, j], at.D[t, i], at.D[t, j], at.cross[t] = found
        for k in range(at.s.shape[1]):
            value += problem.weight[t, k] * (at.s[t, k] - problem.s_hat[t, k]) ** 2 / 2
    return value + follow_dynamics(problem, multiplier, at)


@compiled
def follow_dynamics(problem: Problem, multiplier: np.ndarray, at: Point) -> float:
    """r(t) = F(t) s(t) + c(t) - E s(t+1) into `at`; lambda' r."""
    total = 0.0
    for t in range(at.residual.shape[0]):
        for i in range(at.residual.shape[1]):
            r = problem.c[t, i] - at.s[t + 1, i]
            for k in range(at.s.shape[1]):
                r += problem.F[t, i, k] * at.s[t, k]
            at.residual[t, i] = r
            total += multiplier[t, i] * r
    return total


@compiled
def curvature(problem: Problem, at: Point, diagonal: np.ndarray, below: np.ndarray) -> float:
    """G D G' by blocks; the largest entry of its diagonal.

    [t, t] = F D(t) F' + E D(t+1) E' into `diagonal` (T, n, n), and [t, t-1] = -F D(t) E' into `below` (T, n, n).
    """
    (T, n, k), largest = problem.F.shape, 0.0
    first, second, FD = problem.first, problem.second, np.empty((n, k))
    for t in range(T):
        F = problem.F[t]
        for i in range(n):
            for j in range(k):
                FD[i, j] = F[i, j] * at.D[t, j]
            FD[i, first] += F[i, second] * at.cross[t]
            FD[i, second] += F[i, first] * at.cross[t]
        for i in range(n):
            for j in range(n):
                below[t, i, j], diagonal[t, i, j] = -FD[i, j], 0.0
                for e in range(k):
                    diagonal[t, i, j] += FD[i, e] * F[j, e]
            diagonal[t, i, i] += at.D[t + 1, i]
        diagonal[t, first, second] += at.cross[t + 1]
        diagonal[t, second, first] += at.cross[t + 1]
        for i in range(n):
            largest = max(largest, diagonal[t, i, i])
    return largest


@compiled
def factorise(diagonal: np.ndarray, below: np.ndarray, ridge: float) -> None:
    """Cholesky of the block tridiagonal matrix plus a ridge, in place: L[t, t] in diagonal, L[t, t-1] in below."""
    T, n = diagonal.shape[0], diagonal.shape[1]
    for t in range(T):
        for i in range(n):
            diagonal[t, i, i] += ridge
        if t > 0:
            divide(below[t], diagonal[t - 1])
            for i in range(n):
                for j in range(i + 1):
                    for k in range(n):
                        diagonal[t, i, j] -= below[t, i, k] * below[t, j, k]
        cholesky(diagonal[t], ridge)


@compiled
def divide(X: np.ndarray, L: np.ndarray) -> None:
    """X <- X L'^-1 with L lower triangular."""
    for i in range(len(X)):
        for j in range(len(L)):
            for k in range(j):
                X[i, j] -= X[i, k] * L[j, k]
            X[i, j] /= L[j, j]


@compiled
def cholesky(M: np.ndarray, least: float) -> None:
    """M <- L with L L' = M, in its lower half; no pivot is below `least`."""
    for i in range(len(M)):
        for j in range(i + 1):
            for k in range(j):
                M[i, j] -= M[i, k] * M[j, k]
            M[i, j] = np.sqrt(max(M[i, i], least)) if i == j else M[i, j] / M[j, j]


@compiled
def substitute(diagonal: np.ndarray, below: np.ndarray, x: np.ndarray) -> None:
    """x (T, n) <- (L L')^-1 x."""
    T, n = x.shape
    for t in range(T):
        for i in range(n):
            if t > 0:
                for k in range(n):
                    x[t, i] -= below[t, i, k] * x[t - 1, k]
            for k in range(i):
                x[t, i] -= diagonal[t, i, k] * x[t, k]
            x[t, i] /= diagonal[t, i, i]
    for t in range(T - 1, -1, -1):
        for i in range(n - 1, -1, -1):
            if t + 1 < T:
                for k in range(n):
                    x[t, i] -= below[t + 1, k, i] * x[t + 1, k]
            for k in range(i + 1, n):
                x[t, i] -= diagonal[t, k, i] * x[t, k]
            x[t, i] /= diagonal[t, i, i]


@compiled
def largest_of(X: np.ndarray) -> float:
    """max |X|, of a matrix."""
    largest = 0.0
    for i in range(X.shape[0]):
        for j in range(X.shape[1]):
            largest = max(largest, abs(X[i, j]))
    return largest


@compiled
def inner(X: np.ndarray, Y: np.ndarray) -> float:
    """sum X Y, of matrices."""
    total = 0.0
    for i in range(X.shape[0]):
        for j in range(X.shape[1]):
            total += X[i, j] * Y[i, j]
    return total


@compiled
def move(X: np.ndarray, size: float, step: np.ndarray) -> None:
    """X <- X + size step."""
    for i in range(X.shape[0]):
        for j in range(X.shape[1]):
            X[i, j] += size * step[i, j]


@compiled
def advance(problem: Problem, multiplier: np.ndarray, step: np.ndarray, value: float, slope: float, at: Point) -> float:
    """Move the multipliers by 1, 1/2, ... of a step until the dual rises enough (Armijo); its value there, and `at`.

    Where the whole step does not do, halving goes on for as long as the dual rises with it.
    """
    size, taken, slack, best, better = 1.0, 0.0, 1e-12 * (1 + abs(value)), -np.inf, 0.0
    for _ in range(_BACKTRACKS):
        move(multiplier, size - taken, step)
        taken = size
        found = respond(problem, multiplier, at)
        if found < best:
            break
        if found >= value + _ARMIJO * size * slope - slack:
            if size == 1.0:
                return found
            best, better = found, size
        size /= 2
    if better == 0.0 or better == taken:
        return found
    move(multiplier, better - taken, step)
    return respond(problem, multiplier, at)


@compiled
def impossible(problem: Problem, multiplier: np.ndarray) -> bool:
    """Whether the multipliers prove that nothing meets the dynamics within limits: lambda' r > 0 for all that does.

    Where an entry has no bound, the proof holds for what lies within `_FAR` of zero.
    """
    first, second, paired = problem.first, problem.second, problem.offset.shape[1] > 0
    lines, far = np.empty((problem.offset.shape[1] + 4, 3)), _FAR * (1 + largest_of(problem.s_hat))
    least = inner(multiplier, problem.c)
    size = abs(least)
    for t in range(problem.s_hat.shape[0]):
        for j in range(problem.s_hat.shape[1]):
            a, bound = pull(problem, multiplier, t, j), 0.0
            if paired and j == first:
                b = pull(problem, multiplier, t, second)
                bound = least_of_pair(lines, lines_at(problem, t, far, lines), a, b)
            elif not (paired and j == second):
                bound = min(a * max(problem.low[t, j], -far), a * min(problem.high[t, j], far))
            least += bound
            size += abs(bound)
    return least > 1e-9 * size


@compiled
def nearest_one(
    problem: Problem, multiplier: np.ndarray, at: Point, tolerance: float, iterations: int
) -> tuple[int, int]:
    """Semismooth Newton on the dual, from the given multipliers on; status and Newton steps. The plan is in `at`."""
    T, n = multiplier.shape
    diagonal, below = np.empty((T, n, n)), np.empty((T, n, n))
    value = respond(problem, multiplier, at)
    for iteration in range(iterations):
        if np.isnan(value):
            return _INFEASIBLE, iteration
        violation = largest_of(at.residual) / (1 + largest_of(at.s))
        if violation <= tolerance:
            return _FOUND, iteration
        ridge = curvature(problem, at, diagonal, below) * (_FLOOR + _DAMPING * min(1.0, violation)) + 1e-300
        factorise(diagonal, below, ridge)
        step = at.residual.copy()
        substitute(diagonal, below, step)
        if iteration >= _PATIENCE and (impossible(problem, step) or impossible(problem, multiplier)):
            return _INFEASIBLE, iteration
        value = advance(problem, multiplier, step, value, inner(step, at.residual), at)
    return _NOT_CONVERGED, iterations


@compiled
def nearest(
    every: Problem,
    s: np.ndarray,
    multiplier: np.ndarray,
    status: np.ndarray,
    iterations: np.ndarray,
    tolerance: float,
    most: int,
) -> None:
    """`nearest_one` of N plans: s (N, T+1, k), multipliers (N, T, n), status and iterations (N,) in place."""
    N, times, k = s.shape
    T, n = multiplier.shape[1], multiplier.shape[2]
    for i in range(N):
        own, weighted = i * len(every.F) // N, i * len(every.weight) // N
        problem = Problem(
            every.s_hat[i], every.weight[weighted], every.low[i], every.high[i], every.F[own], every.c[own],
            every.normal[i], every.offset[i], every.first, every.second,
        )  # fmt: skip
        at = Point(s[i], np.empty((times, k)), np.empty(times), np.empty((T, n)))
        status[i], iterations[i] = nearest_one(problem, multiplier[i], at, tolerance, most)


# --- the plane: half-planes a p + b q >= e are rows (a, b, e) of `lines`, of which the first `count` are meant


@compiled
def meets(lines: np.ndarray, count: int, p: float, q: float, slack: float, one: int, other: int) -> bool:
    """Whether a point lies on the right side of every line but two, on which it lies."""
    for k in range(count):
        a, b, e = lines[k, 0], lines[k, 1], lines[k, 2]
        if k != one and k != other and a * p + b * q < e - slack * (1 + abs(e)):
            return False
    return True


@compiled
def nearest_point(
    lines: np.ndarray, count: int, p: float, q: float, wp: float, wq: float
) -> tuple[float, float, float, float, float]:
    """The nearest point to (p, q) in the metric diag(wp, wq) that meets all lines, and its Jacobian times diag(1/w).

    It is the point itself, or its foot on one line, or the corner of two; the nearest of those that meet all.

    Returns:
        p, q, and (d_p, d_q, d_pq) of [[d_p, d_pq], [d_pq, d_q]]; nan where the lines contradict each other.
    """
    slack = _SLACK * (1 + abs(p) + abs(q))
    if meets(lines, count, p, q, slack, -1, -1):
        return p, q, 1 / wp, 1 / wq, 0.0
    best, found = np.inf, (np.nan, np.nan, 0.0, 0.0, 0.0)
    for k in range(count):
        a, b, e = lines[k, 0], lines[k, 1], lines[k, 2]
        short, norm = e - a * p - b * q, a * a / wp + b * b / wq
        foot_p, foot_q = p + a / wp * short / norm, q + b / wq * short / norm
        distance = short * short / norm
        if short > 0 and distance < best and meets(lines, count, foot_p, foot_q, slack, k, k):
            along = 1 / (wp * wq * norm)  # what is left to move: along the line
            best, found = distance, (foot_p, foot_q, b * b * along, a * a * along, -a * b * along)
    if best < np.inf:
        return found
    for k in range(count):
        for j in range(k):
            corner_p, corner_q = corner(lines[k], lines[j])
            distance = wp * (corner_p - p) ** 2 + wq * (corner_q - q) ** 2
            if distance < best and meets(lines, count, corner_p, corner_q, slack, k, j):
                best, found = distance, (corner_p, corner_q, 0.0, 0.0, 0.0)
    return found


@compiled
def corner(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Where two lines meet; nan where they are parallel."""
    determinant = one[0] * other[1] - one[1] * other[0]
    if abs(determinant) < _PARALLEL:
        return np.nan, np.nan
    p = (one[2] * other[1] - other[2] * one[1]) / determinant
    q = (one[0] * other[2] - other[0] * one[2]) / determinant
    return p, q


@compiled
def least_of_pair(lines: np.ndarray, count: int, a: float, b: float) -> float:
    """min a p + b q over the points that meet all lines; -inf where nothing bounds it.

    By duality it is the largest value that nonnegative multiples of one line, or of two, add up to (a, b) with.
    """
    found = 0.0 if a == 0 and b == 0 else -np.inf
    for k in range(count):
        one = lines[k]
        along, across = a * one[0] + b * one[1], a * one[1] - b * one[0]
        if along > 0 and abs(across) <= _SLACK * along:
            found = max(found, one[2] * along / (one[0] ** 2 + one[1] ** 2))
        for j in range(k):
            other = lines[j]
            determinant = one[0] * other[1] - one[1] * other[0]
            if abs(determinant) >= _PARALLEL:
                share = (a * other[1] - b * other[0]) / determinant
                rest = (b * one[0] - a * one[1]) / determinant
                if share >= 0 and rest >= 0:
                    found = max(found, share * one[2] + rest * other[2])
    return found

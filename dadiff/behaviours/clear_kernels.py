"""The compiled loops of `dadiff.behaviours.clear`: one plan after the other. Letters as there.

A plan's stages are x(0), .., x(T) and u(0), .., u(T-1). The Jacobian D of the projection of a state is a dense (n, n)
block, diagonal but for the two entries that half-planes are about.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dadiff.compiling import compiled

_ARMIJO, _BACKTRACKS = 1e-4, 40
_FLOOR, _DAMPING = 1e-13, 1e-6  # added to G D G', relative to its largest entry; the second vanishes with the residual
_SLACK = 1e-12  # by which a corner may lie outside of another line, relative to 1 + its offset
_FOUND, _NOT_CONVERGED, _INFEASIBLE = 0, 1, 2
_PATIENCE = 5  # Newton steps before a proof of infeasibility is looked for: multipliers that diverge are one
_FAR = 1e3  # how far a proof of infeasibility looks where an entry has no bound, in units of 1 + the largest estimate


class Limited(NamedTuple):
    """What N plans are given, each with a leading N but for weights; dynamics with a leading N or 1."""

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    wx: np.ndarray
    wu: np.ndarray
    x_low: np.ndarray
    u_low: np.ndarray
    x_high: np.ndarray
    u_high: np.ndarray
    normal: np.ndarray
    offset: np.ndarray


class Plan(NamedTuple):
    """One plan: estimates, dynamics, weights, bounds, half-planes."""

    x_hat: np.ndarray
    u_hat: np.ndarray
    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    wx: np.ndarray
    wu: np.ndarray
    x_low: np.ndarray
    u_low: np.ndarray
    x_high: np.ndarray
    u_high: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    first: int
    second: int


class Point(NamedTuple):
    """What multipliers give: x (T+1, n), u (T, m), Jacobians Dx (T+1, n, n) and Du (T, m), residual (T, n)."""

    x: np.ndarray
    u: np.ndarray
    Dx: np.ndarray
    Du: np.ndarray
    residual: np.ndarray


@compiled
def lines_of(plan: Plan, t: int, far: float, lines: np.ndarray) -> int:
    """The lines a p + b q >= e of half-planes and bounds on p, at most at far, as rows (a, b, e); their number."""
    count = 0
    for k in range(plan.offset.shape[1]):
        if plan.offset[t, k] > -np.inf:
            lines[count, 0], lines[count, 1] = plan.normal[t, k, 0], plan.normal[t, k, 1]
            lines[count, 2] = plan.offset[t, k]
            count += 1
    for axis in range(2):
        entry = plan.first if axis == 0 else plan.second
        for sign in (1.0, -1.0):
            bound = max(plan.x_low[t, entry] if sign > 0 else -plan.x_high[t, entry], -far)
            if bound > -np.inf:
                lines[count, 0], lines[count, 1] = sign * (axis == 0), sign * (axis == 1)
                lines[count, 2] = bound
                count += 1
    return count


@compiled
def meets(lines: np.ndarray, count: int, p: float, q: float) -> bool:
    """Whether a point lies on the right side of every line."""
    for k in range(count):
        slack = _SLACK * (1 + abs(lines[k, 2]))
        if lines[k, 0] * p + lines[k, 1] * q < lines[k, 2] - slack:
            return False
    return True


@compiled
def project_pair(
    lines: np.ndarray, count: int, p: float, q: float, wp: float, wq: float, out: np.ndarray
) -> tuple[float, float]:
    """The nearest point to (p, q) in the metric diag(wp, wq) that meets all lines; its Jacobian times 1/w into out.

    It is the point itself, or its projection onto one line, or the corner of two; the nearest of those that meet all.
    Where there is none the lines contradict each other, and nan is returned.

    Args:
        out: (a, b, d) of the symmetric [[a, b], [b, d]].
    """
    out[0], out[1], out[2] = 1 / wp, 0.0, 1 / wq
    if meets(lines, count, p, q):
        return p, q
    best, bp, bq = np.inf, np.nan, np.nan
    for k in range(count):
        a, b, e = lines[k, 0], lines[k, 1], lines[k, 2]
        short = e - a * p - b * q
        norm = a * a / wp + b * b / wq
        if short <= 0:
            continue
        cp, cq = p + a / wp * short / norm, q + b / wq * short / norm
        distance = wp * (cp - p) ** 2 + wq * (cq - q) ** 2
        if distance < best and meets(lines, count, cp, cq):
            best, bp, bq = distance, cp, cq
            out[0], out[1], out[2] = b * b / (wp * wq * norm), -a * b / (wp * wq * norm), a * a / (wp * wq * norm)
    if best < np.inf:
        return bp, bq
    out[0], out[1], out[2] = 0.0, 0.0, 0.0
    for k in range(count):
        for j in range(k):
            determinant = lines[k, 0] * lines[j, 1] - lines[k, 1] * lines[j, 0]
            if abs(determinant) < 1e-12:
                continue
            cp = (lines[k, 2] * lines[j, 1] - lines[j, 2] * lines[k, 1]) / determinant
            cq = (lines[k, 0] * lines[j, 2] - lines[j, 0] * lines[k, 2]) / determinant
            distance = wp * (cp - p) ** 2 + wq * (cq - q) ** 2
            if distance < best and meets(lines, count, cp, cq):
                best, bp, bq = distance, cp, cq
    return bp, bq


@compiled
def pull_on_state(plan: Plan, multiplier: np.ndarray, t: int, i: int) -> float:
    """The factor of x(t)_i in lambda' r."""
    pull = -multiplier[t - 1, i] if t > 0 else 0.0
    if t < len(plan.B):
        for k in range(multiplier.shape[1]):
            pull += plan.A[t, k, i] * multiplier[t, k]
    return pull


@compiled
def pull_on_input(plan: Plan, multiplier: np.ndarray, t: int, i: int) -> float:
    """The factor of u(t)_i in lambda' r."""
    pull = 0.0
    for k in range(multiplier.shape[1]):
        pull += plan.B[t, k, i] * multiplier[t, k]
    return pull


@compiled
def respond(plan: Plan, multiplier: np.ndarray, at: Point) -> float:
    """The nearest x, u for given multipliers, with Jacobians and residual, into `at`; the dual's value, or nan."""
    T, n, m = len(plan.B), plan.A.shape[1], plan.B.shape[2]
    lines, jacobian = np.empty((plan.offset.shape[1] + 4, 3)), np.empty(3)
    paired, value = plan.offset.shape[1] > 0, 0.0
    for t in range(T + 1):
        for i in range(n):
            at.x[t, i] = plan.x_hat[t, i] - pull_on_state(plan, multiplier, t, i) / plan.wx[t, i]
            for k in range(n):
                at.Dx[t, i, k] = 0.0
        if paired:
            i, j = plan.first, plan.second
            count = lines_of(plan, t, np.inf, lines)
            p, q = project_pair(lines, count, at.x[t, i], at.x[t, j], plan.wx[t, i], plan.wx[t, j], jacobian)
            at.x[t, i], at.x[t, j] = p, q
            at.Dx[t, i, i], at.Dx[t, i, j], at.Dx[t, j, i], at.Dx[t, j, j] = (
                jacobian[0], jacobian[1], jacobian[1], jacobian[2])  # fmt: skip
        for i in range(n):
            if not (paired and (i == plan.first or i == plan.second)):
                free = plan.x_low[t, i] < at.x[t, i] < plan.x_high[t, i]
                at.Dx[t, i, i] = 1 / plan.wx[t, i] if free else 0.0
                at.x[t, i] = min(max(at.x[t, i], plan.x_low[t, i]), plan.x_high[t, i])
            value += plan.wx[t, i] * (at.x[t, i] - plan.x_hat[t, i]) ** 2 / 2
    for t in range(T):
        for i in range(m):
            u = plan.u_hat[t, i] - pull_on_input(plan, multiplier, t, i) / plan.wu[t, i]
            at.Du[t, i] = 1 / plan.wu[t, i] if plan.u_low[t, i] < u < plan.u_high[t, i] else 0.0
            at.u[t, i] = min(max(u, plan.u_low[t, i]), plan.u_high[t, i])
            value += plan.wu[t, i] * (at.u[t, i] - plan.u_hat[t, i]) ** 2 / 2
    return value + residual_of(plan, multiplier, at)


@compiled
def residual_of(plan: Plan, multiplier: np.ndarray, at: Point) -> float:
    """A x + B u + c - x(t+1) into `at`; its product with the multipliers."""
    T, n, m = len(plan.B), plan.A.shape[1], plan.B.shape[2]
    total = 0.0
    for t in range(T):
        for i in range(n):
            r = plan.c[t, i] - at.x[t + 1, i]
            for k in range(n):
                r += plan.A[t, i, k] * at.x[t, k]
            for k in range(m):
                r += plan.B[t, i, k] * at.u[t, k]
            at.residual[t, i] = r
            total += multiplier[t, i] * r
    return total


@compiled
def curvature(plan: Plan, at: Point, diagonal: np.ndarray, below: np.ndarray) -> float:
    """G D G' by blocks: [t, t] into diagonal (T, n, n), [t, t-1] = -A D into below (T, n, n); its largest entry."""
    T, n, m = len(plan.B), plan.A.shape[1], plan.B.shape[2]
    largest = 0.0
    for t in range(T):
        for i in range(n):
            for j in range(n):
                total = 0.0
                for k in range(n):
                    total += plan.A[t, i, k] * at.Dx[t, k, j]
                below[t, i, j] = -total
        for i in range(n):
            for j in range(i + 1):
                total = at.Dx[t + 1, i, j]
                for k in range(n):
                    total -= below[t, i, k] * plan.A[t, j, k]
                for k in range(m):
                    total += plan.B[t, i, k] * at.Du[t, k] * plan.B[t, j, k]
                diagonal[t, i, j] = diagonal[t, j, i] = total
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
            for i in range(n):  # L[t, t-1] L[t-1, t-1]' = M[t, t-1]
                for j in range(n):
                    total = below[t, i, j]
                    for k in range(j):
                        total -= below[t, i, k] * diagonal[t - 1, j, k]
                    below[t, i, j] = total / diagonal[t - 1, j, j]
            for i in range(n):
                for j in range(i + 1):
                    for k in range(n):
                        diagonal[t, i, j] -= below[t, i, k] * below[t, j, k]
        for i in range(n):
            for j in range(i + 1):
                total = diagonal[t, i, j]
                for k in range(j):
                    total -= diagonal[t, i, k] * diagonal[t, j, k]
                if i == j:
                    diagonal[t, i, i] = np.sqrt(max(total, ridge))
                else:
                    diagonal[t, i, j] = total / diagonal[t, j, j]


@compiled
def substitute(diagonal: np.ndarray, below: np.ndarray, right: np.ndarray, x: np.ndarray) -> None:
    """x (T, n) <- (L L')^-1 right."""
    T, n = right.shape
    for t in range(T):
        for i in range(n):
            total = right[t, i]
            if t > 0:
                for k in range(n):
                    total -= below[t, i, k] * x[t - 1, k]
            for k in range(i):
                total -= diagonal[t, i, k] * x[t, k]
            x[t, i] = total / diagonal[t, i, i]
    for t in range(T - 1, -1, -1):
        for i in range(n - 1, -1, -1):
            total = x[t, i]
            if t + 1 < T:
                for k in range(n):
                    total -= below[t + 1, k, i] * x[t + 1, k]
            for k in range(i + 1, n):
                total -= diagonal[t, k, i] * x[t, k]
            x[t, i] = total / diagonal[t, i, i]


@compiled
def largest_of(values: np.ndarray) -> float:
    """max |values|, of a matrix."""
    largest = 0.0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            largest = max(largest, abs(values[i, j]))
    return largest


@compiled
def advance(plan: Plan, multiplier: np.ndarray, step: np.ndarray, value: float, slope: float, at: Point) -> float:
    """Move the multipliers along a step as far as the dual rises enough (Armijo); its value there, and `at`."""
    T, n = multiplier.shape
    size, taken, slack = 1.0, 0.0, 1e-12 * (1 + abs(value))
    for _ in range(_BACKTRACKS):
        for t in range(T):
            for i in range(n):
                multiplier[t, i] += (size - taken) * step[t, i]
        taken = size
        found = respond(plan, multiplier, at)
        if found >= value + _ARMIJO * size * slope - slack:
            break
        size /= 2
    return found


@compiled
def least_of_pair(lines: np.ndarray, count: int, a: float, b: float) -> float:
    """min a p + b q over the points that meet all lines; -inf where there is none.

    The minimum is at a line that (a, b) is normal to, or at a corner between whose normals (a, b) lies.
    """
    found = -np.inf
    for k in range(count):
        along = a * lines[k, 0] + b * lines[k, 1]
        if along > 0 and abs(a * lines[k, 1] - b * lines[k, 0]) <= _SLACK * along:
            found = max(found, lines[k, 2] * along / (lines[k, 0] ** 2 + lines[k, 1] ** 2))
        for j in range(k):
            determinant = lines[k, 0] * lines[j, 1] - lines[k, 1] * lines[j, 0]
            if abs(determinant) < 1e-12:
                continue
            share = (a * lines[j, 1] - b * lines[j, 0]) / determinant
            other = (b * lines[k, 0] - a * lines[k, 1]) / determinant
            if share >= 0 and other >= 0:
                found = max(found, share * lines[k, 2] + other * lines[j, 2])
    return found


@compiled
def least_of_entry(a: float, low: float, high: float) -> float:
    """min a z over low <= z <= high."""
    return min(a * low, a * high) if a != 0 else 0.0


@compiled
def impossible(plan: Plan, multiplier: np.ndarray) -> bool:
    """Whether the multipliers prove that nothing meets the dynamics within limits: lambda' r > 0 for all that does.

    Where an entry has no bound, the proof holds for what lies within `_FAR` of zero.
    """
    T, n, m = len(plan.B), plan.A.shape[1], plan.B.shape[2]
    lines, paired = np.empty((plan.offset.shape[1] + 4, 3)), plan.offset.shape[1] > 0
    far, least, size = _FAR * (1 + max(largest_of(plan.x_hat), largest_of(plan.u_hat))), 0.0, 0.0
    for t in range(T + 1):
        for i in range(n):
            a, bound = pull_on_state(plan, multiplier, t, i), 0.0
            if t < T:
                least += multiplier[t, i] * plan.c[t, i]
            if paired and i == plan.first:
                b = pull_on_state(plan, multiplier, t, plan.second)
                bound = least_of_pair(lines, lines_of(plan, t, far, lines), a, b)
            elif not (paired and i == plan.second):
                bound = least_of_entry(a, max(plan.x_low[t, i], -far), min(plan.x_high[t, i], far))
            least += bound
            size += abs(bound)
    for t in range(T):
        for i in range(m):
            a = pull_on_input(plan, multiplier, t, i)
            bound = least_of_entry(a, max(plan.u_low[t, i], -far), min(plan.u_high[t, i], far))
            least += bound
            size += abs(bound)
    return least > 1e-9 * size


@compiled
def nearest_one(plan: Plan, multiplier: np.ndarray, at: Point, tolerance: float, iterations: int) -> tuple[int, int]:
    """Semismooth Newton on the dual, from the given multipliers on; status and Newton steps. The plan is in `at`."""
    T, n = multiplier.shape
    diagonal, below, step = np.empty((T, n, n)), np.empty((T, n, n)), np.empty((T, n))
    value = respond(plan, multiplier, at)
    for iteration in range(iterations):
        if np.isnan(value):
            return _INFEASIBLE, iteration
        violation = largest_of(at.residual) / (1 + largest_of(at.x))
        if violation <= tolerance:
            return _FOUND, iteration
        ridge = curvature(plan, at, diagonal, below) * (_FLOOR + _DAMPING * min(1.0, violation)) + 1e-300
        factorise(diagonal, below, ridge)
        substitute(diagonal, below, at.residual, step)
        if iteration >= _PATIENCE and (impossible(plan, step) or impossible(plan, multiplier)):
            return _INFEASIBLE, iteration
        slope = 0.0
        for t in range(T):
            for i in range(n):
                slope += step[t, i] * at.residual[t, i]
        value = advance(plan, multiplier, step, value, slope, at)
    return _NOT_CONVERGED, iterations


@compiled
def nearest(
    x: np.ndarray,
    u: np.ndarray,
    given: Limited,
    first: int,
    second: int,
    multiplier: np.ndarray,
    status: np.ndarray,
    iterations: np.ndarray,
    tolerance: float,
    most: int,
) -> None:
    """`nearest_one` of N plans: x (N, T+1, n), u (N, T, m), multipliers, status and iterations in place."""
    T, n, m = u.shape[1], x.shape[2], u.shape[2]
    for k in range(len(x)):
        own = k if len(given.A) > 1 else 0
        plan = Plan(
            x[k].copy(), u[k].copy(), given.A[own], given.B[own], given.c[own], given.wx, given.wu, given.x_low[k],
            given.u_low[k], given.x_high[k], given.u_high[k], given.normal[k], given.offset[k], first, second,
        )  # fmt: skip
        at = Point(x[k], u[k], np.empty((T + 1, n, n)), np.empty((T, m)), np.empty((T, n)))
        status[k], iterations[k] = nearest_one(plan, multiplier[k], at, tolerance, most)

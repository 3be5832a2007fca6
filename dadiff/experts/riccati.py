"""Compiled Riccati recursions: many time-varying LQR problems at once, each with parameters to be chosen as well.

One problem, in deviations from a nominal plan, with parameters zeta = (1, z):

    min over dx, du, z   sum_t  1/2 dx' Q dx + 1/2 du' R du + (dx' Lx + du' Lu) zeta  +  1/2 zeta' M zeta
    subject to           dx(t+1) = A dx(t) + B du(t) + defect(t)

The value function V_t(dx, zeta) = 1/2 dx' P dx + dx' S zeta + 1/2 zeta' H zeta is swept backwards; z is its stationary
point at t = 0. What z stands for is the caller's choice: coefficients of the directions of a low-rank metric (M > 0),
or multipliers of pinned entries (M = 0): one column a parameter, and no step more.
"""

from __future__ import annotations

import numpy as np

from dadiff.compiling import compiled

Array = np.ndarray


@compiled
def solve_all(
    A: Array,
    B: Array,
    defect: Array,
    Q: Array,
    R: Array,
    Lx: Array,
    Lu: Array,
    shared_x: Array,
    shared_u: Array,
    M: Array,
    M0: Array,
    start: Array,
    free: bool,
    damping: Array,
) -> tuple[Array, Array, Array, Array]:
    """Gains, feedforward and parameters of every problem.

    Args:
        A: (N, T, n, n), B: (N, T, n, m), defect: (N, T, n).
        Q: (T+1, n, n), R: (T, m, m), shared.
        Lx: (N, T+1, n), Lu: (N, T, m), the linear terms of the 1 in zeta.
        shared_x: (T+1, n, k), shared_u: (T, m, k), those of z; M: (k, k), M0: (N, k), the quadratic terms of z.
        start: dx(0), (N, n).
        free: dx(0) is chosen, too.
        damping: added to the diagonal of B'PB + R, (N,).

    Returns:
        K (N, T, m, n), feedforward (N, T, m), dx(0) (N, n) and z (N, k).
    """
    N, T, n, m = B.shape
    k = M.shape[0]
    K, feedforward = np.empty((N, T, m, n)), np.empty((N, T, m))
    dx, z = start.copy(), np.zeros((N, k))
    columns = np.empty((T, m, k + 1))
    P, S, H = np.empty((n, n)), np.empty((n, k + 1)), np.empty((k + 1, k + 1))
    for i in range(N):
        _start_from_the_end(Q[T], Lx[i, T], shared_x[T], M, M0[i], P, S, H)
        for t in range(T - 1, -1, -1):
            _step_back(
                A[i, t], B[i, t], defect[i, t], Q[t], R[t], Lx[i, t], Lu[i, t], shared_x[t], shared_u[t], damping[i],
                P, S, H, K[i, t], columns[t],
            )  # fmt: skip
        if free:
            _choose_start(P, S, H)
        _choose_parameters(S, H, dx[i], z[i], free)
        if free:
            for a in range(n):
                dx[i, a] = S[a, 0]
                for c in range(k):
                    dx[i, a] += S[a, c + 1] * z[i, c]
        for t in range(T):
            for a in range(m):
                feedforward[i, t, a] = columns[t, a, 0]
                for c in range(k):
                    feedforward[i, t, a] += columns[t, a, c + 1] * z[i, c]
    return K, feedforward, dx, z


@compiled
def _start_from_the_end(Q: Array, Lx: Array, shared: Array, M: Array, M0: Array, P: Array, S: Array, H: Array) -> None:
    n, q = S.shape
    for a in range(n):
        S[a, 0] = Lx[a]
        for b in range(n):
            P[a, b] = Q[a, b]
        for c in range(1, q):
            S[a, c] = shared[a, c - 1]
    H[0, 0] = 0.0
    for c in range(1, q):
        H[0, c] = H[c, 0] = M0[c - 1]
        for e in range(1, q):
            H[c, e] = M[c - 1, e - 1]


@compiled
def _step_back(
    A: Array, B: Array, defect: Array, Q: Array, R: Array, Lx: Array, Lu: Array, shared_x: Array, shared_u: Array,
    damping: float, P: Array, S: Array, H: Array, K: Array, columns: Array,
) -> None:  # fmt: skip
    """V_{t+1} to V_t, in place; the gain goes to K (m, n), the feedforward of each parameter to columns (m, k+1)."""
    (n, m), q = B.shape, S.shape[1]
    _shift(P, S, H, defect)
    PA, PB = _times(P, A), _times(P, B)
    Quu, Qux, Qu = _transposed_times(B, PB), _transposed_times(B, PA), _transposed_times(B, S)
    for a in range(m):
        Quu[a, a] += damping
        Qu[a, 0] += Lu[a]
        for b in range(m):
            Quu[a, b] += R[a, b]
        for c in range(1, q):
            Qu[a, c] += shared_u[a, c - 1]
        for b in range(n):
            K[a, b] = -Qux[a, b]
        for c in range(q):
            columns[a, c] = -Qu[a, c]
    _cholesky_solve(Quu, K, columns)
    _add_transposed_times(H, Qu, columns)
    before = _transposed_times(A, S)
    for a in range(n):
        for b in range(n):
            P[a, b] = Q[a, b]
        S[a, 0] = before[a, 0] + Lx[a]
        for c in range(1, q):
            S[a, c] = before[a, c] + shared_x[a, c - 1]
    _add_transposed_times(P, A, PA)
    _add_transposed_times(P, Qux, K)
    _add_transposed_times(S, Qux, columns)
    _symmetrise(P)


@compiled
def _shift(P: Array, S: Array, H: Array, defect: Array) -> None:
    """V(dx + defect) as a function of dx: S gains P defect in its first column, H the products of defect and S."""
    n, q = S.shape
    for a in range(n):
        if defect[a] != 0.0:
            for c in range(1, q):
                H[0, c] += S[a, c] * defect[a]
                H[c, 0] = H[0, c]
    for a in range(n):
        for b in range(n):
            S[a, 0] += P[a, b] * defect[b]


@compiled
def _choose_start(P: Array, S: Array, H: Array) -> None:
    """Minimise over dx(0) = -P^-1 S zeta, which replaces S."""
    factor, before, none = np.zeros_like(P), np.zeros_like(S), np.zeros((len(P), 0))
    for a in range(len(P)):
        for b in range(len(P)):
            factor[a, b] = P[a, b]
        for c in range(S.shape[1]):
            before[a, c], S[a, c] = S[a, c], -S[a, c]
    _cholesky_solve(factor, S, none)
    _add_transposed_times(H, before, S)


@compiled
def _choose_parameters(S: Array, H: Array, dx: Array, z: Array, free: bool) -> None:
    """Stationary z: H_zz z = -(H_z1 + S_z' dx(0))."""
    k = len(z)
    inner = np.zeros((k, k))
    for c in range(k):
        z[c] = -H[c + 1, 0]
        for e in range(k):
            inner[c, e] = H[c + 1, e + 1]
        if not free:
            for a in range(len(dx)):
                z[c] -= S[a, c + 1] * dx[a]
    _eliminate(inner, z)


@compiled
def _eliminate(M: Array, v: Array) -> None:
    """v <- M^-1 v by Gauss's elimination with partial pivoting, M overwritten; M need not be positive."""
    k = len(v)
    for c in range(k):
        pivot = c
        for a in range(c + 1, k):
            if abs(M[a, c]) > abs(M[pivot, c]):
                pivot = a
        v[c], v[pivot] = v[pivot], v[c]
        for e in range(k):
            M[c, e], M[pivot, e] = M[pivot, e], M[c, e]
        for a in range(c + 1, k):
            share = M[a, c] / M[c, c]
            v[a] -= share * v[c]
            for e in range(c + 1, k):
                M[a, e] -= share * M[c, e]
    for c in range(k - 1, -1, -1):
        for e in range(c + 1, k):
            v[c] -= M[c, e] * v[e]
        v[c] /= M[c, c]


@compiled
def _times(X: Array, Y: Array) -> Array:
    Z = np.zeros((X.shape[0], Y.shape[1]))
    for a in range(X.shape[0]):
        for b in range(X.shape[1]):
            for c in range(Y.shape[1]):
                Z[a, c] += X[a, b] * Y[b, c]
    return Z


@compiled
def _transposed_times(X: Array, Y: Array) -> Array:
    Z = np.zeros((X.shape[1], Y.shape[1]))
    _add_transposed_times(Z, X, Y)
    return Z


@compiled
def _add_transposed_times(Z: Array, X: Array, Y: Array) -> None:
    for b in range(X.shape[0]):
        for a in range(X.shape[1]):
            for c in range(Y.shape[1]):
                Z[a, c] += X[b, a] * Y[b, c]


@compiled
def _symmetrise(P: Array) -> None:
    for a in range(len(P)):
        for b in range(a):
            P[a, b] = P[b, a] = 0.5 * (P[a, b] + P[b, a])


@compiled
def _cholesky_solve(M: Array, X: Array, Y: Array) -> None:
    """X <- M^-1 X and Y <- M^-1 Y in place; M is overwritten by its Cholesky factor. nan where M is not positive."""
    for a in range(len(M)):
        for b in range(a + 1):
            for c in range(b):
                M[a, b] -= M[a, c] * M[b, c]
            M[a, b] = np.sqrt(M[a, a]) if a == b else M[a, b] / M[b, b]
    _substitute(M, X)
    _substitute(M, Y)


@compiled
def _substitute(M: Array, X: Array) -> None:
    m, q = X.shape
    for a in range(m):
        for b in range(a):
            for c in range(q):
                X[a, c] -= M[a, b] * X[b, c]
        for c in range(q):
            X[a, c] /= M[a, a]
    for a in range(m - 1, -1, -1):
        for b in range(a + 1, m):
            for c in range(q):
                X[a, c] -= M[b, a] * X[b, c]
        for c in range(q):
            X[a, c] /= M[a, a]

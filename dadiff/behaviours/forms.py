"""The projections in closed form: onto a subspace, in the metric of a covariance, by a recursion over blocks.

All act in scaled coordinates z = (tau - mean) / scale. In the metric of C, with R the covariance of the residual,

    P(z) = z - C G' (G C G' + R)^-1 (G z - g),

after the pins: they are known exactly, so that z takes their values, everything correlated with them moves along, and
C is what remains. In the identity metric nothing moves along.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dadiff.behaviours.projection import AffineMap
from dadiff.behaviours.stages import BlockTridiagonal, Stages, by_plan, transposed
from dadiff.errors import ConfigError, ExcitationError
from dadiff.trajectory.arrays import Array
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import null_space, numerical_rank, semidefinite_inverse


@dataclass(frozen=True)
class Rows:
    """Constraints G z = g + r with r ~ N(0, R), as dense matrices in scaled coordinates.

    Args:
        G: (*robots, q, d).
        g: (*robots, q).
        noise: V of shape (*robots, q, p) with R = V V', or None for R = 0.
    """

    G: np.ndarray = field(repr=False)
    g: np.ndarray = field(repr=False)
    noise: np.ndarray | None = field(default=None, repr=False)

    def for_each_plan(self) -> Rows:
        """With a dimension for the plans after the robots."""
        noise = None if self.noise is None else self.noise[..., None, :, :]
        return Rows(self.G[..., None, :, :], self.g[..., None, :], noise)

    def scaled(self, where: Coordinates) -> Rows:
        """From rows in physical units."""
        return Rows(self.G * where.scale, self.g - self.G @ where.mean, self.noise)


def _pinned_map(
    matrix: np.ndarray,
    centre: np.ndarray,
    lift: np.ndarray,
    places: np.ndarray,
    where: Coordinates,
    *,
    orthogonal: bool,
) -> AffineMap:
    """The map with the pinned entries exactly as given, and `lift` acting on values in physical units."""
    mean, scale = where.mean[places], where.scale[places]
    centre, lift = centre - lift @ (mean / scale), lift / scale
    matrix[..., places, :], centre[..., places] = 0, -mean / scale
    lift[..., places, :] = np.diag(1 / scale)
    return AffineMap(matrix, centre, lift, orthogonal)


def onto_rows(rows: Rows, places: np.ndarray, where: Coordinates) -> AffineMap:
    """Orthogonally onto {G z = g, z[places] = v}: the free entries onto the kernel of their columns of G.

    Raises:
        ConfigError: if the pins and the rows cannot hold together.
    """
    *robots, q, d = rows.G.shape
    free = np.setdiff1d(np.arange(d), places)
    Q, R = np.linalg.qr(transposed(rows.G[..., free]), mode="complete")
    if len(free) < q or _loses_rank(R[..., :q, :]):
        raise ConfigError(
            f"projection: {len(places)} pinned entries and {q} rows of dynamics cannot hold together; pin fewer entries"
        )
    basis, centre, lift = (
        np.zeros((*robots, d, len(free) - q)),
        np.zeros((*robots, d)),
        np.zeros((*robots, d, len(places))),
    )
    least = Q[..., :q] @ np.linalg.inv(transposed(R[..., :q, :]))  # G^+ on the free entries
    basis[..., free, :] = Q[..., q:]
    centre[..., free] = (least @ rows.g[..., None])[..., 0]
    lift[..., free, :] = -least @ rows.G[..., places]
    return _pinned_map(basis, centre, lift, places, where, orthogonal=True)


def _loses_rank(R: np.ndarray) -> bool:
    size = np.abs(np.einsum("...ii->...i", R))
    return bool((size.min(axis=-1) <= len(size) * np.finfo(np.float64).eps * size.max(axis=-1)).any())


def onto_span(basis: np.ndarray, origin: np.ndarray, places: np.ndarray, where: Coordinates) -> AffineMap:
    """Orthogonally onto {origin + basis h, z[places] = v}, in scaled coordinates.

    With E the rows of the pins and o the part of the origin across the basis, h = (E basis)^+ (v - E o) + N l, where N
    spans the kernel of E basis.

    Args:
        basis: (*robots, d, r), orthonormal.
        origin: (*robots, d).

    Raises:
        ExcitationError: if the set does not reach every value of the pins.
    """
    held = basis[..., places, :]
    if len(places) and (rank := numerical_rank(held)) < len(places):
        raise ExcitationError(
            f"projector: the pinned entries of the set (x(0), if it is fixed) span {rank} of {len(places)} dimensions, "
            "so they cannot be pinned; use initial_state: free or a recording that excites every state"
        )
    across = origin - (basis @ (transposed(basis) @ origin[..., None]))[..., 0]
    lift = basis @ np.linalg.pinv(held) if len(places) else np.zeros((*origin.shape, 0))
    free = basis @ null_space(held) if len(places) else basis.copy()
    centre = across - (lift @ across[..., places, None])[..., 0]
    return _pinned_map(free, centre, lift, places, where, orthogonal=True)


def in_metric(rows: Rows, metric: Covariance, places: np.ndarray, where: Coordinates) -> AffineMap:
    """P in the metric C, as dense matrices. Rows that C says to be certain are left as they are.

    Args:
        metric: C for all (d, d) or for each robot, or (*robots, plans, ...) with one for each plan.
    """
    rows = rows if metric.diagonal.ndim < rows.G.ndim else rows.for_each_plan()
    given, gain = metric.given(places)
    C, d = given.matrix, metric.size
    inner = rows.G @ C @ transposed(rows.G)
    inner = inner if rows.noise is None else inner + rows.noise @ transposed(rows.noise)
    K = C @ transposed(rows.G) @ semidefinite_inverse(inner, _rounding(rows.G, C))
    correct = np.eye(d) - K @ rows.G
    moved = np.eye(d) - _columns(gain, places, d)
    lift = gain.copy()
    moved[..., places, :], lift[..., places, :] = 0, np.eye(len(places))
    centre = (K @ rows.g[..., None])[..., 0]
    made = _pinned_map(correct @ moved, centre, correct @ lift, places, where, orthogonal=False)
    return made if rows.noise is None else replace(made, spread=K @ rows.noise)


def _rounding(G: np.ndarray, C: np.ndarray) -> np.ndarray:
    """What the diagonal of G C G' may be where it is 0 but for rounding, (..., q)."""
    deviation = np.sqrt(np.maximum(np.einsum("...ii->...i", C), 0))
    largest = (np.abs(G) @ deviation[..., None])[..., 0]
    return C.shape[-1] * np.finfo(np.float64).eps * np.square(largest)


def _columns(gain: np.ndarray, places: np.ndarray, d: int) -> np.ndarray:
    """gain E of shape (..., d, d)."""
    full = np.zeros((*gain.shape[:-1], d))
    full[..., places] = gain
    return full


@dataclass(frozen=True)
class Hold:
    """Only the pins: they take their values, and what is correlated with them moves along.

    Args:
        scale, mean: of the coordinates, (d,).
        places: (k,).
        gain: (*robots, d, k), in physical units.
    """

    scale: np.ndarray = field(repr=False)
    mean: np.ndarray = field(repr=False)
    places: np.ndarray = field(repr=False)
    gain: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, metric: Covariance, places: np.ndarray, where: Coordinates) -> Hold:
        """In the metric C, in scaled coordinates."""
        return cls(where.scale, where.mean, places, metric.rescaled(where.scale).given(places)[1])

    def given(self, values: np.ndarray) -> np.ndarray:
        """The values themselves."""
        return values

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """See `Form`."""
        return (self.pin(z * self.scale + self.mean, given) - self.mean) / self.scale

    def pin(self, tau: Array, values: Array) -> Array:
        """tau (*robots, plans, d) in physical units, with the pins held; overwrites its argument."""
        if len(self.places):
            tau = tau + (values - tau[..., self.places]) @ self.gain.swapaxes(-1, -2)
            tau[..., self.places] = values
        return tau


@dataclass(frozen=True)
class Blocks:
    """P for the stages of a dynamical system in O(T), in the metric C = diag(D) + U U' and with R = V V'.

    M = G diag(D) G' is block tridiagonal; with L = [G U, V] the rest follows from Woodbury's formula,

        (M + L L')^-1 r = M^-1 (r - L H' r),    H = M^-1 L (I + L' M^-1 L)^-1.

    Everything is in physical units but what goes in and comes out.

    Args:
        hold: the pins, and the coordinates.
        factor: U of shape (*robots, d, p), given the pins.
        noise: V of shape (*robots, nT, q), in the order of `_rows`.
        low_rank, correction: L and H, (*robots, nT, p + q), likewise.
    """

    layout: TrajectoryLayout
    stages: Stages
    factorised: BlockTridiagonal
    hold: Hold
    factor: np.ndarray = field(repr=False)
    noise: np.ndarray = field(repr=False)
    low_rank: np.ndarray = field(repr=False)
    correction: np.ndarray = field(repr=False)

    @classmethod
    def of(
        cls,
        layout: TrajectoryLayout,
        stages: Stages,
        metric: Covariance,
        places: np.ndarray,
        where: Coordinates,
        noise: np.ndarray | None = None,
    ) -> Blocks:
        """Factorise once.

        Args:
            metric: C in scaled coordinates.
            noise: V of shape (*robots, nT, q), or None for R = 0.
        """
        if metric.diagonal.ndim > len(stages.robots) + 1:
            raise ConfigError(
                "projection: a metric for each plan needs dense matrices, and these trajectories are too long for "
                "them; use one metric for all plans"
            )
        given, gain = metric.rescaled(where.scale).given(places)
        hold = Hold(where.scale, where.mean, places, gain)
        factorised = BlockTridiagonal.of(stages, layout, given.diagonal)
        linear = Stages(stages.A, stages.B, np.zeros_like(stages.c))
        factor = np.broadcast_to(given.factor, (*stages.robots, *given.factor.shape[-2:]))
        G_U = transposed(_rows(linear.residual(layout, transposed(factor))))
        noise = np.zeros((*G_U.shape[:-1], 0)) if noise is None else noise
        low_rank = np.concatenate([G_U, noise], axis=-1)
        solved = transposed(_rows(factorised.solve(_stagewise(transposed(low_rank), layout))[0]))
        small = np.eye(low_rank.shape[-1]) + transposed(low_rank) @ solved
        correction = transposed(np.linalg.solve(small, transposed(solved)))
        return cls(layout, stages, factorised, hold, given.factor, noise, low_rank, correction)

    def given(self, values: np.ndarray) -> np.ndarray:
        """The values themselves."""
        return values

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """See `Form`."""
        tau = self.hold.pin(z * self.hold.scale + self.hold.mean, given)
        residual = self.stages.residual(self.layout, tau)
        if noise is not None and self.noise.shape[-1]:
            drawn = noise[..., : self.noise.shape[-1]] @ transposed(self.noise)
            residual = residual - _stagewise(drawn, self.layout)
        if self.low_rank.shape[-1]:
            known = (_rows(residual) @ self.correction) @ transposed(self.low_rank)
            residual = residual - _stagewise(known, self.layout)
        multipliers, moved = self.factorised.solve(residual)
        tau = tau - by_plan(self.layout, *moved)
        if self.factor.shape[-1]:
            pull = self.stages.adjoint(self.layout, multipliers)
            tau = tau - (pull @ self.factor) @ transposed(self.factor)
        return (tau - self.hold.mean) / self.hold.scale


def _rows(stagewise: Array) -> Array:
    """(*robots, T, plans, n) to (*robots, plans, nT)."""
    turned = stagewise.swapaxes(-2, -3)
    return turned.reshape(*turned.shape[:-2], turned.shape[-2] * turned.shape[-1])


def _stagewise(rows: Array, layout: TrajectoryLayout) -> Array:
    """(*robots, plans, nT) to (*robots, T, plans, n)."""
    return rows.reshape(*rows.shape[:-1], layout.horizon, layout.state_dim).swapaxes(-2, -3)

"""How uncertain the clean estimate is: C_i = Cov(tau_0 | tau_i, E).

Given E, demonstrations spread about their mean with a covariance Sigma. Were that law Gaussian,

    C_i = (Sigma^-1 + alpha_bar_i / (1 - alpha_bar_i) I)^-1,

which one eigendecomposition of Sigma gives for every i. A network is also wrong by a bias that does not shrink with i:
hence a floor, C_i + floor Sigma. Sigma says nothing of robots unlike those of the demonstrations: hence a shrinkage of
Sigma towards equal variances of standardised channels. Everything is in the sampler's coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dadiff.errors import ConfigError, NotApplicableError, ShapeError
from dadiff.trajectory.coordinates import Coordinates, standardised
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import regression

KEPT = 64  # covariances that are held, the oldest given up first
LEAST_SPREAD = 1e-10
"""Of the channels' variances: what Sigma is shrunk towards at least, where demonstrations do not spread given E."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Sigma, and the units in which it may be shrunk.

    Args:
        covariance: Sigma of shape (*robots, d, d).
        deviation: of the standardised channels, entry by entry, (d,).
        unit: the length of a physical unit, entry by entry, (d,).
        layout: of trajectories, for weights of states and inputs.
    """

    covariance: np.ndarray = field(repr=False)
    deviation: np.ndarray = field(repr=False)
    unit: np.ndarray = field(repr=False)
    layout: TrajectoryLayout | None = None
    _spectra: dict[float, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)
    _made: dict[tuple[object, ...], Covariance] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        d = self.deviation.shape[-1]
        if self.covariance.shape[-2:] != (d, d) or self.unit.shape != self.deviation.shape:
            raise ShapeError(
                f"estimate: Sigma has shape {self.covariance.shape}, deviations {self.deviation.shape}, units "
                f"{self.unit.shape}; expected (..., d, d), (d,), (d,)"
            )

    @property
    def size(self) -> int:
        """d."""
        return self.deviation.shape[-1]

    @classmethod
    def of_demonstrations(
        cls, layout: TrajectoryLayout, coordinates: Coordinates, trajectories: np.ndarray, environment: np.ndarray
    ) -> Estimate:
        """Sigma of what linear regression on E leaves of the demonstrations.

        Args:
            trajectories: (N, d), physical units.
            environment: E, (N, c).
        """
        _, _, residual = regression(coordinates.to_scaled(trajectories), environment)
        freedom = max(len(residual) - environment.shape[-1] - 1, 1)
        return cls.of_covariance(layout, coordinates, trajectories, residual.T @ residual / freedom)

    @classmethod
    def of_covariance(
        cls, layout: TrajectoryLayout, coordinates: Coordinates, trajectories: np.ndarray, covariance: np.ndarray
    ) -> Estimate:
        """A known Sigma (*robots, d, d) in the given coordinates; the channels' deviations from trajectories (N, d)."""
        deviation = standardised(layout, trajectories).scale / coordinates.scale
        return cls(covariance, deviation, 1 / coordinates.scale, layout)

    def at(self, alpha_bar: float, floor: float = 0.0, shrinkage: float = 0.0, directions: int = 0) -> Covariance:
        """C_i + floor Sigma where alpha_bar_i is alpha_bar; one object for equal arguments.

        Args:
            shrinkage: s in (1 - s) Sigma + s v D^2, with D the deviations of the channels and v the mean variance of
                D^-1 Sigma D^-1, at least LEAST_SPREAD: where demonstrations do not spread, equal variances remain.
            directions: how many leading directions are kept beside a diagonal, which makes long horizons cheap; 0 keeps
                all.

        Raises:
            ConfigError: if demonstrations do not spread at all given E and shrinkage is 0.
        """
        return self._kept((alpha_bar, floor, shrinkage, directions), self._at)

    def at_step(self, i: int, floor: float = 0.0, shrinkage: float = 0.0, directions: int = 0) -> Covariance:
        """C_i + floor Sigma with C_i as measured at step i, see `dadiff.diffusion.measured`.

        Raises:
            NotApplicableError: if nothing was measured.
        """
        raise NotApplicableError(
            "enforcement: metric=measured weighs by a network's errors on demonstrations, and none were measured; use "
            "metric=estimate"
        )

    def diagonal(self, alpha_bar: float, floor: float = 0.0) -> Covariance:
        """C_i + floor Sigma of diag(Sigma): each entry for itself."""
        return self._kept((alpha_bar, floor), self._diagonal)

    def _kept(self, key: tuple[object, ...], make: Callable[..., Covariance]) -> Covariance:
        if key not in self._made:
            if len(self._made) == KEPT:
                del self._made[next(iter(self._made))]
            self._made[key] = make(*key)
        return self._made[key]

    def _diagonal(self, alpha_bar: float, floor: float) -> Covariance:
        variance = np.einsum("...ii->...i", self.covariance)
        _check_spread(variance)
        return Covariance.diagonal_of(_posterior(variance, alpha_bar) + floor * variance)

    @cached_property
    def standardised(self) -> Covariance:
        """Equal variances of the standardised channels."""
        return Covariance.diagonal_of(self.deviation**2)

    @cached_property
    def physical(self) -> Covariance:
        """Equal variances in physical units."""
        return Covariance.diagonal_of(self.unit**2)

    def weighted(self, state_weight: float, input_weight: float) -> Covariance:
        """Variances 1 / q of states and 1 / r of inputs, in physical units.

        Raises:
            ConfigError: if it is not known which entries are states.
        """
        if self.layout is None:
            raise ConfigError("estimate: which entries are states is not known; make it with a layout")
        weight = np.full(self.size, input_weight)
        weight[self.layout.all_states] = state_weight
        return self._kept(
            ("weighted", state_weight, input_weight), lambda *_: Covariance.diagonal_of(self.unit**2 / weight)
        )

    def _at(self, alpha_bar: float, floor: float, shrinkage: float, directions: int) -> Covariance:
        variance, basis = self._spectrum(shrinkage)
        remaining = _posterior(variance, alpha_bar) + floor * variance
        if directions:
            return Covariance.of_spectrum(remaining, basis, directions)
        return Covariance(np.zeros(basis.shape[:-1]), basis * np.sqrt(remaining)[..., None, :])

    def _spectrum(self, shrinkage: float) -> tuple[np.ndarray, np.ndarray]:
        """Variances (*robots, d) and directions (*robots, d, d) of Sigma after shrinkage."""
        if shrinkage not in self._spectra:
            across = self.covariance / self.deviation[:, None] / self.deviation
            mean = np.maximum(np.einsum("...ii->...", across) / len(self.deviation), LEAST_SPREAD)
            equal = mean[..., None, None] * np.diag(self.deviation**2)
            values, vectors = np.linalg.eigh((1 - shrinkage) * self.covariance + shrinkage * equal)
            rounding = values.shape[-1] * np.finfo(np.float64).eps * values[..., -1:]
            values = np.where(values > rounding, values, 0)
            _check_spread(values)
            self._spectra[shrinkage] = values, vectors
        return self._spectra[shrinkage]


def _check_spread(variance: np.ndarray) -> None:
    if not variance.any(axis=-1).all():
        raise ConfigError(
            "estimate: demonstrations do not spread at all given E, so nothing says which directions to trust; use "
            "enforcement.shrinkage > 0, or enforcement.metric=standardised"
        )


def _posterior(variance: np.ndarray, alpha_bar: float) -> np.ndarray:
    """(1 / variance + alpha_bar / (1 - alpha_bar))^-1; finite for all alpha_bar in [0, 1]."""
    noise = 1 - alpha_bar
    total = alpha_bar * variance + noise
    return np.divide(noise * variance, total, out=np.zeros_like(variance), where=total > 0)

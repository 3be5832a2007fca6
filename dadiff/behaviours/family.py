"""A family of robots as prior knowledge of one of them: empirical Bayes.

Demonstrations of many robots say which dynamics occur, theta = [A B]' ~ N(mean, Lambda), and how noisy they are; a
short recording of one robot then says which it is. EM for the hierarchical linear model x(t+1)' = [x(t); u(t)]' theta_k
+ w(t)', every demonstration k standing for a robot of its own: what is expected of each is Bayesian least squares, and
the maximisation takes the mean and the spread of that.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from dadiff.behaviours.least_squares import Transitions, least_squares
from dadiff.behaviours.sets import InitialState, Uncertain
from dadiff.behaviours.stages import Stages, transposed
from dadiff.errors import ConfigError
from dadiff.systems import Recording, System
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import semidefinite_root

ITERATIONS = 60
AT_MOST = 1000
"""Demonstrations that a prior is learned from, and that a residual is averaged over."""
LEAST = 1e-12
"""Of the mean variance: what Lambda is given on its diagonal, so that it can be inverted."""
NOISE_ITERATIONS = 20
ROUNDING = 1e-13
"""Of the mean square of x(t+1): the least noise."""


@dataclass(frozen=True)
class Moments:
    """Phi'Phi (..., p, p), Phi'Y (..., p, n), the squares of Y (..., n) and the number of rows."""

    square: np.ndarray = field(repr=False)
    cross: np.ndarray = field(repr=False)
    power: np.ndarray = field(repr=False)
    count: int

    @classmethod
    def of(cls, data: Transitions) -> Moments:
        """Of transitions (..., count, n)."""
        Phi = np.concatenate([data.x, data.u], axis=-1)
        Y = data.following
        return cls(transposed(Phi) @ Phi, transposed(Phi) @ Y, np.square(Y).sum(axis=-2), Phi.shape[-2])


@dataclass(frozen=True)
class Belief:
    """theta ~ N(mean, covariance), theta = [A B]' row by row; a prior, or what is left of it after data.

    Args:
        mean: (*robots, p n).
        covariance: (*robots, p n, p n).
        noise: variance of w(t), (*robots, n).
    """

    mean: np.ndarray = field(repr=False)
    covariance: np.ndarray = field(repr=False)
    noise: np.ndarray = field(repr=False)

    def given(self, seen: Moments, noise: np.ndarray) -> Belief:
        """After transitions with process noise of variance `noise` (..., n): Bayesian least squares."""
        n = noise.shape[-1]
        rows = seen.square.shape[-1] * n
        precision = np.eye(n) / noise[..., None, :]
        weighed = seen.square[..., :, None, :, None] * precision[..., None, :, None, :]
        information = weighed.reshape(*weighed.shape[:-4], rows, rows)
        pull = (seen.cross / noise[..., None, :]).reshape(*seen.cross.shape[:-2], rows)
        before = np.linalg.inv(self.covariance)
        covariance = np.linalg.inv(before + information)
        mean = covariance @ ((before @ self.mean[..., None])[..., 0] + pull)[..., None]
        return Belief(mean[..., 0], (covariance + transposed(covariance)) / 2, noise)

    def noise_of(self, seen: Moments) -> np.ndarray:
        """The expected variance of w(t) in transitions (..., n); more than rounding."""
        p, n = seen.cross.shape[-2:]
        theta = self.mean.reshape(*self.mean.shape[:-1], p, n)
        open_ = self.covariance.reshape(*self.covariance.shape[:-2], p, n, p, n)
        explained = np.einsum("...ai,...ab,...bi->...i", theta, seen.square, theta, optimize=True)
        unsure = np.einsum("...ab,...aibi->...i", seen.square, open_, optimize=True)
        left = seen.power - 2 * (theta * seen.cross).sum(axis=-2) + explained + unsure
        return np.maximum(left, ROUNDING * seen.power + np.finfo(np.float64).tiny) / seen.count

    def stages(self, layout: TrajectoryLayout) -> Stages:
        """The mean dynamics, at every stage."""
        n = layout.state_dim
        theta = transposed(self.mean.reshape(*self.mean.shape[:-1], n + layout.input_dim, n))
        return Stages.constant(theta[..., :n], theta[..., n:], None, layout.horizon)

    def residual_spread(self, layout: TrajectoryLayout, trajectories: np.ndarray) -> np.ndarray:
        """V with V V' = R, the covariance of G tau - g that is left open, averaged over trajectories (N, d)."""
        x, u = layout.split(trajectories[:AT_MOST])
        phi = np.concatenate([x[..., :-1, :], u], axis=-1)
        n, p, T = layout.state_dim, phi.shape[-1], layout.horizon
        second = np.einsum("kta,ksb->tsab", phi, phi, optimize=True) / len(phi)
        open_ = self.covariance.reshape(*self.covariance.shape[:-2], p, n, p, n)
        R = np.einsum("tsab,...aibj->...tisj", second, open_, optimize=True)
        return semidefinite_root(R.reshape(*R.shape[:-4], T * n, T * n))


def prior(layout: TrajectoryLayout, trajectories: np.ndarray) -> Belief:
    """Which dynamics occur in demonstrations (N, d) of many robots.

    Raises:
        ConfigError: if there are fewer than two.
    """
    if len(trajectories) < 2:
        raise ConfigError("projector identified_family: a family is learned from the demonstrations of many robots")
    states, inputs = layout.split(trajectories[:: -(-len(trajectories) // AT_MOST)])
    each = Transitions.of(states[:, None], inputs[:, None])
    pooled, seen = least_squares(Transitions.of(states, inputs)), Moments.of(each)
    mean = transposed(np.concatenate([pooled.A, pooled.B], axis=-1)).ravel()
    belief = Belief(mean, np.eye(len(mean)), pooled.noise)
    for _ in range(ITERATIONS):
        belief = _maximised(belief.given(seen, belief.noise), seen)
    return belief


def _maximised(each: Belief, seen: Moments) -> Belief:
    """Mean and spread of what is believed of each robot, and the noise that is left: the step M of EM."""
    mean = each.mean.mean(axis=0)
    apart = each.mean - mean
    covariance = (each.covariance + apart[:, :, None] * apart[:, None, :]).mean(axis=0)
    covariance += LEAST * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    return Belief(mean, covariance, each.noise_of(seen).mean(axis=0))


def posterior(usual: Belief, seen: Moments) -> Belief:
    """What is believed of one robot, or of several, after their transitions, whose noise is estimated along."""
    belief = usual.given(seen, np.broadcast_to(usual.noise, seen.power.shape))
    for _ in range(NOISE_ITERATIONS):
        belief = usual.given(seen, belief.noise_of(seen))
    return belief


@dataclass(frozen=True)
class IdentifiedFamily:
    """One robot's dynamics from a short recording, and from what demonstrations of its family say is usual.

    The posterior of empirical Bayes, each direction trusted by how well it is known, see `Uncertain`; the recording may
    be too short to identify anything alone. Robots from outside the family are pulled towards it, the less the more is
    recorded of them.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        inflation: of the family's covariance, for robots that are less usual.
    """

    initial_state: InitialState = "free"
    inflation: float = 1.0
    needs: ClassVar[frozenset[str]] = frozenset({"recording", "demonstrations"})

    def __post_init__(self) -> None:
        if not 0 < self.inflation < np.inf:
            raise ConfigError(f"projector: inflation is {self.inflation}; it must be positive and finite")

    def fit(
        self,
        layout: TrajectoryLayout,
        system: System | None = None,
        recording: Recording | None = None,
        demonstrations: np.ndarray | None = None,
    ) -> Uncertain:
        """The trajectories of the expected dynamics, and the covariance of the residual."""
        if recording is None or demonstrations is None:
            missing = "recording" if recording is None else "dataset"
            raise ConfigError(
                f"projector identified_family needs a {missing}, and none is given; choose one with {missing}=..."
            )
        usual = prior(layout, demonstrations)
        widened = Belief(usual.mean, self.inflation * usual.covariance, usual.noise)
        belief = posterior(widened, Moments.of(Transitions.of(recording.states, recording.inputs)))
        spread = belief.residual_spread(layout, demonstrations)
        deviation = float(np.sqrt(np.square(spread).sum(axis=-1).mean()))
        notes = {"rank": layout.rank, "residual_deviation": deviation}
        return Uncertain(layout, belief.stages(layout), spread, notes=notes)

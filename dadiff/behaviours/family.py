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

from dadiff.behaviours.least_squares import Offset, Transitions, least_squares
from dadiff.behaviours.projector import RECORDING, Fitted, Sources, told
from dadiff.behaviours.sets import InitialState, Uncertain
from dadiff.behaviours.stages import Stages, transposed
from dadiff.errors import ConfigError
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
    def of(cls, data: Transitions, *, constant: bool = False) -> Moments:
        """Of transitions (..., count, n), with a 1 beside x and u where there is an offset to be found."""
        Phi = np.concatenate([data.x, data.u, np.ones((*data.x.shape[:-1], int(constant)))], axis=-1)
        Y = data.following
        return cls(transposed(Phi) @ Phi, transposed(Phi) @ Y, np.square(Y).sum(axis=-2), Phi.shape[-2])


@dataclass(frozen=True)
class Belief:
    """theta ~ N(mean, covariance), theta = [A B]' or [A B c]' row by row; a prior, or what is left of it after data.

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
        n, m = layout.state_dim, layout.input_dim
        theta = transposed(self.mean.reshape(*self.mean.shape[:-1], -1, n))
        c = theta[..., n + m] if theta.shape[-1] > n + m else None
        return Stages.constant(theta[..., :n], theta[..., n : n + m], c, layout.horizon)

    def residual_spread(self, layout: TrajectoryLayout, trajectories: np.ndarray) -> np.ndarray:
        """V with V V' = R, the covariance of G tau - g that is left open, averaged over trajectories (N, d)."""
        x, u = layout.split(trajectories[:AT_MOST])
        n, p, T = layout.state_dim, self.mean.shape[-1] // layout.state_dim, layout.horizon
        ones = np.ones((*u.shape[:-1], p - n - layout.input_dim))
        phi = np.concatenate([x[..., :-1, :], u, ones], axis=-1)
        second = np.einsum("kta,ksb->tsab", phi, phi, optimize=True) / len(phi)
        open_ = self.covariance.reshape(*self.covariance.shape[:-2], p, n, p, n)
        R = np.einsum("tsab,...aibj->...tisj", second, open_, optimize=True)
        return semidefinite_root(R.reshape(*R.shape[:-4], T * n, T * n))


def prior(
    layout: TrajectoryLayout, trajectories: np.ndarray, *, constant: bool = False, known: np.ndarray | None = None
) -> Belief:
    """Which dynamics occur in demonstrations (N, d) of many robots.

    Args:
        constant: whether they have offsets that are to be found, each robot its own.
        known: the offset (n,) that all of them have.

    Raises:
        ConfigError: if there are fewer than two.
    """
    if len(trajectories) < 2:
        raise ConfigError("projector identified_family: a family is learned from the demonstrations of many robots")
    states, inputs = layout.split(trajectories[:: -(-len(trajectories) // AT_MOST)])
    c = np.zeros(layout.state_dim) if known is None else known
    each, together = Transitions.of(states[:, None], inputs[:, None]).less(c), Transitions.of(states, inputs).less(c)
    offset: Offset = "estimated" if constant else "none"
    pooled, seen = least_squares(together, offset), Moments.of(each, constant=constant)
    found = [pooled.A, pooled.B, *([pooled.c[..., None]] if constant else [])]
    mean = transposed(np.concatenate(found, axis=-1)).ravel()
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
class Channels:
    """States and inputs about a centre, each scaled to one size: what is found does not depend on units or origin.

    Args:
        centre_x, size_x: (n,).
        centre_u, size_u: (m,).
    """

    centre_x: np.ndarray = field(repr=False)
    size_x: np.ndarray = field(repr=False)
    centre_u: np.ndarray = field(repr=False)
    size_u: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, layout: TrajectoryLayout, trajectories: np.ndarray, *, centred: bool) -> Channels:
        """Those of trajectories (N, d): about their mean, or about 0."""
        found: list[np.ndarray] = []
        for values in layout.split(trajectories):
            centre = values.mean(axis=(0, 1)) if centred else np.zeros(values.shape[-1])
            size = np.sqrt(np.square(values - centre).mean(axis=(0, 1)))
            found += [centre, np.where(size > 0, size, 1.0)]
        return cls(*found)

    def scaled(self, data: Transitions) -> Transitions:
        """Transitions in these channels."""
        x, following = ((values - self.centre_x) / self.size_x for values in (data.x, data.following))
        return Transitions(x, (data.u - self.centre_u) / self.size_u, following)

    def scaled_trajectories(self, layout: TrajectoryLayout, tau: np.ndarray) -> np.ndarray:
        """Trajectories (N, d) in these channels."""
        x, u = layout.split(tau)
        return layout.flatten((x - self.centre_x) / self.size_x, (u - self.centre_u) / self.size_u)

    def physical(self, stages: Stages, c: np.ndarray) -> Stages:
        """Stages in physical units, with a further offset c (*robots, n)."""
        A = self.size_x[:, None] * stages.A / self.size_x
        B = self.size_x[:, None] * stages.B / self.size_u
        moved = self.centre_x - A @ self.centre_x - B @ self.centre_u
        return Stages(A, B, self.size_x * stages.c + moved + c[..., None, :])


def disturbances(layout: TrajectoryLayout, trajectories: np.ndarray, *, family: bool) -> np.ndarray:
    """The process noise of demonstrations (N, d), (N, nT): x(t+1) less A x(t) + B u(t) + c.

    Args:
        family: they are of many robots, each of which is known as well as its demonstration and the others together
            say, by empirical Bayes. Else they are of one, which least squares find.
    """
    if not family:
        found = least_squares(Transitions.of(*layout.split(trajectories)), "estimated")
        G, g = found.stages(layout.horizon).matrix(layout)
        return trajectories @ G.T - g
    channels = Channels.of(layout, trajectories, centred=True)
    states, inputs = layout.split(channels.scaled_trajectories(layout, trajectories))
    usual = prior(layout, layout.flatten(states, inputs), constant=True)
    each = Transitions.of(states[:, None], inputs[:, None])
    theta = usual.given(Moments.of(each, constant=True), usual.noise).mean.reshape(len(states), -1, layout.state_dim)
    phi = np.concatenate([each.x, each.u, np.ones((*each.x.shape[:-1], 1))], axis=-1)
    return ((each.following - phi @ theta) * channels.size_x).reshape(len(states), -1)


@dataclass(frozen=True)
class IdentifiedFamily(Fitted[Uncertain]):
    """One robot's dynamics from a short recording, and from what demonstrations of its family say is usual.

    The posterior of empirical Bayes, each direction trusted by how well it is known, see `Uncertain`; the recording may
    be too short to identify anything alone. Robots from outside the family are pulled towards it, the less the more is
    recorded of them.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        inflation: of the family's covariance, for robots that are less usual.
        offset: each robot's c is `none`, `estimated` as A and B are, or `known` and the same for all robots.
    """

    label: ClassVar[str] = "identified_family"
    initial_state: InitialState = "free"
    inflation: float = 1.0
    offset: Offset = "none"

    @property
    def needs(self) -> frozenset[str]:
        """A recording and demonstrations, and the system whose offset is known."""
        return told(RECORDING | {"demonstrations"}, self.offset)

    def __post_init__(self) -> None:
        if not 0 < self.inflation < np.inf:
            raise ConfigError(f"projector: inflation is {self.inflation}; it must be positive and finite")

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Uncertain:
        """The trajectories of the expected dynamics, and the covariance of the residual."""
        recording, demonstrations = sources.recording, sources.demonstrations
        c, constant = self._known(layout, sources), self.offset == "estimated"
        channels = Channels.of(layout, demonstrations, centred=constant)
        shown, size = channels.scaled_trajectories(layout, demonstrations), channels.size_x
        seen = channels.scaled(Transitions.of(recording.states, recording.inputs)).less(c / size)
        usual = prior(layout, shown, constant=constant, known=c / size)
        widened = Belief(usual.mean, self.inflation * usual.covariance, usual.noise)
        belief = posterior(widened, Moments.of(seen, constant=constant))
        spread = np.tile(size, layout.horizon)[:, None] * belief.residual_spread(layout, shown)
        deviation = float(np.sqrt(np.square(spread).sum(axis=-1).mean()))
        notes = {"rank": layout.rank, "residual_deviation": deviation}
        return Uncertain(layout, channels.physical(belief.stages(layout), c), spread, notes=notes)

    def _known(self, layout: TrajectoryLayout, sources: Sources) -> np.ndarray:
        """c (n,), 0 unless it is known."""
        if (known := sources.offset(self.offset)) is None:
            return np.zeros(layout.state_dim)
        c = known.reshape(-1, layout.state_dim)
        if np.ptp(c, axis=0).any():
            raise ConfigError(
                "projector identified_family: the robots' offsets differ, and those of the demonstrations are not "
                "known; use projector.offset=estimated"
            )
        return np.asarray(c[0])

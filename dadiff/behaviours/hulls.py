"""What the windows of a recording span: the trajectories of a linear system, or of one with an offset.

Of x(t+1) = A x(t) + B u(t) every combination H g of windows is a trajectory (Willems et al. 2005). With an offset c it
is one if the weights add up to 1, and every trajectory is such a combination if [x(0); u(0:T-1); 1] of the windows have
rank n + mT + 1 (Berberich, Koehler, Mueller & Allgoewer 2022, "Linear tracking MPC for nonlinear systems, part II",
Theorem 1). With h the mean window,

    { H g : 1'g = 1 } = h + image(H - h 1'),

and since (H - h 1') 1 = 0, that condition is rank n + mT of the centred [x(0); u(0:T-1)]. Where the drift h from rest,
the response to c alone, is known, it stands in place of the mean. Under noise the leading directions are kept: those of
H - h 1' in scaled channels, so that neither units nor origin decide which. States are taken over the size of their
steps, where noise is; inputs count more, since they are known exactly (Golub, Hoffman & Stewart 1987).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dadiff.behaviours.least_squares import Offset
from dadiff.behaviours.sets import Span
from dadiff.errors import ExcitationError
from dadiff.systems import Recording, System
from dadiff.trajectory.hankel import trajectory_matrix
from dadiff.trajectory.layout import TrajectoryLayout
from dadiff.trajectory.subspace import numerical_rank, rank_tolerance

INPUT_WEIGHT = 10.0
"""How much more inputs count than the steps of states. On the double integrator, medians over five recordings each of
S = 100 to 600 at noise 0.01 and 0.05: as near to the true set as without scaling; with 1 up to seven times as far."""


@dataclass(frozen=True)
class Hull:
    """The windows' directions, by how much of them there is in scaled channels.

    Args:
        layout: of the windows.
        origin: h of shape (*robots, d), or None for 0.
        scale: of each entry of tau, (*robots, d): the same for a channel at all times.
        directions: U of shape (*robots, d, k), orthonormal in scaled channels.
        sizes: the singular values s, (*robots, k).
        rank: how many of them are not rounding.
    """

    layout: TrajectoryLayout
    origin: np.ndarray | None = field(repr=False)
    scale: np.ndarray = field(repr=False)
    directions: np.ndarray = field(repr=False)
    sizes: np.ndarray = field(repr=False)
    rank: int

    @classmethod
    def of(cls, recording: Recording, layout: TrajectoryLayout, offset: Offset, system: System | None) -> Hull:
        """Of all windows of a recording.

        Args:
            offset: `estimated` about the mean window, `known` about the drift of the system, `none` about 0.

        Raises:
            ExcitationError: if x(0) and u(0:T-1) of the windows do not span n + mT dimensions (Willems' condition,
                which noise cannot feign: under feedback alone u(0) follows from x(0)), or the rank differs between
                robots.
        """
        H = trajectory_matrix(recording.states, recording.inputs, layout, spare=int(offset == "estimated"))
        origin = _origin(H, layout, offset, system)
        about = H if origin is None else H - origin[..., None]
        scale = _channel_sizes(recording, layout)
        scaled = about / scale[..., None]
        _check_excited(scaled, layout)
        U, s, _ = np.linalg.svd(scaled, full_matrices=False)
        moved = np.zeros(scale.shape) if origin is None else origin / scale
        size = np.hypot(s[..., 0], np.sqrt(H.shape[-1]) * np.linalg.norm(moved, axis=-1))
        return cls(layout, origin, scale, U, s, _common_rank(s, size, H.shape))

    def span(self, rank: int) -> Span:
        """The leading directions, in physical units."""
        basis = self.scale[..., None] * self.directions[..., :rank]
        return Span(self.layout, basis, self.origin, notes={"rank": rank, "singular_value_gap": self.gap(rank)})

    def gap(self, rank: int) -> float:
        """s_r / s_{r+1}, inf where nothing follows; of a fleet, the smallest."""
        if rank >= self.sizes.shape[-1]:
            return float("inf")
        with np.errstate(divide="ignore"):
            return float((self.sizes[..., rank - 1] / self.sizes[..., rank]).min())


def _origin(H: np.ndarray, layout: TrajectoryLayout, offset: Offset, system: System | None) -> np.ndarray | None:
    if offset == "estimated":
        return H.mean(axis=-1)
    return None if offset == "none" or system is None else drift(system, layout)


def drift(system: System, layout: TrajectoryLayout) -> np.ndarray:
    """The trajectory (*robots, d) from x(0) = 0 without inputs: what the offset alone does."""
    still = np.zeros((*system.robots, layout.horizon, layout.input_dim))
    return layout.flatten(system.simulate(np.zeros((*system.robots, layout.state_dim)), still), still)


def _channel_sizes(recording: Recording, layout: TrajectoryLayout) -> np.ndarray:
    """What each entry of tau is taken over, (*robots, d): the same at all times; 1 where nothing moves."""
    steps = np.sqrt(np.nanmean(np.square(np.diff(recording.states, axis=-2)), axis=(-3, -2)))
    inputs = np.nanstd(recording.inputs, axis=(-3, -2)) / INPUT_WEIGHT
    x, u = (np.where(size > 0, size, 1.0)[..., None, :] for size in (steps, inputs))
    return layout.flatten(np.repeat(x, layout.horizon + 1, axis=-2), np.repeat(u, layout.horizon, axis=-2))


def _check_excited(H: np.ndarray, layout: TrajectoryLayout) -> None:
    sources = np.concatenate([H[..., layout.initial_state, :], H[..., layout.all_inputs, :]], axis=-2)
    if (found := numerical_rank(sources)) < layout.rank:
        raise ExcitationError(
            f"recording: x(0) and u(0:T-1) of its windows have rank {found}, n + mT = {layout.rank} are needed: the "
            "inputs do not excite the system; record with inputs that vary independently of the state (not under "
            "feedback alone)"
        )


def _common_rank(s: np.ndarray, size: np.ndarray, shape: tuple[int, ...]) -> int:
    """How many singular values (*robots, k) are more than the rounding of windows of a size (*robots,)."""
    ranks = (s > rank_tolerance(size[..., None], shape)).sum(axis=-1)
    if (rank := int(ranks.min())) < ranks.max():
        raise ExcitationError(
            f"recording: the robots' Hankel matrices have ranks from {rank} to {int(ranks.max())}; "
            "give every robot a recording of the same length and noise"
        )
    return rank

"""Projectors onto what the windows of a recording span: nothing is identified."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import ClassVar

from dadiff.behaviours.hulls import Hull
from dadiff.behaviours.least_squares import Offset
from dadiff.behaviours.projector import RECORDING, Fitted, Sources, told
from dadiff.behaviours.sets import InitialState, Span
from dadiff.errors import ExcitationError
from dadiff.trajectory.hankel import identity_length
from dadiff.trajectory.layout import TrajectoryLayout

SMALL_GAP = 2.0
"""Of singular values s_r / s_{r+1}: below it a truncated Hankel matrix is one of noise as well."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Hankel(Fitted[Span]):
    """P = H H† with H = [H_{T+1}(x); H_T(u)], literally eq. (11).

    Process noise gives every column a direction of its own; from d columns on H H† is the identity and the
    projector does nothing. That is refused unless `allow_identity`.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        allow_identity: also where it projects nothing.
        offset: of the dynamics: `none`; `estimated`: the affine hull of the columns; or `known`: about the system's
            drift. See `dadiff.behaviours.hulls`.
    """

    label: ClassVar[str] = "hankel"
    initial_state: InitialState = "free"
    allow_identity: bool = False
    offset: Offset = "none"

    @property
    def needs(self) -> frozenset[str]:
        """A recording, and the system whose offset is known."""
        return told(RECORDING, self.offset)

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Span:
        """The image of H."""
        recording = sources.recording
        hull = Hull.of(recording, layout, self.offset, sources.offsetting(self.offset))
        if hull.rank == layout.size and not self.allow_identity:
            longest = identity_length(layout, recording.count, spare=int(self.offset == "estimated"))
            raise ExcitationError(
                f"projector hankel: {recording.count} x S = {recording.length} noisy columns span all d = "
                f"{layout.size} dimensions, so H H† is the identity and projects nothing; use hankel_lowrank, "
                f"S < {longest}, or projector.allow_identity=true"
            )
        return hull.span(hull.rank)


@dataclass(frozen=True)
class HankelLowRank(Fitted[Span]):
    """P = U U' with U the n + mT leading left singular vectors of the stacked Hankel matrix.

    The stack is truncated, not H(u) alone: under process noise its best approximation of the dynamics' rank, each
    channel scaled to one size.

    Args:
        initial_state: `fixed` holds x(0) = x_init.
        offset: as of `Hankel`.
    """

    label: ClassVar[str] = "hankel_lowrank"
    initial_state: InitialState = "free"
    offset: Offset = "none"

    @property
    def needs(self) -> frozenset[str]:
        """A recording, and the system whose offset is known."""
        return told(RECORDING, self.offset)

    def find(self, layout: TrajectoryLayout, sources: Sources) -> Span:
        """The leading n + mT directions of H."""
        hull = Hull.of(sources.recording, layout, self.offset, sources.offsetting(self.offset))
        if (gap := hull.gap(layout.rank)) < SMALL_GAP:
            log.warning(
                "projector hankel_lowrank: singular value n + mT = %d is only %.3g times the next one: noise is taken "
                "for dynamics; record longer or with larger inputs, or use projector=identified",
                layout.rank,
                gap,
            )
        return hull.span(layout.rank)

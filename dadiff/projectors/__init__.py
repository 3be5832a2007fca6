"""Projectors: the sets of admissible trajectories, and the projections onto them."""

from dadiff.projectors.projectors import (
    Hankel,
    HankelLowRank,
    Identified,
    Known,
    NoProjector,
    Projector,
    RolloutProjector,
    identify,
)
from dadiff.projectors.sets import AdmissibleSet, Projection

__all__ = [
    "AdmissibleSet",
    "Hankel",
    "HankelLowRank",
    "Identified",
    "Known",
    "NoProjector",
    "Projection",
    "Projector",
    "RolloutProjector",
    "identify",
]

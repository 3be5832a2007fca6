"""Behaviours: the sets of admissible trajectories, what they are learned from, and the projections onto them."""

from dadiff.behaviours.doubt import Doubted, DoubtedManifold
from dadiff.behaviours.family import IdentifiedFamily, disturbances
from dadiff.behaviours.identified import Identified, IdentifiedSoft, IdentifiedSparse, IdentifiedSparseSoft, Koopman
from dadiff.behaviours.known import (
    Inpainting,
    Known,
    KnownClear,
    KnownClipped,
    KnownTightened,
    Nominal,
    NoProjector,
    RolloutProjector,
)
from dadiff.behaviours.least_squares import Estimate, Transitions, least_squares
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Clipped, Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.prediction import model_of, prediction_error
from dadiff.behaviours.projection import Projection, ProjectionInfo
from dadiff.behaviours.projector import Fitted, Projector, Sources, pins, starts_fixed
from dadiff.behaviours.sets import Dynamics, Everything, Rollout, Span, TrajectorySet, Uncertain, compared
from dadiff.behaviours.stages import Stages
from dadiff.behaviours.windows import Hankel, HankelLowRank

__all__ = [
    "Clipped",
    "Doubted",
    "DoubtedManifold",
    "Dynamics",
    "Estimate",
    "Everything",
    "Fitted",
    "Hankel",
    "HankelLowRank",
    "Identified",
    "IdentifiedFamily",
    "IdentifiedSoft",
    "IdentifiedSparse",
    "IdentifiedSparseSoft",
    "Inpainting",
    "Known",
    "KnownClear",
    "KnownClipped",
    "KnownTightened",
    "Koopman",
    "Lifted",
    "Limited",
    "Manifold",
    "NoProjector",
    "Nominal",
    "Pin",
    "Projection",
    "ProjectionInfo",
    "Projector",
    "Rollout",
    "RolloutProjector",
    "Sources",
    "Span",
    "Stages",
    "TrajectorySet",
    "Transitions",
    "Uncertain",
    "compared",
    "disturbances",
    "least_squares",
    "model_of",
    "pins",
    "prediction_error",
    "starts_fixed",
]

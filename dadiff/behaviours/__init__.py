"""Behaviours: the sets of admissible trajectories, what they are learned from, and the projections onto them."""

from dadiff.behaviours.components import (
    Hankel,
    HankelLowRank,
    Identified,
    IdentifiedSoft,
    Inpainting,
    Known,
    KnownClear,
    Koopman,
    Nominal,
    NoProjector,
    Projector,
    RolloutProjector,
    pins,
)
from dadiff.behaviours.doubt import Doubted
from dadiff.behaviours.family import IdentifiedFamily
from dadiff.behaviours.least_squares import Estimate, Transitions, least_squares
from dadiff.behaviours.lifted import Lifted
from dadiff.behaviours.limited import Limited
from dadiff.behaviours.manifold import Manifold
from dadiff.behaviours.pins import Pin
from dadiff.behaviours.prediction import model_of, prediction_error
from dadiff.behaviours.projection import Projection, ProjectionInfo
from dadiff.behaviours.sets import Dynamics, Everything, Rollout, Span, TrajectorySet, Uncertain, compared
from dadiff.behaviours.stages import Stages

__all__ = [
    "Doubted",
    "Dynamics",
    "Estimate",
    "Everything",
    "Hankel",
    "HankelLowRank",
    "Identified",
    "IdentifiedFamily",
    "IdentifiedSoft",
    "Inpainting",
    "Known",
    "KnownClear",
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
    "Span",
    "Stages",
    "TrajectorySet",
    "Transitions",
    "Uncertain",
    "compared",
    "least_squares",
    "model_of",
    "pins",
    "prediction_error",
]

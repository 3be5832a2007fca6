"""Evaluation: what can be said of plans of any task."""

from dadiff.evaluation.errors import replay, tracking_errors
from dadiff.evaluation.settings import Evaluation

__all__ = ["Evaluation", "replay", "tracking_errors"]

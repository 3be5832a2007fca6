"""Evaluation: what can be said of plans of any task."""

from dadiff.evaluation.errors import planned_errors, replay, spread, tracking_errors, violations
from dadiff.evaluation.settings import ClosedLoop, Evaluation, Exact

__all__ = ["ClosedLoop", "Evaluation", "Exact", "planned_errors", "replay", "spread", "tracking_errors", "violations"]

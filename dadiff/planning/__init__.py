"""Planning: a trained model as something that gives plans, from memory or from one self-contained file."""

from dadiff.planning.planner import Planner
from dadiff.planning.plans import Plans

__all__ = ["Planner", "Plans"]

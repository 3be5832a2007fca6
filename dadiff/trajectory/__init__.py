"""Trajectories: their layout, the responses that generate them, and the subspaces they span."""

from dadiff.trajectory.layout import Layout
from dadiff.trajectory.response import simulate, trajectory_map

__all__ = ["Layout", "simulate", "trajectory_map"]

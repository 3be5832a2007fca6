"""Trajectories: their layout, the responses that generate them, and the subspaces they span."""

from dadiff.trajectory.layout import Channel, Layout, TrajectoryLayout
from dadiff.trajectory.response import simulate, trajectory_map

__all__ = ["Channel", "Layout", "TrajectoryLayout", "simulate", "trajectory_map"]

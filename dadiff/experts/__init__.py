"""Experts: the optimal controllers whose trajectories are demonstrations and references."""

"""Diffusion: noise schedules, samplers, and how a projection is enforced along the chain."""

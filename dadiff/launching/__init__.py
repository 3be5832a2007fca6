"""Launchers of multiruns: what to run, in which order, in which processes."""

from dadiff.launching.registration import register

__all__ = ["register"]

"""Configuration: typed components from plain mappings. Knows neither Hydra nor the components."""

from dadiff.config.build import build
from dadiff.config.settings import GROUPS, Parts, Settings, assemble, complete

__all__ = ["GROUPS", "Parts", "Settings", "assemble", "build", "complete"]

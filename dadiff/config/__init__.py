"""Configuration: typed components from plain mappings. Knows neither Hydra nor the components."""

from dadiff.config.build import build
from dadiff.config.settings import GROUPS, Assembled, Settings, assemble

__all__ = ["GROUPS", "Assembled", "Settings", "assemble", "build"]

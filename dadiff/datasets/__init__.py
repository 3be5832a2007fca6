"""Data sets: demonstrations to learn from and cases to be tested on, generated or read from files."""

from dadiff.datasets.files import NpzRecordings, NpzTrajectories
from dadiff.datasets.generated import Generated

__all__ = ["Generated", "NpzRecordings", "NpzTrajectories"]

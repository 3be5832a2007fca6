"""Data sets: demonstrations to learn from and cases to be tested on, generated or read from files."""

from dadiff.datasets.files import NpzRecordings, NpzTrajectories, recording_of
from dadiff.datasets.generated import Generated

__all__ = ["Generated", "NpzRecordings", "NpzTrajectories", "recording_of"]

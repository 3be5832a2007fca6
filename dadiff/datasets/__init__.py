"""Data sets: demonstrations to learn from and cases to be tested on, generated or read from files."""

from dadiff.datasets.demonstrations import NpzTrajectories, demonstrations_of
from dadiff.datasets.files import NpzRecordings, recording_of
from dadiff.datasets.generated import Generated

__all__ = ["Generated", "NpzRecordings", "NpzTrajectories", "demonstrations_of", "recording_of"]

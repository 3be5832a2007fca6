"""The errors that dadiff tells its users about.

Each message is one line that names what, where, found, expected, and what to do.
The command line prints it and exits with a code that is not 0.
"""


class DadiffError(Exception):
    """Root of every error that a user can mend."""


class ConfigError(DadiffError):
    """A configuration value is misspelt, of the wrong type, out of range or contradicts another."""


class NotApplicableError(ConfigError):
    """Two choices exclude one another; where a sweep combines everything, that is their result."""


class ShapeError(DadiffError):
    """An array does not have the shape that its layout asks for."""


class DataError(DadiffError):
    """A file or folder from outside is missing, damaged or holds unusable values."""


class ExcitationError(DataError):
    """A recording is too short or too poor to determine the dynamics."""


class InfeasibleError(DadiffError):
    """The stated optimisation problem has no solution."""


class CheckpointError(DataError):
    """A stored model is damaged or was made for other sizes."""


class StoreError(DadiffError):
    """Results cannot be written to or read from where they should lie."""


class LockedError(StoreError):
    """Another process is working on the same thing."""


class WorkerError(DadiffError):
    """The processes that do the work cannot be started."""


class MissingExtraError(DadiffError):
    """An optional package is not installed."""

"""Tasks: environments, experts and scores of the paper's experiments and beyond."""

from dadiff.tasks.fleet import Fleet
from dadiff.tasks.lqr import LQR
from dadiff.tasks.manoeuvre import Manoeuvre
from dadiff.tasks.task import Cases, Demonstrations, Scores, Task

__all__ = ["LQR", "Cases", "Demonstrations", "Fleet", "Manoeuvre", "Scores", "Task"]

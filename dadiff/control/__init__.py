"""Control: who decides the inputs while a system moves, and what becomes of it."""

from dadiff.control.controllers import Cloned, Controller, Feedback, OpenLoop, RecedingHorizon, Tracking
from dadiff.control.episodes import Episode, run

__all__ = ["Cloned", "Controller", "Episode", "Feedback", "OpenLoop", "RecedingHorizon", "Tracking", "run"]

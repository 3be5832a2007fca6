"""Systems: linear dynamics, families of robots, and recordings of them."""

from dadiff.systems.integrators import double_integrator
from dadiff.systems.linear import LinearSystem
from dadiff.systems.recording import GaussianExcitation, Recording

__all__ = ["GaussianExcitation", "LinearSystem", "Recording", "double_integrator"]

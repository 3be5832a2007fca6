"""Systems: linear dynamics, families of robots, and recordings of them."""

from dadiff.systems.integrators import double_integrator
from dadiff.systems.linear import LinearSystem

__all__ = ["LinearSystem", "double_integrator"]

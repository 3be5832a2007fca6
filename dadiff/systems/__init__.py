"""Systems: linear dynamics, families of robots, and recordings of them."""

from dadiff.systems.families import DampedIntegrators, Family, LaggedIntegrators, Robots, RotatedIntegrators
from dadiff.systems.integrators import double_integrator
from dadiff.systems.linear import LinearSystem
from dadiff.systems.recording import GaussianExcitation, Recording

__all__ = [
    "DampedIntegrators",
    "Family",
    "GaussianExcitation",
    "LaggedIntegrators",
    "LinearSystem",
    "Recording",
    "Robots",
    "RotatedIntegrators",
    "double_integrator",
]

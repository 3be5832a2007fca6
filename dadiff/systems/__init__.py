"""Systems: linear and nonlinear dynamics, families of robots, and recordings of them."""

from dadiff.systems.families import DampedIntegrators, Family, LaggedIntegrators, Robots, RotatedIntegrators
from dadiff.systems.given import from_control, inline
from dadiff.systems.integrators import double_integrator
from dadiff.systems.linear import AffineSystem, Linear, TimeVarying, require_affine
from dadiff.systems.mujoco import MujocoFamily, MujocoRobot, mujoco_robot
from dadiff.systems.nonlinear import Continuous, Nonlinear, Simulated
from dadiff.systems.quadrotors import PlanarQuadrotor, PlanarQuadrotors
from dadiff.systems.recording import FeedbackExcitation, GaussianExcitation, Recording
from dadiff.systems.system import Bounds, System
from dadiff.systems.unknown import Unknown, unknown

__all__ = [
    "AffineSystem",
    "Bounds",
    "Continuous",
    "DampedIntegrators",
    "Family",
    "FeedbackExcitation",
    "GaussianExcitation",
    "LaggedIntegrators",
    "Linear",
    "MujocoFamily",
    "MujocoRobot",
    "Nonlinear",
    "PlanarQuadrotor",
    "PlanarQuadrotors",
    "Recording",
    "Robots",
    "RotatedIntegrators",
    "Simulated",
    "System",
    "TimeVarying",
    "Unknown",
    "double_integrator",
    "from_control",
    "inline",
    "mujoco_robot",
    "require_affine",
    "unknown",
]

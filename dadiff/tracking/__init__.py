"""Everything that talks to MLflow. Results are on disk first; MLflow mirrors them, and is made again from them."""

from dadiff.tracking.tracking import Tracking

__all__ = ["Tracking"]

"""Everything that talks to MLflow. Results are on disk first; MLflow mirrors them."""

from dadiff.tracking.tracking import Tracking, attach, is_tracked

__all__ = ["Tracking", "attach", "is_tracked"]

"""dadiff: dynamics-aware diffusion for planning and control, as an experiment-tracking harness."""

__version__ = "0.1.0"

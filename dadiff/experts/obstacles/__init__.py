"""Experts for waypoints and collision avoidance: one problem, three solvers behind one interface.

Each of `batched`, `successive` and `ipopt` has `solve(problem, *, progress=False) -> Solutions`; third-party solvers
and the compiled `kernels` are imported when they are called. `literal` holds the printed cost.
"""

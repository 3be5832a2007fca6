"""Projections: within bounds against solvers for quadratic programs, and how cost grows with horizon and state."""

from __future__ import annotations

import numpy as np

from bench.rows import Row, least
from dadiff.behaviours import Known, Limited, Pin
from dadiff.behaviours.stages import Stages
from dadiff.systems import Bounds, Linear, double_integrator

HORIZONS, DIMENSIONS = (30, 100, 300, 1000), (4, 8, 16, 32)
PLANS = 100


def chain_of_integrators(state_dim: int) -> Linear:
    """A stable system of any even dimension."""
    half = state_dim // 2
    zero, one = np.zeros((half, half)), np.eye(half)
    return Linear(np.block([[one, 0.1 * one], [zero, 0.9 * one]]), np.vstack([zero, 0.1 * one]))


def growth() -> list[Row]:
    """Applying the projection to 100 plans over the horizon, and making it over the state dimension."""
    rng, system, applied, fitted = np.random.default_rng(0), double_integrator(), [], []
    for T in HORIZONS:
        layout = system.layout(T)
        projection, tau = Known().fit(layout, system).bind(), rng.standard_normal((PLANS, layout.size))
        projection(tau)
        applied.append((float(T), 1e3 * least(lambda p=projection, z=tau: p(z), repeats=3)[0]))
    for n in DIMENSIONS:
        plant = chain_of_integrators(n)
        layout, tau = plant.layout(100), rng.standard_normal((1, plant.layout(100).size))
        fit = lambda s=plant, y=layout, z=tau: Known().fit(y, s).bind()(z)  # noqa: E731
        fit()
        fitted.append((float(n), 1e3 * least(fit, repeats=3)[0]))
    return [
        Row(f"{PLANS} projections at T = {HORIZONS[-1]}", applied[-1][1], "ms", points=applied),
        Row(f"fitting and one projection at n = {DIMENSIONS[-1]}, T = 100", fitted[-1][1], "ms", points=fitted),
    ]


def within_bounds(plans: int = 20) -> list[Row]:
    """Plans of the double integrator with half the inputs that they ask for: the same program by ours and by others."""
    import cvxpy as cp
    from scipy.optimize import minimize

    system, rng = double_integrator(), np.random.default_rng(0)
    layout = system.layout(30)
    tau = Known().fit(layout, system).bind()(rng.standard_normal((plans, layout.size)))
    limit = 0.5 * np.abs(layout.inputs(tau)).max()
    x_init = layout.states(tau)[:, 0]
    known = Known().fit(layout, system)
    bounded = Limited(known, Bounds(input_low=-limit, input_high=limit))
    ours = bounded.bind(pins=[Pin.initial_state(layout, x_init)])
    one = bounded.bind(pins=[Pin.initial_state(layout, x_init[:1])])
    G, g = Stages.constant(system.A, system.B, None, 30).matrix(layout)
    first = np.eye(layout.size)[layout.initial_state]

    z, hat = cp.Variable(layout.size), cp.Parameter(layout.size)
    holds = [G @ z == g, first @ z == first @ hat, cp.abs(layout_inputs(layout) @ z) <= limit]
    program = cp.Problem(cp.Minimize(cp.sum_squares(z - hat)), holds)

    def clarabel() -> None:
        hat.value = tau[0]
        program.solve(solver=cp.CLARABEL)

    def slsqp() -> None:
        rows, right = np.vstack([G, first]), np.concatenate([g, x_init[0]])
        reach = np.where(layout_inputs(layout).any(axis=0), limit, np.inf)
        holds = {"type": "eq", "fun": lambda v: rows @ v - right, "jac": lambda v: rows}
        cost, slope = (lambda v: ((v - tau[0]) ** 2).sum()), (lambda v: 2 * (v - tau[0]))
        limits = list(zip(-reach, reach, strict=True))
        minimize(cost, tau[0], jac=slope, bounds=limits, constraints=holds, method="SLSQP")

    clarabel()
    if np.abs(one(tau[:1])[0] - z.value).max() > 1e-5:
        raise ArithmeticError("projection within bounds: ours and Clarabel's differ")
    batch, alone, quadratic, sequential = least(lambda: ours(tau), lambda: one(tau[:1]), clarabel, slsqp, repeats=3)
    return [
        Row(f"{plans} projections within bounds, a plan", 1e3 * batch / plans, "ms", "Clarabel", 1e3 * quadratic),
        Row("one projection within bounds", 1e3 * alone, "ms", "SLSQP", 1e3 * sequential),
    ]


def layout_inputs(layout) -> np.ndarray:
    """The rows of the identity that select the inputs."""
    return np.eye(layout.size)[layout.all_inputs]


def measure() -> list[Row]:
    """The rows."""
    return [*within_bounds(), *growth()]

"""Dynamics that are doubted, each plan by itself: against Bayes' rule written out, and against what it is for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dadiff.behaviours import Dynamics, Identified, IdentifiedSoft, Pin, Stages, doubt
from dadiff.behaviours.doubt import Doubted
from dadiff.errors import NotApplicableError
from dadiff.systems import GaussianExcitation, double_integrator
from dadiff.trajectory import TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.covariance import Covariance

LAYOUT, PLANS = TrajectoryLayout(2, 1, 4), 3
SIZE = LAYOUT.size
WHERE = Coordinates(np.linspace(-1, 1, SIZE), np.linspace(0.5, 2, SIZE))
RNG = np.random.default_rng(0)
C = Covariance.dense(np.cov(RNG.standard_normal((SIZE, 3 * SIZE))))
Z, EPS = RNG.standard_normal((2, 2, PLANS, SIZE))
X_INIT = RNG.standard_normal((2, PLANS, 2))


def stages(robots: tuple[int, ...] = (2,)) -> Stages:
    rng = np.random.default_rng(2)
    A, B, c = (0.5 * rng.standard_normal((*robots, *shape)) for shape in ((2, 2), (2, 1), (2,)))
    return Stages.constant(A, B, c, LAYOUT.horizon)


def doubted(size: float = 0.3, *, offset: bool = True) -> Doubted:
    root = size * np.random.default_rng(3).standard_normal((2, 4 if offset else 3, 2, 5))
    return Doubted(LAYOUT, stages(), root)


def expected(made: Doubted, k: int, z: np.ndarray, eps: np.ndarray | None) -> np.ndarray:
    """One plan (d,) of robot k with x(0) pinned: Kalman's update with R of the plan, taken anew at what it gives."""
    G, g = (part[k] for part in made.stages.matrix(LAYOUT))
    G, g = np.concatenate([np.eye(SIZE)[LAYOUT.initial_state], G]), np.append(X_INIT[k, 0], g)
    G, g = G * WHERE.scale, g - G @ WHERE.mean
    held = np.linalg.solve(G[:2] @ C.matrix @ G[:2].T, g[:2] - G[:2] @ z)
    corrected = z + C.matrix @ G[:2].T @ held
    for _ in range(doubt.ROUNDS):
        x, u = LAYOUT.split(WHERE.to_physical(corrected))
        phi = np.concatenate([x[:-1], u, np.ones((4, 1))], axis=-1)[:, : made.root.shape[-3]]
        V = np.einsum("tp,pnk->tnk", phi, made.root[k]).reshape(8, -1)
        R = np.zeros((10, 10))
        R[2:, 2:] = V @ V.T
        r = np.zeros(10) if eps is None else np.concatenate([np.zeros(2), V @ eps[: V.shape[1]]])
        corrected = z - C.matrix @ G.T @ np.linalg.solve(G @ C.matrix @ G.T + R, G @ z - g - r)
    return corrected


@pytest.mark.parametrize("noise", [None, EPS], ids=["mean", "draw"])
@pytest.mark.parametrize("offset", [True, False])
def test_it_is_kalmans_update_with_the_covariance_of_each_plan(offset, noise):
    made = doubted(offset=offset)
    P = made.bind(WHERE, (Pin.initial_state(LAYOUT, X_INIT[:, :1]),))
    found = P(Z, C, noise=noise)
    for k, plan in np.ndindex(2, PLANS):
        eps = None if noise is None else noise[k, plan]
        np.testing.assert_allclose(found[k, plan], expected(made, k, Z[k, plan], eps), atol=1e-8)
    tensors = P(torch.from_numpy(Z), C, noise=None if noise is None else torch.from_numpy(noise))
    np.testing.assert_allclose(tensors, found, atol=1e-10)


def test_without_doubt_it_is_the_set():
    held = (Pin.initial_state(LAYOUT, X_INIT),)
    plain = Dynamics(LAYOUT, stages()).bind(WHERE, held)(Z, C)
    np.testing.assert_allclose(doubted(1e-9).bind(WHERE, held)(Z, C), plain, atol=1e-6)


def test_what_other_dynamics_within_the_doubt_explain_is_left_as_it_is():
    """A robot that is not quite as estimated: its trajectories hardly move, generic ones do."""
    made, rng = doubted(), np.random.default_rng(4)
    theta = (made.root @ rng.standard_normal(5)).swapaxes(-1, -2)  # (robots, n, p)
    A, B, c = (getattr(made.stages, name)[..., 0, :] if name == "c" else getattr(made.stages, name)[..., 0, :, :]
               for name in ("A", "B", "c"))  # fmt: skip
    true = Stages.constant(A + theta[..., :2], B + theta[..., 2:3], c + theta[..., 3], LAYOUT.horizon)
    inputs = rng.standard_normal((2, PLANS, 4, 1))
    tau = WHERE.to_scaled(LAYOUT.flatten(true.simulate(rng.standard_normal((2, PLANS, 2)), inputs), inputs))
    sure = C.scaled(1e-6)  # the denoiser
    P = made.bind(WHERE)
    own, generic = (np.abs(P(z, sure) - z).max() for z in (tau, Z))
    hard = np.abs(Dynamics(LAYOUT, made.stages).bind(WHERE)(tau, sure) - tau).max()
    assert own < 0.05 * hard
    assert own < 0.05 * generic


def test_averaged_over_demonstrations_its_covariance_is_the_averaged_one():
    system, layout = double_integrator(process_noise=0.05), double_integrator().layout(5)
    recording = GaussianExcitation(40).record(system)
    shown = np.random.default_rng(0).standard_normal((30, layout.size))
    each, averaged = (
        IdentifiedSoft(residual=residual).fit(layout, system, recording, shown) for residual in ("each", "averaged")
    )
    V = each.bind()._geometry.form().deviations(shown)
    R = (V @ V.swapaxes(-1, -2)).mean(axis=0)
    np.testing.assert_allclose(R, averaged.spread @ averaged.spread.T, atol=1e-9)


def test_it_needs_no_demonstrations_and_refuses_what_is_too_long(monkeypatch):
    system = double_integrator(process_noise=0.01)
    recording = GaussianExcitation(60).record(system)
    assert IdentifiedSoft().needs == Identified().needs
    made = IdentifiedSoft().fit(system.layout(5), system, recording)
    monkeypatch.setattr(doubt, "DOUBTED_UP_TO", 10)
    with pytest.raises(NotApplicableError, match=r"use projector\.residual=averaged"):
        made.bind()

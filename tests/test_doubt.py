"""Dynamics that are doubted, each plan by itself: against Bayes' rule written out, and against what it is for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dadiff.behaviours import (
    Doubted,
    DoubtedManifold,
    Dynamics,
    Identified,
    IdentifiedSoft,
    IdentifiedSparse,
    IdentifiedSparseSoft,
    Manifold,
    Pin,
    Stages,
    doubt,
)
from dadiff.behaviours.least_squares import Transitions, significant
from dadiff.errors import NotApplicableError
from dadiff.systems import GaussianExcitation, PlanarQuadrotor, double_integrator
from dadiff.systems.features import Features, Regressed
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
    size = made.layout.size
    monkeypatch.setattr(doubt, "DOUBTED_UP_TO", size - 1)
    with pytest.raises(NotApplicableError, match=rf"d = {size} > {size - 1} .* use projector\.residual=averaged"):
        made.bind()
    monkeypatch.setattr(doubt, "DOUBTED_UP_TO", size)
    made.bind()


@pytest.mark.parametrize("noise", [False, True], ids=["mean", "draw"])
@pytest.mark.parametrize("pinned", [False, True], ids=["free", "pinned"])
@pytest.mark.parametrize("offset", ["none", "estimated"])
def test_of_linear_dynamics_the_features_know_as_much(offset, pinned, noise, rng):
    """Doubted features of x and u alone, by recursion, are doubted matrices, written densely."""
    system = double_integrator(process_noise=0.05)
    layout, recording = system.layout(6), GaussianExcitation(40).record(system)
    C = Covariance(rng.uniform(0.5, 2, layout.size), rng.standard_normal((layout.size, 4)))
    where = Coordinates(rng.standard_normal(layout.size), rng.uniform(0.5, 2, layout.size))
    pins = (Pin.initial_state(layout, rng.standard_normal((5, 4))),) if pinned else ()
    z, eps = rng.standard_normal((2, 5, layout.size))
    matrices, terms = (
        IdentifiedSoft(offset=offset, features=features).fit(layout, system, recording)
        for features in ((), ("identity",))
    )
    plain, features = (made.bind(where, pins) for made in (matrices, terms))
    flat = [made.root.reshape(-1, k := made.root.shape[-1]) for made in (matrices, terms)]
    same = eps[..., :k] @ np.linalg.lstsq(*flat)[0].T  # two roots of one covariance differ by a rotation
    drawn = (np.pad(same, ((0, 0), (0, layout.size - k))), eps) if noise else (None, None)
    for metric in (None, C):
        found = features(z, metric, noise=drawn[1])
        np.testing.assert_allclose(found, plain(z, metric, noise=drawn[0]), atol=1e-9)
    tensors = features(torch.from_numpy(z), C, noise=torch.from_numpy(eps) if noise else None)
    np.testing.assert_allclose(tensors, features(z, C, noise=drawn[1]), atol=1e-12)


FLYING = ("constant", "identity", "trigonometric", "turning", "control_affine")


def flown(robots: int = 2) -> tuple[Regressed, np.ndarray]:
    """Quadrotors of known features, and a small doubt about all of them."""
    fleet = PlanarQuadrotor(thrust_gain=np.ones(robots), torque_gain=np.ones(robots), drag=np.zeros(robots))
    recording = GaussianExcitation(200, 3.0, process_noise=1e-3).record(fleet)
    found = significant(Transitions.of(recording.states, recording.inputs), Features(6, 2, FLYING, (2,)), 4.0)
    return found.system, found.root


def test_of_nonlinear_dynamics_it_comes_to_rest_at_the_most_probable_plan_and_errors(rng, monkeypatch):
    """There G tau - g of the dynamics themselves is V e, with tau - tau_hat = -C G' l and e = V' l."""
    system, root = flown()
    layout = system.layout(8)
    C = Covariance(rng.uniform(0.5, 1, layout.size), 0.3 * rng.standard_normal((layout.size, 3)))
    made, tau = DoubtedManifold(layout, system, 20, root=root), 0.3 * rng.standard_normal((2, 3, layout.size))
    monkeypatch.setattr(doubt, "AT_ONCE", 4)  # two plans at a time
    found = made.bind()(tau, C)
    x, u = layout.split(found)
    G, _ = Stages(*system.linearise(x[..., :-1, :], u)).matrix(layout)
    phi = system.features(x[..., :-1, :], u)
    V = np.einsum("rptf,rfnk->rptnk", phi, root).reshape(2, 3, 48, -1)
    residual = (x[..., 1:, :] - system.step(x[..., :-1, :], u)).reshape(2, 3, 48)
    moved = np.linalg.lstsq((G @ C.matrix @ G.swapaxes(-1, -2))[0, 0], -(G[0, 0] @ (found - tau)[0, 0]))[0]
    np.testing.assert_allclose((found - tau)[0, 0], -C.matrix @ G[0, 0].T @ moved, atol=1e-8)
    np.testing.assert_allclose(residual[0, 0], V[0, 0] @ (V[0, 0].T @ moved), atol=1e-8)


def test_nonlinear_dynamics_that_are_hardly_doubted_are_the_manifold(rng):
    system, root = flown()
    layout = system.layout(8)
    C, tau = Covariance.diagonal_of(np.ones(layout.size)), 0.3 * rng.standard_normal((2, 3, layout.size))
    pins = (Pin.initial_state(layout, 0.3 * rng.standard_normal((2, 3, 6))),)
    hard = Manifold(layout, system, 20).bind(pins=pins)(tau, C)
    soft = DoubtedManifold(layout, system, 20, root=1e-6 * root).bind(pins=pins)(tau, C)
    np.testing.assert_allclose(soft, hard, atol=1e-5)


def test_of_sparse_dynamics_only_the_terms_that_are_kept_are_doubted():
    recording = GaussianExcitation(200, 3.0, process_noise=1e-3).record(PlanarQuadrotor())
    layout = PlanarQuadrotor().layout(8)
    hard, soft = (
        kind(features=FLYING, angles=(2,)).fit(layout, PlanarQuadrotor(), recording)
        for kind in (IdentifiedSparse, IdentifiedSparseSoft)
    )
    np.testing.assert_array_equal(hard.system.theta, soft.system.theta)
    np.testing.assert_array_equal(soft.system.theta != 0, soft.root.any(axis=-1).T)
    with pytest.raises(NotApplicableError, match="use projector=identified_sparse"):
        IdentifiedSparseSoft(features=FLYING, angles=(2,), bounds="enforced").fit(layout, PlanarQuadrotor(), recording)


def test_pins_take_freedom_from_it():
    held = Pin.initial_state(LAYOUT, X_INIT)
    assert doubted().bind().info.rank == LAYOUT.rank
    assert doubted().bind(pins=[held]).info.rank == LAYOUT.rank - 2

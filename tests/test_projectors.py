"""Laws of projectors, run on every preset in conf/ with every way to treat x(0), on systems of several sizes."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from laws import SYSTEMS, component, exciting, fleet, members, tolerance, trajectories, variants

from dadiff.errors import ConfigError, ExcitationError
from dadiff.projectors import AdmissibleSet, Hankel, HankelLowRank, Identified, Known, NoProjector, RolloutProjector
from dadiff.systems import GaussianExcitation, LinearSystem, Recording, double_integrator
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.hankel import identity_length, minimum_length
from dadiff.trajectory.subspace import largest_angle, projector_distance

HORIZON, PLANS = 6, 5
PROJECTORS = {
    name: projector
    for name, projector in variants("projector", {"initial_state": ("free", "fixed")}).items()
    if not isinstance(projector, NoProjector)
}
ORTHOGONAL = {name: p for name, p in PROJECTORS.items() if not isinstance(p, RolloutProjector)}
HOLDING = {name: p for name, p in PROJECTORS.items() if p.initial_state == "fixed"}
# What learning (A, B) or the set from a recording magnifies the rounding of its entries by.
CONDITIONING = 1e3

every_projector = pytest.mark.parametrize("projector", PROJECTORS.values(), ids=PROJECTORS.keys())
every_orthogonal = pytest.mark.parametrize("projector", ORTHOGONAL.values(), ids=ORTHOGONAL.keys())


FITTED: dict[tuple[object, int], object] = {}


def fit(projector, system: LinearSystem):
    """Fitted on a noise-free exciting recording, once for all laws."""
    key = (projector, id(system))
    if key not in FITTED:
        recording = exciting().record(system)
        FITTED[key] = projector.fit(system.layout(HORIZON), system=system, recording=recording)
    return FITTED[key]


def scaled(system: LinearSystem, seed: int = 0) -> Coordinates:
    rng, d = np.random.default_rng(seed), system.layout(HORIZON).size
    return Coordinates(rng.standard_normal(d), rng.uniform(0.2, 3, d))


def close(system: LinearSystem, size: float = 1.0) -> float:
    return tolerance(size=system.layout(HORIZON).size, conditioning=CONDITIONING) * max(size, 1)


@pytest.fixture(params=[physical, scaled], ids=["physical", "scaled"])
def coordinates(request, system):
    return request.param(system.layout(HORIZON)) if request.param is physical else request.param(system)


@pytest.fixture
def bound(projector, system, coordinates):
    """(P, x_init): the projection for PLANS plans."""
    x_init = np.random.default_rng(1).standard_normal((PLANS, system.state_dim))
    return fit(projector, system).projection(coordinates, x_init), x_init


def generic(system: LinearSystem, *shape: int) -> np.ndarray:
    return np.random.default_rng(2).standard_normal((*shape, system.layout(HORIZON).size))


@every_projector
class TestEveryProjector:
    def test_is_idempotent_and_moves_a_generic_vector(self, system, bound):
        (P, _), z = bound, generic(system, PLANS)
        once = P(z)
        np.testing.assert_allclose(P(once), once, atol=close(system, np.abs(once).max()))
        assert (np.abs(once - z).max(axis=-1) > 1e-3).all()

    def test_every_simulated_trajectory_is_a_fixed_point(self, projector, system, coordinates):
        tau, x_init = trajectories(system, HORIZON, PLANS)
        z = coordinates.to_scaled(tau)
        P = fit(projector, system).projection(coordinates, x_init)
        np.testing.assert_allclose(P(z), z, atol=close(system, np.abs(z).max()))

    def test_what_comes_out_is_admissible_in_physical_units(self, system, coordinates, bound):
        (P, _), layout = bound, system.layout(HORIZON)
        states, inputs = layout.split(coordinates.to_physical(P(generic(system, PLANS))))
        rolled = system.simulate(states[:, 0], inputs)
        np.testing.assert_allclose(rolled, states, atol=close(system, np.abs(states).max()))

    def test_a_batch_is_its_plans_one_by_one(self, projector, system, coordinates, bound):
        (P, x_init), z = bound, generic(system, PLANS)
        together, fitted = P(z), fit(projector, system)
        for k in range(PLANS):
            alone = fitted.projection(coordinates, x_init[[k]])(z[[k]])[0]
            np.testing.assert_allclose(together[k], alone, atol=close(system))

    def test_a_fleet_is_its_robots_one_by_one(self, projector):
        robots = fleet()
        recording = exciting(60).record(robots)
        x_init, z = np.random.default_rng(1).standard_normal((3, PLANS, 3)), generic(robots, 3, PLANS)
        where = scaled(robots)
        fitted = projector.fit(robots.layout(HORIZON), system=robots, recording=recording)
        together = fitted.projection(where, x_init)(z)
        for k, robot in enumerate(members(robots)):
            own = Recording(recording.states[k], recording.inputs[k])
            alone = projector.fit(robot.layout(HORIZON), system=robot, recording=own)
            np.testing.assert_allclose(together[k], alone.projection(where, x_init[k])(z[k]), atol=close(robots))

    def test_torch_agrees_and_float32_comes_near(self, system, bound):
        (P, _), z = bound, generic(system, PLANS)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns of arrays that it must not write to
            double = P.map(torch.as_tensor)(torch.from_numpy(z))
            single = P.map(lambda a: torch.as_tensor(a, dtype=torch.float32))(torch.from_numpy(z).float())
        np.testing.assert_allclose(double.numpy(), P(z), atol=close(system, np.abs(P(z)).max()))
        rounding = tolerance(np.float32, size=z.shape[-1]) * np.abs(P(z)).max()
        np.testing.assert_allclose(single.numpy(), P(z), atol=rounding)

    def test_it_asks_for_what_it_needs(self, projector, system):
        layout = system.layout(HORIZON)
        with pytest.raises(ConfigError, match=f"needs a {projector.needs}, and none is given"):
            projector.fit(layout)
        given = {"system": system} if projector.needs == "system" else {"recording": exciting().record(system)}
        projector.fit(layout, **given)


@every_orthogonal
class TestOrthogonalProjectors:
    def test_it_is_self_adjoint_in_the_metric_of_its_coordinates(self, system, bound):
        P, _ = bound
        v, w = generic(system, 2, PLANS)
        move_v, move_w = P(v) - P(0 * v), P(w) - P(0 * w)  # the linear part of an affine map
        left, right = (move_v * w).sum(-1), (v * move_w).sum(-1)
        np.testing.assert_allclose(left, right, atol=close(system, np.abs(left).max()))

    def test_nothing_admissible_lies_nearer(self, projector, system, coordinates, bound):
        (P, x_init), z = bound, generic(system, PLANS)
        tau, _ = trajectories(system, HORIZON, PLANS, seed=7)
        layout = system.layout(HORIZON)
        if projector.initial_state == "fixed":
            inputs = layout.inputs(tau)
            tau = layout.flatten(system.simulate(x_init, inputs), inputs)
        other = coordinates.to_scaled(tau)
        np.testing.assert_allclose(
            ((z - P(z)) * (other - P(z))).sum(-1), 0, atol=close(system, np.abs(other).max()) * 10
        )

    def test_its_rank_is_that_of_the_dynamics(self, projector, system):
        fitted, layout = fit(projector, system), system.layout(HORIZON)
        free = layout.rank - (layout.state_dim if projector.initial_state == "fixed" else 0)
        assert fitted.basis.shape == (layout.size, free)
        np.testing.assert_allclose(fitted.basis.T @ fitted.basis, np.eye(free), atol=1e-12)
        assert fitted.notes["rank"] == layout.rank

    def test_it_agrees_with_known_on_noise_free_exciting_data(self, projector, system):
        known = fit(Known(projector.initial_state), system)
        assert largest_angle(fit(projector, system).basis, known.basis) < close(system)


@pytest.mark.parametrize("projector", HOLDING.values(), ids=HOLDING.keys())
def test_x_init_is_held_exactly_for_every_case_of_a_batch(system, coordinates, bound):
    (P, x_init), z = bound, generic(system, 3, PLANS)
    for batch in z:
        states = system.layout(HORIZON).states(coordinates.to_physical(P(batch)))
        np.testing.assert_allclose(states[:, 0], x_init, atol=close(system))


def test_free_projection_does_not_hold_x_init(system):
    x_init = np.ones((PLANS, system.state_dim))
    states = system.layout(HORIZON).states(fit(Known(), system).projection(x_init=x_init)(generic(system, PLANS)))
    assert np.abs(states[:, 0] - x_init).max() > 0.1


def test_rollout_keeps_the_inputs_and_recomputes_the_states(system, coordinates):
    layout, z = system.layout(HORIZON), generic(system, PLANS)
    x_init = np.random.default_rng(1).standard_normal((PLANS, system.state_dim))
    P = fit(RolloutProjector(), system).projection(coordinates, x_init)
    states, inputs = layout.split(coordinates.to_physical(P(z)))
    np.testing.assert_allclose(inputs, layout.inputs(coordinates.to_physical(z)), atol=close(system))
    np.testing.assert_allclose(states, system.simulate(x_init, inputs), atol=close(system))


@pytest.mark.parametrize("projector", HOLDING.values(), ids=HOLDING.keys())
def test_holding_x_init_needs_x_init(projector):
    with pytest.raises(ConfigError, match="needs x_init, one for each plan"):
        fit(projector, SYSTEMS["paper"]).projection()


def test_scaling_changes_the_projection_but_not_the_set(system):
    where, tau = scaled(system), generic(system, 1)
    fitted = fit(Known(), system)
    ours, theirs = fitted.projection()(tau), where.to_physical(fitted.projection(where)(where.to_scaled(tau)))
    assert np.abs(ours - theirs).max() > 1e-3
    np.testing.assert_allclose(fitted.projection()(theirs), theirs, atol=close(system, np.abs(theirs).max()))


def test_known_is_F_times_its_pseudo_inverse(system):
    F, tau = system.trajectory_map(HORIZON), generic(system, PLANS)
    np.testing.assert_allclose(
        fit(Known(), system).projection()(tau), tau @ (F @ np.linalg.pinv(F)).T, atol=close(system)
    )


@pytest.mark.parametrize("initial_state", ["free", "fixed"])
@pytest.mark.parametrize(("A", "T"), [(2.0, 60), (3.0, 700)])
def test_known_holds_where_the_powers_of_A_overflow_every_digit(A, T, initial_state):
    system = LinearSystem(np.array([[A]]), np.ones((1, 1)))
    layout, z = system.layout(T), np.random.default_rng(0).standard_normal((3, 2 * T + 1))
    fitted = Known(initial_state).fit(layout, system=system)
    x, u = layout.split(fitted.projection(x_init=np.ones((3, 1)))(z))
    assert np.abs(x[:, 1:] - A * x[:, :-1] - u).max() < 1e-12
    if initial_state == "fixed":
        np.testing.assert_allclose(x[:, 0], 1, atol=1e-12)


# --- recordings that are noisy, short or poor


def noisy(length: int, process_noise: float = 0.01, seed: int = 0, count: int = 1) -> Recording:
    return exciting(length, process_noise, count, seed).record(double_integrator())


def distance(projector, recording: Recording, horizon: int = 10) -> float:
    system = double_integrator()
    layout = system.layout(horizon)
    fitted = projector.fit(layout, system=system, recording=recording)
    return float(projector_distance(fitted.basis, Known().fit(layout, system).basis))


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("process_noise", [1e-6, 0.01])
def test_noise_turns_hankel_into_the_identity_and_it_says_so(process_noise, count):
    layout = double_integrator().layout(HORIZON)
    S = identity_length(layout, count)
    with pytest.raises(
        ExcitationError, match=rf"S = {S} noisy columns span all d = {layout.size} .*use hankel_lowrank"
    ):
        Hankel().fit(layout, recording=noisy(S, process_noise, count=count))
    identity = Hankel(allow_identity=True).fit(layout, recording=noisy(S, process_noise, count=count)).projection()
    tau = generic(double_integrator(), PLANS)
    np.testing.assert_allclose(identity(tau), tau, atol=1e-12)
    fitted = Hankel().fit(layout, recording=noisy(S - 1, process_noise, count=count))
    assert layout.rank < fitted.notes["rank"] < layout.size


def test_the_count_of_columns_from_which_noise_fills_everything():
    layout = double_integrator().layout(30)
    n, m, T = layout.state_dim, layout.input_dim, layout.horizon
    assert identity_length(layout) == n * (T + 1) + m * T + T - 1 == 213


def test_more_noisy_data_moves_hankel_away_and_brings_hankel_lowrank_closer():
    layout = double_integrator().layout(10)
    lengths = [minimum_length(layout) + 6, identity_length(layout) - 1]
    plain = [np.mean([distance(Hankel(), noisy(S, seed=k)) for k in range(5)]) for S in lengths]
    assert plain[1] > 1.5 * plain[0]
    for projector in (HankelLowRank(), Identified()):
        errors = [np.mean([distance(projector, noisy(S, seed=k)) for k in range(5)]) for S in (*lengths, 400, 2000)]
        assert (np.diff(errors) < 0).all(), errors
        assert errors[-1] < errors[0] / 4


def test_noise_leaves_a_gap_behind_the_rank_of_the_dynamics():
    layout = double_integrator().layout(10)
    gaps = [HankelLowRank().fit(layout, recording=noisy(400, w)).notes["singular_value_gap"] for w in (1e-4, 0.01, 0.1)]
    assert gaps[0] > 10 * gaps[1] > 10
    assert gaps[1] > gaps[2]


LEARNED = {name: p for name, p in PROJECTORS.items() if p.needs == "recording"}
FROM_HANKEL = {name: p for name, p in LEARNED.items() if isinstance(p, Hankel | HankelLowRank)}


@pytest.mark.parametrize("projector", FROM_HANKEL.values(), ids=FROM_HANKEL.keys())
def test_a_recording_that_is_too_short_says_how_long_it_must_be(projector, system):
    layout = system.layout(HORIZON)
    needed = minimum_length(layout)
    with pytest.raises(ExcitationError, match=rf"n \+ mT = {layout.rank} are needed: record S >= {needed}$"):
        projector.fit(layout, system, exciting(needed - 1).record(system))
    projector.fit(layout, system, exciting(needed).record(system))


@pytest.mark.parametrize("projector", LEARNED.values(), ids=LEARNED.keys())
@pytest.mark.parametrize("process_noise", [0.0, 0.05])
def test_a_recording_under_feedback_is_refused_with_its_rank_and_the_needed_one(projector, process_noise):
    """Under u = -K x the first input of a window follows from its first state, however much noise drives the rest."""
    system, layout = double_integrator(), double_integrator().layout(HORIZON)
    gain = np.array([[1.0, 0, 2, 0], [0, 1.0, 0, 2]])
    closed = LinearSystem(system.A - system.B @ gain, system.B)
    rng = np.random.default_rng(0)
    noise = process_noise * rng.standard_normal((20, 40, 4))
    states = closed.simulate(rng.standard_normal((20, 4)), np.zeros((20, 40, 2)), noise)
    found = layout.rank - layout.input_dim if process_noise else layout.state_dim
    from_hankel = f"have rank {found}, n \\+ mT = {layout.rank} are needed"
    with pytest.raises(ExcitationError, match=f"{from_hankel}|span 4 dimensions, n \\+ m = 6 are needed"):
        projector.fit(layout, system, Recording(states, -states[:, :-1] @ gain.T))


@pytest.mark.parametrize("projector", LEARNED.values(), ids=LEARNED.keys())
@pytest.mark.parametrize("process_noise", [0.0, 0.05])
def test_a_recording_without_inputs_is_refused(projector, process_noise):
    system = double_integrator()
    silent = GaussianExcitation(length=100, input_std=0.0, process_noise=process_noise).record(system)
    found = system.state_dim if process_noise else 0
    with pytest.raises(ExcitationError, match=f"(have rank|span) {found}[ ,]"):
        projector.fit(system.layout(HORIZON), system, silent)


def test_robots_whose_recordings_differ_in_rank_are_refused():
    robots = fleet(2)
    recording = exciting(60).record(robots)
    noise = 0.1 * np.random.default_rng(0).standard_normal(recording.states.shape[1:])
    states = recording.states + np.stack([0 * noise, noise])
    with pytest.raises(ExcitationError, match="the robots' Hankel matrices have ranks from"):
        Hankel(allow_identity=True).fit(robots.layout(HORIZON), robots, Recording(states, recording.inputs))


def test_a_set_that_does_not_reach_every_start_cannot_hold_one():
    layout = double_integrator().layout(2)
    with pytest.raises(ExcitationError, match="span 1 of 4 dimensions, so x\\(0\\) cannot be fixed"):
        AdmissibleSet(layout, np.eye(layout.size)[:, :1]).starting("fixed")


def test_none_has_nothing_to_fit():
    assert component("projector", "none").fit(double_integrator().layout(HORIZON)) is None

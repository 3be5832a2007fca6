"""Laws of projectors, run on every preset in conf/ with every way to treat x(0), on systems of several sizes."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from laws import SYSTEMS, component, exciting, fleet, members, tolerance, trajectories, variants

from dadiff.behaviours import (
    Dynamics,
    Hankel,
    HankelLowRank,
    Identified,
    IdentifiedFamily,
    IdentifiedSoft,
    IdentifiedSparse,
    Inpainting,
    Known,
    KnownClear,
    Koopman,
    Limited,
    Nominal,
    NoProjector,
    Pin,
    Projection,
    RolloutProjector,
    Span,
    Stages,
    Transitions,
    Uncertain,
    compared,
    least_squares,
    model_of,
    pins,
    sets,
)
from dadiff.errors import ConfigError, ExcitationError, ShapeError
from dadiff.systems import Bounds, GaussianExcitation, Linear, Recording, TimeVarying, double_integrator
from dadiff.trajectory import Channel, Layout
from dadiff.trajectory.coordinates import Coordinates, physical
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.hankel import identity_length, minimum_length, windows

HORIZON, PLANS = 6, 5
PROJECTORS = {  # of one robot's linear dynamics; see test_family.py, test_manoeuvre.py and test_features.py for others
    name: projector
    for name, projector in variants("projector", {"initial_state": ("free", "fixed")}).items()
    if not isinstance(projector, NoProjector | Inpainting | IdentifiedFamily | IdentifiedSparse | Nominal)
    and not getattr(projector, "ridge", 0.0)  # which shrinks what is fitted, noise or none; see test_features.py
}
ORTHOGONAL = {name: p for name, p in PROJECTORS.items() if not isinstance(p, RolloutProjector | KnownClear)}
HOLDING = {name: p for name, p in PROJECTORS.items() if p.initial_state == "fixed"}
# What learning (A, B) or the set from a recording magnifies the rounding of its entries by.
CONDITIONING = 1e3

every_projector = pytest.mark.parametrize("projector", PROJECTORS.values(), ids=PROJECTORS.keys())
every_orthogonal = pytest.mark.parametrize("projector", ORTHOGONAL.values(), ids=ORTHOGONAL.keys())


def out_of_reach(projector, system: Linear) -> Linear:
    """The system with bounds that matter to nothing, where a projector asks for some."""
    enforced = getattr(projector, "bounds", "ignored") == "enforced"
    return replace(system, bounds=Bounds(-1e6, 1e6)) if enforced else system


FITTED: dict[tuple[object, int], object] = {}


def fit(projector, system: Linear):
    """Fitted on a noise-free exciting recording, once for all laws; where bounds are enforced they are out of reach."""
    key = (projector, id(system))
    system = out_of_reach(projector, system)
    if key not in FITTED:
        recording = exciting().record(system)
        demonstrations = trajectories(system, HORIZON, 50, seed=3)[0]
        FITTED[key] = projector.fit(system.layout(HORIZON), system, recording, demonstrations)
    return FITTED[key]


def bind(projector, system: Linear, x_init: np.ndarray, coordinates: Coordinates | None = None) -> Projection:
    return fit(projector, system).bind(coordinates, pins(projector, system.layout(HORIZON), x_init))


def scaled(system: Linear, seed: int = 0) -> Coordinates:
    rng, d = np.random.default_rng(seed), system.layout(HORIZON).size
    return Coordinates(rng.standard_normal(d), rng.uniform(0.2, 3, d))


def close(system: Linear, size: float = 1.0) -> float:
    return tolerance(size=system.layout(HORIZON).size, conditioning=CONDITIONING) * max(size, 1)


@pytest.fixture(params=[physical, scaled], ids=["physical", "scaled"])
def coordinates(request, system):
    return request.param(system.layout(HORIZON)) if request.param is physical else request.param(system)


@pytest.fixture
def bound(projector, system, coordinates):
    """(P, x_init): the projection for PLANS plans."""
    x_init = np.random.default_rng(1).standard_normal((PLANS, system.state_dim))
    return bind(projector, system, x_init, coordinates), x_init


def generic(system: Linear, *shape: int) -> np.ndarray:
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
        P = bind(projector, system, x_init, coordinates)
        np.testing.assert_allclose(P(z), z, atol=close(system, np.abs(z).max()))

    def test_what_comes_out_is_admissible_in_physical_units(self, system, coordinates, bound):
        (P, _), layout = bound, system.layout(HORIZON)
        states, inputs = layout.split(coordinates.to_physical(P(generic(system, PLANS))))
        rolled = system.simulate(states[:, 0], inputs)
        np.testing.assert_allclose(rolled, states, atol=close(system, np.abs(states).max()))

    def test_a_batch_is_its_plans_one_by_one(self, projector, system, coordinates, bound):
        (P, x_init), z = bound, generic(system, PLANS)
        together = P(z)
        for k in range(PLANS):
            alone = bind(projector, system, x_init[[k]], coordinates)(z[[k]])[0]
            np.testing.assert_allclose(together[k], alone, atol=close(system))

    def test_a_fleet_is_its_robots_one_by_one(self, projector):
        robots = out_of_reach(projector, fleet())
        recording = exciting(60).record(robots)
        x_init, z = np.random.default_rng(1).standard_normal((3, PLANS, 3)), generic(robots, 3, PLANS)
        where, layout = scaled(robots), robots.layout(HORIZON)
        shown = generic(robots, 20)
        fitted = projector.fit(layout, robots, recording, shown)
        together = fitted.bind(where, pins(projector, layout, x_init))(z)
        for k, robot in enumerate(out_of_reach(projector, one) for one in members(robots)):
            own = Recording(recording.states[k], recording.inputs[k])
            alone = projector.fit(layout, robot, own, shown)
            one = alone.bind(where, pins(projector, layout, x_init[k]))(z[k])
            np.testing.assert_allclose(together[k], one, atol=close(robots))

    def test_torch_agrees_and_float32_comes_near(self, system, bound):
        (P, _), z = bound, generic(system, PLANS)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns of arrays that it must not write to
            double, single = P(torch.from_numpy(z)), P(torch.from_numpy(z).float())
        assert (double.dtype, single.dtype) == (torch.float64, torch.float32)
        np.testing.assert_allclose(double.numpy(), P(z), atol=close(system, np.abs(P(z)).max()))
        rounding = tolerance(np.float32, size=z.shape[-1]) * np.abs(P(z)).max()
        np.testing.assert_allclose(single.numpy(), P(z), atol=rounding)

    def test_it_asks_for_what_it_needs(self, projector, system):
        system, layout = out_of_reach(projector, system), system.layout(HORIZON)
        with pytest.raises(ConfigError, match=r"needs a (system|recording|dataset), and none is given"):
            projector.fit(layout)
        given = {"system": system, "recording": exciting().record(system)}
        given["demonstrations"] = trajectories(system, HORIZON, 50)[0]
        projector.fit(layout, **{name: given[name] for name in projector.needs})


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

    def test_its_rank_is_that_of_the_dynamics(self, projector, system, bound):
        (P, x_init), layout = bound, system.layout(HORIZON)
        held = len(pins(projector, layout, x_init)) * layout.state_dim
        assert P.info.rank == layout.rank - held
        assert fit(projector, system).notes["rank"] == layout.rank
        images = P(np.concatenate([np.eye(layout.size), np.zeros((1, layout.size))])) if not held else None
        assert images is None or np.linalg.matrix_rank(images[:-1] - images[-1], tol=1e-6) == layout.rank

    def test_it_agrees_with_known_on_noise_free_exciting_data(self, projector, system, coordinates, bound):
        (P, x_init), z = bound, generic(system, PLANS)
        known = bind(Known(projector.initial_state), system, x_init, coordinates)
        np.testing.assert_allclose(P(z), known(z), atol=close(system, np.abs(known(z)).max()))
        held = pins(projector, system.layout(HORIZON), x_init)
        angles = compared(fit(projector, system), fit(Known(), system), held)
        if not isinstance(projector, Koopman) and not isinstance(fit(projector, system), Limited):  # no subspaces
            assert angles["principal_angle"] < close(system)


@pytest.mark.parametrize("projector", HOLDING.values(), ids=HOLDING.keys())
def test_x_init_is_held_exactly_for_every_case_of_a_batch(system, coordinates, bound):
    (P, x_init), z = bound, generic(system, 3, PLANS)
    for batch in z:
        states = system.layout(HORIZON).states(coordinates.to_physical(P(batch)))
        np.testing.assert_allclose(states[:, 0], x_init, atol=tolerance(size=10))


def test_free_projection_does_not_hold_x_init(system):
    x_init = np.ones((PLANS, system.state_dim))
    states = system.layout(HORIZON).states(fit(Known(), system).bind()(generic(system, PLANS)))
    assert np.abs(states[:, 0] - x_init).max() > 0.1


def test_rollout_keeps_the_inputs_and_recomputes_the_states(system, coordinates):
    layout, z = system.layout(HORIZON), generic(system, PLANS)
    x_init = np.random.default_rng(1).standard_normal((PLANS, system.state_dim))
    P = bind(RolloutProjector(), system, x_init, coordinates)
    states, inputs = layout.split(coordinates.to_physical(P(z)))
    np.testing.assert_allclose(inputs, layout.inputs(coordinates.to_physical(z)), atol=close(system))
    np.testing.assert_allclose(states, system.simulate(x_init, inputs), atol=close(system))


@pytest.mark.parametrize("pinned", [(), ("terminal_state",), ("initial_state", "terminal_state")], ids=str)
def test_a_rollout_starts_at_a_pinned_x0_and_ends_anywhere(pinned):
    system, layout = SYSTEMS["paper"], SYSTEMS["paper"].layout(HORIZON)
    held = [getattr(Pin, name)(layout, np.ones((1, 4))) for name in pinned]
    with pytest.raises(ConfigError, match=r"starts at x\(0\): pin x\(0\)"):
        fit(RolloutProjector(), system).bind(pins=held)


def test_scaling_changes_the_projection_but_not_the_set(system):
    where, tau = scaled(system), generic(system, 1)
    fitted = fit(Known(), system)
    ours, theirs = fitted.bind()(tau), where.to_physical(fitted.bind(where)(where.to_scaled(tau)))
    assert np.abs(ours - theirs).max() > 1e-3
    np.testing.assert_allclose(fitted.bind()(theirs), theirs, atol=close(system, np.abs(theirs).max()))


def test_known_is_F_times_its_pseudo_inverse(system):
    F, tau = system.trajectory_map(HORIZON), generic(system, PLANS)
    np.testing.assert_allclose(fit(Known(), system).bind()(tau), tau @ (F @ np.linalg.pinv(F)).T, atol=close(system))


@pytest.mark.parametrize("initial_state", ["free", "fixed"])
@pytest.mark.parametrize(("A", "T"), [(2.0, 60), (3.0, 700)])
def test_known_holds_where_the_powers_of_A_overflow_every_digit(A, T, initial_state):
    system = Linear(np.array([[A]]), np.ones((1, 1)))
    layout, z = system.layout(T), np.random.default_rng(0).standard_normal((3, 2 * T + 1))
    fitted = Known(initial_state).fit(layout, system=system)
    x, u = layout.split(fitted.bind(pins=pins(Known(initial_state), layout, np.ones((3, 1))))(z))
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
    return compared(fitted, Known().fit(layout, system))["projector_distance"]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("process_noise", [1e-6, 0.01])
def test_noise_turns_hankel_into_the_identity_and_it_says_so(process_noise, count):
    layout = double_integrator().layout(HORIZON)
    S = identity_length(layout, count)
    with pytest.raises(
        ExcitationError, match=rf"S = {S} noisy columns span all d = {layout.size} .*use hankel_lowrank"
    ):
        Hankel().fit(layout, recording=noisy(S, process_noise, count=count))
    identity = Hankel(allow_identity=True).fit(layout, recording=noisy(S, process_noise, count=count)).bind()
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


def test_noise_that_is_taken_for_dynamics_is_warned_of(caplog):
    layout = double_integrator().layout(10)
    HankelLowRank().fit(layout, recording=noisy(400, 1e-4))
    assert not caplog.records
    HankelLowRank().fit(layout, recording=noisy(minimum_length(layout) + 6, 1.0))
    assert "noise is taken for dynamics" in caplog.text


def test_what_is_rolled_out_has_the_freedom_of_its_inputs(system):
    layout = system.layout(HORIZON)
    assert fit(RolloutProjector(), system).notes["rank"] == layout.channel("u").size == HORIZON * system.input_dim


LEARNED = {name: p for name, p in PROJECTORS.items() if "recording" in p.needs and not isinstance(p, Koopman)}
FROM_HANKEL = {name: p for name, p in LEARNED.items() if isinstance(p, Hankel | HankelLowRank)}


def affine(projector) -> int:
    """How many dimensions an estimated offset adds to what data must span."""
    return int(projector.offset == "estimated")


@pytest.mark.parametrize("projector", FROM_HANKEL.values(), ids=FROM_HANKEL.keys())
def test_a_recording_that_is_too_short_says_how_long_it_must_be(projector, system):
    layout, one = system.layout(HORIZON), affine(projector)
    needed, rank = minimum_length(layout, spare=one), f"n + mT{' + 1' * one} = {layout.rank + one}"
    with pytest.raises(ExcitationError, match=re.escape(f"{rank} are needed: record S >= {needed}") + "$"):
        projector.fit(layout, system, exciting(needed - 1).record(system))
    projector.fit(layout, system, exciting(needed).record(system))


@pytest.mark.parametrize("projector", LEARNED.values(), ids=LEARNED.keys())
@pytest.mark.parametrize("process_noise", [0.0, 0.05])
def test_a_recording_under_feedback_is_refused_with_its_rank_and_the_needed_one(projector, process_noise):
    """Under u = -K x the first input of a window follows from its first state, however much noise drives the rest."""
    system, layout = double_integrator(), double_integrator().layout(HORIZON)
    gain = np.array([[1.0, 0, 2, 0], [0, 1.0, 0, 2]])
    closed = Linear(system.A - system.B @ gain, system.B)
    rng = np.random.default_rng(0)
    noise = process_noise * rng.standard_normal((20, 40, 4))
    states = closed.simulate(rng.standard_normal((20, 4)), np.zeros((20, 40, 2)), noise)
    found = layout.rank - layout.input_dim if process_noise else layout.state_dim
    from_hankel = f"have rank {found}, n \\+ mT = {layout.rank} are needed"
    fitted = "span 5 dimensions, n \\+ m \\+ 1 = 7" if affine(projector) else "span 4 dimensions, n \\+ m = 6"
    with pytest.raises(ExcitationError, match=f"{from_hankel}|{fitted} are needed"):
        projector.fit(layout, system, Recording(states, -states[:, :-1] @ gain.T), generic(system, 5))


@pytest.mark.parametrize("projector", LEARNED.values(), ids=LEARNED.keys())
@pytest.mark.parametrize("process_noise", [0.0, 0.05])
def test_a_recording_without_inputs_is_refused(projector, process_noise):
    system = double_integrator()
    silent = GaussianExcitation(length=100, input_std=0.0, process_noise=process_noise).record(system)
    found = system.state_dim if process_noise else 0
    with pytest.raises(ExcitationError, match=f"have rank {found},|span {found + affine(projector)} "):
        projector.fit(system.layout(HORIZON), system, silent, generic(system, 5))


def test_robots_whose_recordings_differ_in_rank_are_refused():
    robots = fleet(2)
    recording = exciting(60).record(robots)
    noise = 0.1 * np.random.default_rng(0).standard_normal(recording.states.shape[1:])
    states = recording.states + np.stack([0 * noise, noise])
    with pytest.raises(ExcitationError, match="the robots' Hankel matrices have ranks from"):
        Hankel(allow_identity=True).fit(robots.layout(HORIZON), robots, Recording(states, recording.inputs))


def test_a_set_that_does_not_reach_every_start_cannot_hold_one():
    layout = double_integrator().layout(2)
    held = [Pin.initial_state(layout, np.zeros((1, 4)))]
    with pytest.raises(ExcitationError, match="span 1 of 4 dimensions, so they cannot be pinned"):
        Span(layout, np.eye(layout.size)[:, :1]).bind(pins=held)(np.ones((1, layout.size)))


def test_none_has_nothing_to_fit():
    assert component("projector", "none").fit(double_integrator().layout(HORIZON)) is None


# --- the two forms of a projection onto dynamics: dense matrices, and a recursion over blocks


def varying(system: Linear, horizon: int) -> Stages:
    """Stages that differ from one another, with an offset; some of them unstable."""
    rng, constant = np.random.default_rng(5), Stages.constant(system.A, system.B, None, horizon)
    A = constant.A * rng.uniform(0.7, 1.3, (horizon, 1, 1)) + 0.02 * rng.standard_normal(constant.A.shape)
    return Stages(A, constant.B, 0.3 * rng.standard_normal(constant.c.shape))


def both_forms(monkeypatch, stages: Stages, layout, *arguments) -> list[Projection]:
    bound = []
    for largest, kind in ((layout.size, "dense"), (0, "blocks")):
        monkeypatch.setattr(sets, "DENSE_UP_TO", largest)
        bound.append(Dynamics(layout, stages).bind(*arguments))
        assert bound[-1].info.kind == kind
    return bound


METRICS = {
    "identity": lambda d: None,
    "diagonal": lambda d: Covariance.diagonal_of(np.random.default_rng(6).uniform(0.1, 1, d)),
    "low rank": lambda d: Covariance(
        np.random.default_rng(6).uniform(0.01, 0.1, d), np.random.default_rng(7).standard_normal((d, 5))
    ),
}
HELD = {"free": (), "x(0)": ("initial_state",), "x(0), x(T)": ("initial_state", "terminal_state")}


def held_pins(names, layout, robots=()) -> list[Pin]:
    rng = np.random.default_rng(8)
    return [getattr(Pin, name)(layout, rng.standard_normal((*robots, PLANS, layout.state_dim))) for name in names]


@pytest.mark.parametrize("metric", METRICS.values(), ids=METRICS.keys())
@pytest.mark.parametrize("held", HELD.values(), ids=HELD.keys())
@pytest.mark.parametrize("robots", [SYSTEMS["n=5,m=2"], fleet()], ids=["one", "fleet"])
class TestBothForms:
    def test_their_rank_is_what_pins_leave_of_the_dynamics(self, monkeypatch, robots, held, metric):
        layout = robots.layout(10)
        for P in both_forms(monkeypatch, varying(robots, 10), layout, None, held_pins(held, layout, robots.robots)):
            assert P.info.rank == layout.rank - len(held) * layout.state_dim

    def test_they_agree_and_what_comes_out_is_in_the_set(self, monkeypatch, robots, held, metric):
        layout = robots.layout(10)
        stages, where = varying(robots, 10), Coordinates(*np.random.default_rng(9).uniform(0.3, 3, (2, layout.size)))
        dense, blocks = both_forms(monkeypatch, stages, layout, where, held_pins(held, layout, robots.robots))
        z, C = np.random.default_rng(2).standard_normal((*robots.robots, PLANS, layout.size)), metric(layout.size)
        atol = tolerance(size=layout.size, conditioning=1e3) * np.abs(dense(z, C)).max()
        np.testing.assert_allclose(blocks(z, C), dense(z, C), atol=atol)
        for P in (dense, blocks):
            assert np.abs(stages.residual(layout, where.to_physical(P(z, C)))).max() < atol
            np.testing.assert_allclose(P(P(z, C), C), P(z, C), atol=atol)
            np.testing.assert_allclose(P(torch.from_numpy(z), C).numpy(), P(z, C), atol=atol)

    def test_it_minimises_the_distance_in_the_metric(self, monkeypatch, robots, held, metric):
        """C^-1 (z - P z) is orthogonal to every difference of admissible trajectories: the KKT conditions."""
        layout = robots.layout(10)
        stages = varying(robots, 10)
        where = Coordinates(np.zeros(layout.size), np.random.default_rng(9).uniform(0.3, 3, layout.size))
        C = metric(layout.size)
        for P in both_forms(monkeypatch, stages, layout, where, held_pins(held, layout, robots.robots)):
            z, other = np.random.default_rng(2).standard_normal((2, *robots.robots, PLANS, layout.size))
            move, along = z - P(z, C), P(other, C) - P(z, C)
            weighted = move if C is None else np.linalg.solve(C.matrix, move[..., None])[..., 0]
            scale = np.linalg.norm(weighted, axis=-1) * np.linalg.norm(along, axis=-1)
            assert (np.abs((weighted * along).sum(-1)) < tolerance(size=layout.size, conditioning=1e4) * scale).all()


@pytest.mark.parametrize(
    ("A", "B", "T"), [(2.0, 1.0, 60), (3.0, 1.0, 700), (2.0, 1e-3, 60), (3.0, 0.0, 30), (1.0, 0.0, 9)]
)
@pytest.mark.parametrize("held", [(), ("initial_state",)], ids=["free", "x(0)"])
def test_blocks_hold_for_unstable_dynamics_and_for_such_that_no_input_moves(monkeypatch, A, B, T, held):
    system = Linear(np.array([[A]]), np.array([[B]]))
    layout, z = system.layout(T), np.random.default_rng(0).standard_normal((3, 2 * T + 1))
    x_init = [getattr(Pin, name)(layout, np.ones((3, 1))) for name in held]
    dense, blocks = both_forms(monkeypatch, Stages.constant(system.A, system.B, None, T), layout, None, x_init)
    x, u = layout.split(blocks(z))
    residual = x[:, 1:] - A * x[:, :-1] - B * u
    assert (np.abs(residual) / np.maximum(1, np.abs(x[:, 1:]))).max() < 1e-12
    size = np.abs(dense(z)).max(axis=-1, keepdims=True)
    np.testing.assert_allclose(blocks(z) / size, dense(z) / size, atol=1e-9)


def test_pins_that_leave_nothing_free_are_refused_in_both_forms(monkeypatch):
    system, layout = double_integrator(), double_integrator().layout(1)
    ends = [Pin.initial_state(layout, np.zeros((1, 4))), Pin.terminal_state(layout, np.ones((1, 4)))]
    for P in both_forms(monkeypatch, Stages.constant(system.A, system.B, None, 1), layout, None, ends):
        with pytest.raises(ConfigError, match="pin fewer entries"):
            P(np.zeros((1, layout.size)))


def test_pins_are_named_where_they_do_not_fit():
    layout, known = double_integrator().layout(3), fit(Known(), SYSTEMS["paper"])
    start = Pin.initial_state(layout, np.zeros((2, 4)))
    with pytest.raises(ConfigError, match="two pins hold the same entry"):
        known.bind(pins=[start, Pin(np.array([3]), np.zeros((2, 1)))])
    with pytest.raises(ShapeError, match=r"a pin of 4 entries has values of shape \(2, 3\); expected \('...', 4\)"):
        known.bind(pins=[Pin(slice(0, 4), np.zeros((2, 3)))])


def test_nothing_that_does_not_depend_on_the_pins_values_is_computed_twice(monkeypatch):
    system, layout = SYSTEMS["paper"], SYSTEMS["paper"].layout(HORIZON)
    known = Known("fixed").fit(layout, system)
    first = known.bind(pins=[Pin.initial_state(layout, np.zeros((1, 4)))])(np.ones((1, layout.size)))
    for forbidden in ("qr", "svd", "inv", "solve", "eigh", "pinv"):
        monkeypatch.delattr(np.linalg, forbidden)
    moved = known.bind(pins=[Pin.initial_state(layout, np.ones((1, 4)))])(np.ones((1, layout.size)))
    np.testing.assert_allclose(layout.states(moved)[0, 0], 1)
    assert np.abs(moved - first).max() > 0.1


def test_a_pinned_entry_in_the_middle_is_held(system):
    layout, x = system.layout(HORIZON), np.random.default_rng(1).standard_normal((PLANS, system.state_dim))
    places = np.arange(layout.size)[layout.all_states].reshape(-1, system.state_dim)[3]
    P = fit(Known(), system).bind(scaled(system), [Pin(places, x)])
    tau = scaled(system).to_physical(P(generic(system, PLANS)))
    np.testing.assert_allclose(layout.states(tau)[:, 3], x, atol=1e-12)
    rolled = system.simulate(tau[:, : system.state_dim], layout.inputs(tau))
    np.testing.assert_allclose(rolled, layout.states(tau), atol=1e-10)


def test_inpainting_holds_x0_and_nothing_else(system):
    x_init, z = np.ones((PLANS, system.state_dim)), generic(system, PLANS)
    moved = bind(Inpainting(), system, x_init)(z)
    np.testing.assert_array_equal(moved[:, : system.state_dim], x_init)
    np.testing.assert_array_equal(moved[:, system.state_dim :], z[:, system.state_dim :])


@pytest.mark.parametrize("offset", ["estimated", "known"])
def test_the_offset_of_affine_dynamics_is_learned_or_known(offset, rng):
    system, c = SYSTEMS["n=3,m=1"], np.array([0.1, -0.2, 0.3])
    inputs = rng.standard_normal((1, 60, 1))
    states = system.simulate(np.zeros((1, 3)), inputs, np.broadcast_to(c, (1, 60, 3)))
    estimate = least_squares(Transitions.of(states, inputs), offset, c if offset == "known" else None)
    for name, true in (("A", system.A), ("B", system.B), ("c", c)):
        np.testing.assert_allclose(getattr(estimate, name), true, atol=1e-10)
    biased = least_squares(Transitions.of(states, inputs))
    assert np.abs(biased.A - system.A).max() > 1e-3


def test_demonstrations_are_data_about_the_dynamics_too():
    system, layout = double_integrator(process_noise=0.05), double_integrator().layout(HORIZON)
    demonstrations = trajectories(system, HORIZON, 400)[0]
    recording, truth = exciting(30, 0.05).record(system), Known().fit(layout, system)
    distances = [
        compared(Identified(learn_from=source).fit(layout, system, recording, demonstrations), truth)
        for source in ("recording", "both", "demonstrations")
    ]
    far, nearer, exact = (entry["projector_distance"] for entry in distances)
    assert far > 3 * nearer > 3 * exact
    many = fleet()
    with pytest.raises(ConfigError, match="the demonstrations are of many robots"):
        Identified(learn_from="demonstrations").fit(many.layout(HORIZON), many, None, np.zeros((9, 39)))


def test_demonstrations_say_as_much_of_a_fleet_of_one_robot():
    system, shown = SYSTEMS["n=3,m=1"], trajectories(SYSTEMS["n=3,m=1"], HORIZON, 40)[0]
    alone, fleet_of_one = (
        Identified(learn_from="demonstrations").fit(system.layout(HORIZON), robots, demonstrations=shown)
        for robots in (system, Linear(system.A[None], system.B[None], robots=1))
    )
    assert fleet_of_one.robots == (1,)
    np.testing.assert_allclose(fleet_of_one.stages.A[0], alone.stages.A, atol=1e-12)


@pytest.mark.parametrize("horizon", [1, 3])
def test_dynamics_that_stay_the_same_are_a_system_and_others_one_that_varies(horizon, system, rng):
    layout, c = system.layout(horizon), rng.standard_normal(system.state_dim)
    stages = Stages.constant(system.A, system.B, c, horizon)
    x, inputs = (rng.standard_normal((2, *shape)) for shape in ((system.state_dim,), (horizon, system.input_dim)))
    model = model_of(Dynamics(layout, stages))
    assert isinstance(model, Linear)
    np.testing.assert_allclose(model.simulate(x, inputs), stages.simulate(x, inputs), atol=1e-12)
    for name in ("A", "B", "c") if horizon > 1 else ():
        moving = getattr(stages, name).copy()
        moving[-1] += 1
        other = replace(stages, **{name: moving})
        model = model_of(Dynamics(layout, other))
        assert isinstance(model, TimeVarying)
        np.testing.assert_allclose(model.simulate(x, inputs), other.simulate(x, inputs), atol=1e-12)


def test_where_start_and_inputs_are_pinned_nothing_is_free_and_one_pin_more_cannot_hold(system, rng):
    layout, x = system.layout(HORIZON), rng.standard_normal((PLANS, system.state_dim))
    inputs = rng.standard_normal((PLANS, HORIZON, system.input_dim))
    given = [Pin.initial_state(layout, x), Pin(layout.all_inputs, inputs.reshape(PLANS, -1))]
    target = Dynamics(layout, Stages.constant(system.A, system.B, None, HORIZON))
    P, tau = target.bind(pins=given), layout.flatten(system.simulate(x, inputs), inputs)
    assert P.info.rank == 0
    np.testing.assert_allclose(P(generic(system, PLANS)), tau, atol=close(system, np.abs(tau).max()))
    last = np.arange(layout.size)[layout.all_states][-1:]
    with pytest.raises(ConfigError, match="cannot hold together; pin fewer entries"):
        target.bind(pins=[*given, Pin(last, tau[:, last])])(tau)


# --- dynamics that are known up to what data leave open


@pytest.mark.parametrize("held", [(), ("initial_state",)], ids=["free", "x(0)"])
@pytest.mark.parametrize("robots", [SYSTEMS["n=5,m=2"], fleet()], ids=["one", "fleet"])
def test_an_uncertain_set_is_a_kalman_update_in_both_forms(monkeypatch, robots, held):
    layout, rng = robots.layout(6), np.random.default_rng(3)
    stages, d, q = varying(robots, 6), robots.layout(6).size, 7
    V, C = rng.standard_normal((*robots.robots, 6 * layout.state_dim, q)), METRICS["low rank"](d)
    z, eps = rng.standard_normal((2, *robots.robots, PLANS, d))
    G, g = stages.matrix(layout)
    rows, x_init = np.eye(d)[: layout.state_dim] if held else np.zeros((0, d)), held_pins(held, layout, robots.robots)
    for largest in (d, 0):
        monkeypatch.setattr(sets, "DENSE_UP_TO", largest)
        P = Uncertain(layout, stages, V).bind(pins=x_init)
        assert P.info.rank == layout.rank - len(rows)
        for k in np.ndindex(robots.robots):
            stacked = np.concatenate([rows, G[k]])
            R = np.zeros((len(stacked), len(stacked)))
            R[len(rows) :, len(rows) :] = V[k] @ V[k].T
            values = (
                np.concatenate([x_init[0].values[k], np.tile(g[k], (PLANS, 1))], -1)
                if held
                else np.tile(g[k], (PLANS, 1))
            )
            K = C.matrix @ stacked.T @ np.linalg.inv(stacked @ C.matrix @ stacked.T + R)
            expected = z[k] - (z[k] @ stacked.T - values) @ K.T
            np.testing.assert_allclose(P(z, C)[k], expected, atol=1e-8)
            drawn = expected + eps[k][:, :q] @ (K[:, len(rows) :] @ V[k]).T
            np.testing.assert_allclose(P(z, C, noise=eps)[k], drawn, atol=1e-8)
        tensors = P(torch.from_numpy(z), C, noise=torch.from_numpy(eps))
        np.testing.assert_allclose(tensors.numpy(), P(z, C, noise=eps), atol=1e-10)


def test_a_direction_that_is_not_known_is_not_projected(system):
    layout, z = system.layout(HORIZON), generic(system, PLANS)
    stages = Stages.constant(system.A, system.B, None, HORIZON)
    for scale, expected in ((1e-9, bind(Known(), system, z)(z)), (1e9, z)):
        V = scale * np.eye(HORIZON * system.state_dim)
        np.testing.assert_allclose(Uncertain(layout, stages, V).bind()(z), expected, atol=1e-6)


def test_the_residual_of_true_trajectories_has_the_stated_covariance():
    """Over many recordings, G_hat tau of demonstrations is as large as R says, time by time."""
    system, layout = double_integrator(process_noise=0.02), double_integrator().layout(HORIZON)
    shown = trajectories(system, HORIZON, 50)[0]
    found, stated = [], []
    for seed in range(150):
        recording = GaussianExcitation(length=300, seed=seed).record(system)
        fitted = IdentifiedSoft(residual="averaged").fit(layout, system, recording, shown)
        found.append(np.square(fitted.stages.residual(layout, shown)).mean(axis=-2))
        stated.append(np.square(fitted.spread).sum(axis=-1).reshape(HORIZON, -1))
    np.testing.assert_allclose(np.mean(found, axis=(0, 2)), np.mean(stated, axis=(0, 2)), rtol=0.2)


def test_with_more_data_it_becomes_the_hard_projection():
    system, layout = double_integrator(process_noise=0.02), double_integrator().layout(HORIZON)
    shown, z = trajectories(system, HORIZON, 200)[0], generic(system, 20)
    apart, deviations = [], []
    for length, learn_from in ((20, "recording"), (400, "recording"), (400, "both")):
        recording = GaussianExcitation(length=length, process_noise=0.5, seed=1).record(system)
        given = (layout, system, recording, shown)
        soft = IdentifiedSoft(learn_from=learn_from, residual="averaged").fit(*given)
        hard = Identified(learn_from=learn_from).fit(*given)
        apart.append(np.abs(soft.bind()(z) - hard.bind()(z)).mean())
        deviations.append(soft.notes["residual_deviation"])
    assert apart[0] > 5 * apart[1] > 5 * apart[2]
    assert deviations[0] > 3 * deviations[1] > 3 * deviations[2]


def test_where_nothing_is_known_but_x_init_what_is_correlated_with_it_moves_along(rng):
    """As a Gaussian is conditioned on some of its entries; in the identity metric nothing else moves."""
    layout = double_integrator().layout(3)
    d, held = layout.size, np.arange(4)
    where = Coordinates(rng.standard_normal(d), rng.uniform(0.5, 2, d))
    metric = Covariance(rng.uniform(0.1, 1, d), rng.standard_normal((d, 3)))
    z, x_init = rng.standard_normal((5, d)), rng.standard_normal((5, 4))
    P = Inpainting().fit(layout).bind(where, [Pin.initial_state(layout, x_init)])
    asked = (x_init - where.mean[held]) / where.scale[held] - z[:, held]
    C = metric.matrix
    moved = asked @ np.linalg.solve(C[np.ix_(held, held)], C[held])
    np.testing.assert_allclose(P(z, metric), z + moved, atol=1e-10)
    np.testing.assert_allclose(P(z), z + np.pad(asked, ((0, 0), (0, d - 4))), atol=1e-12)


@pytest.mark.parametrize("dense_up_to", [600, 10], ids=["dense", "blocks"])
def test_the_size_of_a_metric_does_not_matter(monkeypatch, dense_up_to, rng):
    monkeypatch.setattr("dadiff.behaviours.sets.DENSE_UP_TO", dense_up_to)
    system = double_integrator()
    layout = system.layout(3)
    P = Known("fixed").fit(layout, system).bind(pins=[Pin.initial_state(layout, rng.standard_normal((5, 4)))])
    z, variances = rng.standard_normal((5, layout.size)), rng.uniform(0.1, 1, layout.size)
    factor = rng.standard_normal((layout.size, 2))
    tiny = Covariance(1e-20 * variances, 1e-10 * factor)
    np.testing.assert_allclose(P(z, tiny), P(z, Covariance(variances, factor)), atol=1e-9)


def test_pins_take_their_number_from_the_rank_of_the_subspaces_of_many_robots(rng):
    layout = double_integrator().layout(3)
    span = Span(layout, rng.standard_normal((3, layout.size, 10)))
    pin = Pin.initial_state(layout, rng.standard_normal((3, 1, 4)))
    assert (span.bind().info.rank, span.bind(pins=[pin]).info.rank) == (10, 6)


# --- input-output data: the state is not measured, and a pinned past stands for it


def test_a_pinned_past_of_inputs_and_outputs_takes_the_place_of_the_state(rng):
    """Behaviours of y = C x need no state: past and future of (y, u) from a Hankel matrix, the past pinned."""
    system, C = double_integrator(process_noise=0.0), np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]])
    past, ahead = 2, 8  # as many steps as the state needs to be seen; the outputs of more would not be independent
    steps = past + ahead
    layout = Layout((Channel("y", 2, 0, steps - 1), Channel("u", 2, 0, steps - 1)))

    def recorded(length: int, count: int) -> np.ndarray:
        u = rng.standard_normal((count, length, 2))
        x = system.simulate(rng.standard_normal((count, 4)), u)
        return np.concatenate([x[:, :-1] @ C.T, u], axis=-1)

    seen = windows(recorded(200, 1), steps)[0]
    columns = layout.pack(y=seen[..., :2], u=seen[..., 2:])
    basis = np.linalg.svd(columns.T, full_matrices=False)[0][:, : 2 * steps + 4]
    shown = recorded(steps, 3)
    tau = layout.pack(y=shown[..., :2], u=shown[..., 2:])
    entries = np.arange(layout.size)
    held = np.concatenate([layout.get(entries, name)[:past].ravel() for name in ("y", "u")])
    moved = layout.get(entries, "y")[past:].ravel()
    disturbed = tau.copy()
    disturbed[:, moved] += rng.standard_normal((3, len(moved)))
    inputs = layout.get(entries, "u")[past:].ravel()
    P = Span(layout, basis).bind(pins=[Pin(np.concatenate([held, inputs]), tau[:, np.concatenate([held, inputs])])])
    np.testing.assert_allclose(P(disturbed), tau, atol=1e-9)

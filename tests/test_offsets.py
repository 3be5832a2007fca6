"""Laws of affine data: what is learned from them carries their offset, and does not depend on origin or units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from laws import exciting, fleet, random_system

from dadiff.behaviours import (
    Hankel,
    HankelLowRank,
    Identified,
    IdentifiedFamily,
    IdentifiedSoft,
    Known,
    Koopman,
    Span,
    pins,
)
from dadiff.behaviours.hulls import Hull, drift
from dadiff.errors import ConfigError, ExcitationError
from dadiff.systems import Linear, Recording
from dadiff.trajectory import TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates
from dadiff.trajectory.hankel import minimum_length

HORIZON, PLANS = 6, 5
PLANTS = {"one": random_system(3, 2, 0.02, seed=4), "fleet": fleet(2)}
PROJECTORS = {
    f"{kind.__name__}-{state}": (kind, {} if kind is Koopman else {"initial_state": state})
    for kind in (Hankel, HankelLowRank, Identified, IdentifiedSoft, IdentifiedFamily, Koopman)
    for state in (("fixed",) if kind is Koopman else ("free", "fixed"))
}
TRIM = np.array([293.0, -5.0, 40.0]), np.array([9.81, -0.3])

every_projector = pytest.mark.parametrize("projector", PROJECTORS)
every_plant = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)


def made(projector: str, offset: str):
    kind, options = PROJECTORS[projector]
    return kind(offset=offset, **options)


def affine(plant: Linear) -> Linear:
    """The plant about the trim: x - x_e follows from u - u_e."""
    x_e, u_e = TRIM
    return replace(plant, c=np.broadcast_to(x_e - plant.A @ x_e - plant.B @ u_e, (*plant.robots, 3)))


def trim_of(layout: TrajectoryLayout) -> np.ndarray:
    x_e, u_e = TRIM
    return layout.flatten(np.tile(x_e, (layout.horizon + 1, 1)), np.tile(u_e, (layout.horizon, 1)))


def data(plant: Linear, noise: float) -> tuple[Recording, np.ndarray]:
    """A recording about the trim, and demonstrations: trajectories of the family about it."""
    rng, layout = np.random.default_rng(0), plant.layout(HORIZON)
    recording = exciting(30, noise).record(plant)
    u = rng.standard_normal((*plant.robots, 60, HORIZON, 2))
    x = plant.simulate(rng.standard_normal((*plant.robots, 60, 3)), u, 0.02 * rng.standard_normal((*u.shape[:-1], 3)))
    return recording, layout.flatten(x, u).reshape(-1, layout.size)


def moved(recording: Recording, states: np.ndarray, inputs: np.ndarray) -> Recording:
    return Recording(recording.states + states, recording.inputs + inputs)


def projected(projector, fitted, plant: Linear, tau: np.ndarray, where: Coordinates | None = None) -> np.ndarray:
    """tau in physical units, projected in coordinates."""
    layout = plant.layout(HORIZON)
    where = where or Coordinates(np.zeros(layout.size), np.ones(layout.size))
    x_init = layout.states(tau)[..., 0, :]
    return where.to_physical(fitted.bind(where, pins(projector, layout, x_init))(where.to_scaled(tau)))


def generic(plant: Linear) -> np.ndarray:
    return np.random.default_rng(2).standard_normal((*plant.robots, PLANS, plant.layout(HORIZON).size))


@every_plant
@every_projector
def test_recordings_with_and_without_their_offset_removed_give_the_same_projection(projector, plant):
    layout, tau, shift = plant.layout(HORIZON), generic(plant), trim_of(plant.layout(HORIZON))
    learned = made(projector, "estimated")
    recording, shown = data(plant, 0.02)
    without = learned.fit(layout, None, recording, shown)
    with_it = learned.fit(layout, None, moved(recording, *TRIM), shown + shift)
    removed = projected(learned, without, plant, tau)
    np.testing.assert_allclose(projected(learned, with_it, plant, tau + shift) - shift, removed, atol=1e-6)
    assert np.abs(removed - tau).max() > 0.1


@every_plant
@every_projector
@pytest.mark.parametrize("offset", ["estimated", "known"])
def test_it_agrees_with_the_known_system_where_nothing_is_uncertain(projector, plant, offset):
    kind, layout = PROJECTORS[projector][0], plant.layout(HORIZON)
    if kind is IdentifiedFamily and plant.robots and offset == "known":
        pytest.skip("robots with offsets of their own: refused, see below")
    system, shift, learned = affine(plant), trim_of(layout), made(projector, offset)
    recording, shown = data(plant, 0.0)
    fitted = learned.fit(layout, system, moved(recording, *TRIM), shown + shift)
    tau = generic(plant) + shift
    truth = Known(getattr(learned, "initial_state", "free"))
    known = projected(truth, truth.fit(layout, system), plant, tau)
    atol = 0.3 if kind is IdentifiedFamily else 1e-5  # which believes the family as well
    np.testing.assert_allclose(projected(learned, fitted, plant, tau), known, atol=atol)


@every_projector
@pytest.mark.parametrize("offset", ["none", "estimated"])
def test_metres_millimetres_and_kilonewtons_give_one_set(projector, offset):
    plant = PLANTS["one"]
    layout, tau, learned = plant.layout(HORIZON), generic(plant), made(projector, offset)
    recording, shown = data(plant, 0.02)
    units = np.array([1000.0, 1000.0, 0.01]), np.array([1e-3, 57.3])
    D = layout.flatten(np.tile(units[0], (HORIZON + 1, 1)), np.tile(units[1], (HORIZON, 1)))
    other = Recording(recording.states * units[0], recording.inputs * units[1])
    usual = projected(learned, learned.fit(layout, None, recording, shown), plant, tau)
    fitted = learned.fit(layout, None, other, shown * D)
    where = Coordinates(np.zeros(layout.size), D)
    np.testing.assert_allclose(projected(learned, fitted, plant, tau * D, where) / D, usual, atol=1e-6)


def test_a_hull_needs_one_window_more_than_a_span():
    plant, layout = PLANTS["one"], PLANTS["one"].layout(HORIZON)
    for spare, offset in ((0, "none"), (1, "estimated")):
        S = minimum_length(layout, spare=spare)
        assert HankelLowRank(offset=offset).fit(layout, None, exciting(S).record(plant)).notes["rank"] == layout.rank
        with pytest.raises(ExcitationError, match=rf"{layout.rank + spare} are needed: record S >= {S}$"):
            HankelLowRank(offset=offset).fit(layout, None, exciting(S - 1).record(plant))


def test_a_hull_holds_every_combination_of_windows_whose_weights_add_up_to_one():
    plant = affine(PLANTS["one"])
    layout = plant.layout(HORIZON)
    hull = Hull.of(exciting(60).record(plant), layout, "estimated", None)
    found = hull.span(layout.rank)
    assert isinstance(found, Span)
    about_drift = Hull.of(exciting(60).record(plant), layout, "known", plant).span(layout.rank)
    for h in (found.origin, drift(plant, layout), drift(plant, layout) + 2 * (found.origin - drift(plant, layout))):
        for each in (found, about_drift):
            np.testing.assert_allclose(each.bind()(h), h, atol=1e-8 * np.abs(h).max())
    assert hull.gap(layout.rank) > 1e6


def test_a_family_whose_offsets_differ_has_no_known_one():
    plant = affine(PLANTS["fleet"])
    with pytest.raises(ConfigError, match=r"offsets differ.*use projector\.offset=estimated"):
        IdentifiedFamily(offset="known").fit(plant.layout(HORIZON), plant, *data(plant, 0.0))
    with pytest.raises(ConfigError, match="needs a system, and none is given"):
        IdentifiedFamily(offset="known").fit(plant.layout(HORIZON), None, *data(plant, 0.0))


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_do_not_decide_the_rank_of_a_hull(unit):
    """With states and inputs in another unit, their offset and sizes change alike."""
    plant = affine(PLANTS["one"])
    layout, recording = plant.layout(HORIZON), exciting(60).record(plant)
    usual = Hull.of(recording, layout, "estimated", None)
    other = replace(recording, states=unit * recording.states, inputs=unit * recording.inputs)
    found = Hull.of(other, layout, "estimated", None)
    assert found.rank == usual.rank == layout.rank
    np.testing.assert_allclose(found.sizes, usual.sizes, rtol=1e-6, atol=1e-9 * usual.sizes.max())


def test_a_hull_that_knows_of_no_offset_lies_about_0():
    """Whether it is told of none, or of no system that could have one."""
    plant = affine(PLANTS["one"])
    layout, recording = plant.layout(HORIZON), exciting(60).record(plant)
    assert Hull.of(recording, layout, "none", plant).origin is None
    assert Hull.of(recording, layout, "known", None).origin is None
    assert np.abs(Hull.of(recording, layout, "known", plant).origin).max() > 0


def test_the_gaps_of_a_fleets_hulls_are_those_of_the_robot_whose_gap_is_smallest():
    hull = Hull.of(exciting(40, 0.1).record(PLANTS["fleet"]), PLANTS["fleet"].layout(HORIZON), "none", None)
    count = hull.sizes.shape[-1]
    for rank in range(1, count):
        assert hull.gap(rank) == pytest.approx(min(s[rank - 1] / s[rank] for s in hull.sizes))
    assert hull.gap(count) == np.inf

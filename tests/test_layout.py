"""Laws of the layout: one order of states and inputs, for numpy and torch, any sizes and batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dadiff.errors import ConfigError, ShapeError
from dadiff.trajectory import Channel, Layout, TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates, physical, standardised

sizes = st.builds(TrajectoryLayout, *[st.integers(1, 6)] * 3)
batches = st.lists(st.integers(1, 3), max_size=3).map(tuple)


def numbered(layout: TrajectoryLayout, batch: tuple[int, ...] = ()) -> np.ndarray:
    return np.arange(np.prod((*batch, layout.size), dtype=int), dtype=float).reshape(*batch, layout.size)


@given(sizes, batches)
def test_flatten_inverts_split(layout, batch):
    tau = numbered(layout, batch)
    states, inputs = layout.split(tau)
    assert states.shape == (*batch, layout.horizon + 1, layout.state_dim)
    assert inputs.shape == (*batch, layout.horizon, layout.input_dim)
    assert np.array_equal(layout.flatten(states, inputs), tau)


@given(sizes, batches)
def test_torch_and_numpy_agree(layout, batch):
    tau = numbered(layout, batch)
    parts = layout.split(torch.from_numpy(tau))
    for ours, theirs in zip(parts, layout.split(tau), strict=True):
        assert np.array_equal(ours.numpy(), theirs)
    assert np.array_equal(layout.flatten(*parts).numpy(), tau)


@given(sizes)
def test_states_come_before_inputs_and_time_runs_slowest(layout):
    tau = numbered(layout)
    assert np.array_equal(tau[layout.initial_state], layout.states(tau)[0])
    assert np.array_equal(tau[layout.all_states], layout.states(tau).ravel())
    assert np.array_equal(tau[layout.all_inputs], layout.inputs(tau).ravel())
    assert layout.all_states.stop == layout.all_inputs.start
    assert layout.all_inputs.stop == layout.size


def test_the_paper_has_184_entries_of_which_64_are_free():
    layout = TrajectoryLayout(state_dim=4, input_dim=2, horizon=30)
    assert (layout.size, layout.rank) == (184, 64)


def test_wrong_sizes_are_refused():
    layout = TrajectoryLayout(4, 2, 30)
    with pytest.raises(ShapeError, match=r"183 entries; n = 4, m = 2, T = 30 need n\(T\+1\) \+ mT = 184"):
        layout.split(np.zeros(183))
    with pytest.raises(ShapeError, match=r"states have shape \(30, 4\); expected \(\.\.\., 31, 4\)"):
        layout.flatten(np.zeros((30, 4)), np.zeros((30, 2)))
    with pytest.raises(ShapeError, match=r"inputs have shape \(31, 2\); expected \(\.\.\., 30, 2\)"):
        layout.flatten(np.zeros((31, 4)), np.zeros((31, 2)))
    with pytest.raises(ShapeError, match="horizon is 0; it must be at least 1"):
        TrajectoryLayout(4, 2, 0)


channels = st.lists(st.tuples(st.integers(0, 3), st.none() | st.integers(-1, 3)), max_size=5).map(
    lambda found: tuple(Channel(f"c{k}", dim, 0, last) for k, (dim, last) in enumerate(found))
)


@given(channels.map(Layout), batches)
def test_unpack_inverts_pack_and_channels_lie_one_after_the_other(layout, batch):
    flat = numbered(layout, batch)
    parts = layout.unpack(flat)
    assert all(parts[c.name].shape == (*batch, *c.shape) for c in layout.channels)
    if layout.channels:
        assert np.array_equal(layout.pack(**parts), flat)
        assert np.array_equal(layout.pack(**{k: torch.from_numpy(v) for k, v in parts.items()}).numpy(), flat)
    places = [layout.where(name) for name in layout.names]
    assert [p.start for p in places[1:]] == [p.stop for p in places[:-1]]
    assert layout.size == sum(p.stop - p.start for p in places)


def test_a_trajectory_is_a_layout_of_x_and_u(rng):
    layout = TrajectoryLayout(3, 2, 5)
    tau = rng.standard_normal((4, layout.size))
    assert layout.names == ("x", "u")
    assert np.array_equal(layout.get(tau, "x"), layout.states(tau))
    assert np.array_equal(layout.pack(x=layout.states(tau), u=layout.inputs(tau)), tau)
    assert layout == TrajectoryLayout(3, 2, 5, state_names=("a", "b", "c"))
    assert layout != TrajectoryLayout(3, 2, 6)
    assert len({layout, TrajectoryLayout(3, 2, 5)}) == 1


def test_what_a_layout_does_not_hold_is_refused():
    layout = Layout((Channel("x_init", 2), Channel("target", 3)))
    with pytest.raises(ShapeError, match=r"found 4 entries; x_init \(2\), target \(3\) make 5"):
        layout.get(np.zeros(4), "target")
    with pytest.raises(ShapeError, match="no channel 'goal'; found x_init, target"):
        layout.where("goal")
    with pytest.raises(ShapeError, match="no channel 'goal'; expected x_init, target"):
        layout.pack(x_init=np.zeros(2), goal=np.zeros(3))
    with pytest.raises(ShapeError, match="'target' is missing"):
        layout.pack(x_init=np.zeros(2))
    with pytest.raises(ShapeError, match=r"target have shape \(2,\); expected \(\.\.\., 3\)"):
        layout.pack(x_init=np.zeros(2), target=np.zeros(2))
    with pytest.raises(ShapeError, match="every name may stand once"):
        Layout((Channel("a", 1), Channel("a", 2)))
    with pytest.raises(ShapeError, match="channel a: 1 labels for 2 entries"):
        Channel("a", 2, labels=("p",))
    with pytest.raises(ShapeError, match="channel a: dim is -1"):
        Channel("a", -1)


def test_scaling_and_back_is_the_identity(rng):
    layout = TrajectoryLayout(3, 2, 5)
    tau = 7 + 3 * rng.standard_normal((4, 6, layout.size))
    for where in (physical(layout), standardised(layout, tau)):
        np.testing.assert_allclose(where.to_physical(where.to_scaled(tau)), tau, rtol=1e-14)
        np.testing.assert_allclose(where.to_scaled(torch.from_numpy(tau)).numpy(), where.to_scaled(tau), rtol=1e-14)
    assert np.array_equal(physical(layout).to_scaled(tau), tau)


def test_standardised_channels_have_mean_0_and_deviation_1(rng):
    layout = TrajectoryLayout(3, 2, 5)
    tau = rng.standard_normal((50, layout.size)) * np.linspace(1, 9, layout.size) + 4
    tau[..., layout.all_inputs] = 0.1  # what never varies keeps its unit, whatever the rounding of its mean
    where = standardised(layout, tau)
    states, inputs = layout.split(where.to_scaled(tau))
    np.testing.assert_allclose(states.mean((0, 1)), 0, atol=1e-13)
    np.testing.assert_allclose(states.std((0, 1)), 1, rtol=1e-13)
    np.testing.assert_allclose(inputs, 0, atol=1e-13)
    assert (where.scale[layout.all_inputs] == 1).all()


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_scale_must_be_positive_and_finite(scale):
    with pytest.raises(ConfigError, match="every scale must be positive and finite"):
        Coordinates(np.zeros(3), np.full(3, scale))

"""Laws of Hankel matrices: windows in columns, and lengths counted rightly."""

from __future__ import annotations

import numpy as np
import pytest
from laws import exciting, fleet, members, tolerance

from dadiff.errors import ExcitationError
from dadiff.trajectory.hankel import identity_length, minimum_length, trajectory_matrix, windows

HORIZON = 6


def test_columns_are_windows(rng):
    signal = rng.standard_normal((9, 2))
    found = windows(signal, 4)
    assert found.shape == (6, 4, 2)
    for j in range(6):
        assert np.array_equal(found[j], signal[j : j + 4])


def test_every_noise_free_column_is_a_trajectory(system):
    layout, recording = system.layout(HORIZON), exciting(60).record(system)
    H = trajectory_matrix(recording.states, recording.inputs, layout)
    assert H.shape == (layout.size, 60 - HORIZON + 1)
    states, inputs = layout.split(H.T)
    rolled = system.simulate(states[:, 0], inputs)
    np.testing.assert_allclose(rolled, states, atol=tolerance(size=layout.size) * np.abs(states).max())


def test_the_shortest_recording_gives_n_plus_mT_columns(system):
    layout = system.layout(HORIZON)
    for count in (1, 2, 3):
        S = minimum_length(layout, count)
        recording = exciting(S, count=count).record(system)
        assert count * (S - HORIZON + 1) >= layout.rank > count * (S - HORIZON)
        assert trajectory_matrix(recording.states, recording.inputs, layout).shape[-1] >= layout.rank
        short = exciting(S - 1, count=count).record(system)
        with pytest.raises(ExcitationError, match=rf"S = {S - 1} is too short: .*record S >= {S}$"):
            trajectory_matrix(short.states, short.inputs, layout)


def test_lengths_of_the_paper():
    from dadiff.trajectory import TrajectoryLayout

    assert minimum_length(TrajectoryLayout(4, 2, 30)) == 93
    assert identity_length(TrajectoryLayout(4, 2, 30)) == 213


def test_a_recording_shorter_than_the_horizon_is_told_how_long_it_must_be(system):
    layout, recording = system.layout(HORIZON), exciting(HORIZON - 2).record(system)
    with pytest.raises(ExcitationError, match=f"gives? 0 windows of T = 6; .*record S >= {minimum_length(layout)}"):
        trajectory_matrix(recording.states, recording.inputs, layout)


def test_several_recordings_stand_side_by_side(system):
    layout, recording = system.layout(HORIZON), exciting(40, count=2).record(system)
    H = trajectory_matrix(recording.states, recording.inputs, layout)
    each = [trajectory_matrix(recording.states[[k]], recording.inputs[[k]], layout) for k in range(2)]
    assert np.array_equal(H, np.concatenate(each, axis=-1))


def test_a_fleet_is_its_robots_one_by_one():
    robots = fleet()
    layout, recording = robots.layout(HORIZON), exciting(40, process_noise=None, count=2).record(robots)
    together = trajectory_matrix(recording.states, recording.inputs, layout)
    for k, _ in enumerate(members(robots)):
        assert np.array_equal(together[k], trajectory_matrix(recording.states[k], recording.inputs[k], layout))

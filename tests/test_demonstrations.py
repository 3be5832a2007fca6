"""Demonstrations are read like recordings: every form and format, cut into windows of T inputs, E taken from them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_physics import COLUMNS, FORMS, HARMED, REFUSED, SYSTEM, U, X, run, written_as

from dadiff.datasets import NpzTrajectories, demonstrations_of
from dadiff.errors import ConfigError, DataError
from dadiff.tasks import LQR, Demonstrations

T, TASK, LAYOUT = 30, LQR(horizon=30), SYSTEM.layout(30)


def learned(root: Path, columns=None, task: LQR = TASK, **options) -> Demonstrations:
    return NpzTrajectories(str(root), columns=columns, **options).train(task, SYSTEM)


def written(root: Path, **arrays) -> Path:
    (root / "train").mkdir(exist_ok=True)
    np.savez(root / "train" / "a.npz", **arrays)
    return root


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_a_recording_is_taken_and_cut_into_windows(name, tmp_path, caplog):
    shown = learned(written(tmp_path, **FORMS[name]))
    rows = len(U) - (name == "as many")
    states, inputs = LAYOUT.split(shown.trajectories)
    assert len(states) == rows - T + 1
    for k in (0, 17, len(states) - 1):
        np.testing.assert_allclose(states[k], X[k : k + T + 1], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(inputs[k], U[k : k + T], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(shown.environment, np.hstack([states[:, 0], states[:, -1]]))
    assert f"1 runs are cut into {len(states)} trajectories of 30 inputs" in caplog.text
    assert "no target is given" in caplog.text


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_recording_may_be_no_demonstration_may_be(name, tmp_path):
    arrays, told = REFUSED[name]
    with pytest.raises(DataError, match=rf"train/a\.npz: .*{told}"):
        learned(written(tmp_path, **arrays))


@pytest.mark.parametrize("kind", ["minari", "d4rl", "lerobot", "csv", "semicolons"])
def test_episodes_of_others_are_demonstrations_each_with_its_windows(kind, tmp_path):
    runs = [run(40 + 7 * k, k, 1.0 * k) for k in range(4)]
    columns = written_as(kind, tmp_path / "train", runs)
    lost = kind != "minari" and kind != "d4rl"  # where the last state is not written down
    assert len(learned(tmp_path, columns).trajectories) == sum(len(u) - lost - T + 1 for _, u in runs)
    assert len(learned(tmp_path, columns, train_size=2, stride=4).trajectories) == sum(
        (len(u) - lost - T) // 4 + 1 for _, u in runs[:2]
    )


def test_episodes_in_one_file_are_cut_and_each_has_its_own_target(tmp_path):
    states, inputs, _ = HARMED["glued"]
    goals = np.arange(32.0).reshape(8, 4)
    shown = learned(
        written(tmp_path, states=states, inputs=inputs, episode_ends=40 * np.arange(1, 9), target_state=goals)
    )
    assert len(shown.trajectories) == 7 * (39 - T + 1) + 40 - T + 1
    np.testing.assert_array_equal(np.unique(shown.environment[:, 4:], axis=0), goals)


@pytest.mark.parametrize(("target", "expected"), [
    (np.ones(4), np.ones((271, 4))),
    (np.repeat([[1.0] * 4, [2.0] * 4], [150, 151], axis=0), np.repeat([[1.0] * 4, [2.0] * 4], [120, 121], axis=0)),
])  # fmt: skip
def test_windows_have_the_target_that_holds_within_them(target, expected, tmp_path, caplog):
    shown = learned(written(tmp_path, states=X, inputs=U, target_state=target))
    np.testing.assert_array_equal(shown.environment[:, 4:], expected)
    assert ("target_state changes within 30 of 271 windows" in caplog.text) == (len(expected) < 271)


def test_columns_name_the_target_of_a_table_and_data_frames_are_taken_as_they_are():
    table = pd.DataFrame(np.hstack([X[:-1], U, np.ones((300, 4))]), columns=[*"abcdefghij"])
    columns = {"states": [*"abcd"], "inputs": [*"ef"], "target": [*"ghij"]}
    shown = demonstrations_of([table], columns, SYSTEM, TASK, stride=30)
    np.testing.assert_array_equal(shown.environment, np.hstack([X[:269:30], np.ones((9, 4))]))


def test_test_cases_do_not_overlap_and_those_that_were_learned_from_are_counted(tmp_path, caplog):
    written(tmp_path, states=X, inputs=U)
    (tmp_path / "test").mkdir()
    other = run(60, 5)
    both = {"states": np.vstack([X[:61], other[0]]), "inputs": np.vstack([U[:60], U[:1], other[1]])}
    np.savez(tmp_path / "test" / "b.npz", **both, episode_ends=np.array([61]))
    cases = NpzTrajectories(str(tmp_path)).test(TASK, SYSTEM)
    np.testing.assert_array_equal(cases.x_init, [*X[[0, 30]], *other[0][[0, 30]]])
    assert cases.notes["also_in_train"] == 2


LENGTHS = {
    "some": ([30, 45, 30, 12], "1 of 4 demonstrations have fewer than the 30 inputs .*3.npz has 12; they are left out"),
    "most": ([30, 29, 24, 26], "3 of 4 .*2.npz has 24: set task.horizon=24, which all have"),
}  # fmt: skip


@pytest.mark.parametrize("name", LENGTHS)
def test_short_ones_are_left_out_and_said_and_refused_where_most_are(name, tmp_path, caplog):
    lengths, told = LENGTHS[name]
    (tmp_path / "train").mkdir()
    for k, length in enumerate(lengths):
        np.savez(tmp_path / "train" / f"{k}.npz", states=X[: length + 1], inputs=U[:length])
    if name == "most":
        with pytest.raises(DataError, match=told):
            learned(tmp_path)
        return
    assert len(learned(tmp_path).trajectories) == 1 + 16 + 1
    assert re.search(told, caplog.text)


def test_padding_is_noticed(tmp_path):
    (tmp_path / "train").mkdir()
    for k in range(10):
        states, inputs = run(30, k, 1.0)
        states[20:], inputs[20:] = states[20], 0
        np.savez(tmp_path / "train" / f"{k}.npz", states=states, inputs=inputs)
    with pytest.raises(DataError, match="repeat the one before, fit: padding"):
        learned(tmp_path)


def test_some_with_and_some_without_a_target_are_refused(tmp_path):
    written(tmp_path, states=X, inputs=U, target_state=np.zeros(4))
    np.savez(tmp_path / "train" / "b.npz", states=X, inputs=U)
    with pytest.raises(DataError, match=r"b\.npz: has no array target_state, where others have one"):
        learned(tmp_path)


def test_windows_that_do_not_fit_into_memory_are_told_before_they_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr("dadiff.memory.available", lambda: 1e5)
    with pytest.raises(ConfigError, match=r"train: 271 windows of 30 inputs; a larger dataset\.stride .* of memory"):
        learned(written(tmp_path, states=X[:301], inputs=U))


@pytest.mark.parametrize("name", ["train_size", "test_size", "stride"])
def test_sizes_below_one_are_refused(name):
    with pytest.raises(ConfigError, match=f"dataset: {name} is 0; it must be at least 1"):
        NpzTrajectories("x", **{name: 0})


def test_what_is_taken_counts_and_what_is_as_before_does_not(tmp_path):
    written(tmp_path, states=X, inputs=U)
    one = NpzTrajectories(str(tmp_path)).determined_by("train")
    assert set(one) == {"content", "size"}
    assert NpzTrajectories(str(tmp_path), columns=COLUMNS).determined_by("train") != one
    assert NpzTrajectories(str(tmp_path), stride=2).determined_by("train") != one


def test_of_many_files_the_same_is_said_a_few_times(tmp_path, caplog):
    (tmp_path / "train").mkdir()
    for k in range(9):
        np.savez(tmp_path / "train" / f"{k}.npz", states=X[:31], inputs=U[:31])
    with caplog.at_level("INFO"):
        learned(tmp_path)
    assert caplog.text.count("the last input, whose next state is not there") == 3
    assert "... and so on, 6 times more" in caplog.text

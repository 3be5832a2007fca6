"""Data are held against the system that they are used with: what is wrong is refused, and its cause named."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dadiff.datasets import NpzRecordings, NpzTrajectories
from dadiff.datasets.physics import check_excited, mismatch
from dadiff.errors import DataError, ExcitationError
from dadiff.systems import double_integrator
from dadiff.tasks import LQR

SYSTEM = double_integrator()
COLUMNS = {"states": ["x", "y", "vx", "vy"], "inputs": ["ax", "ay"]}


def run(length: int = 300, seed: int = 0, x_init: float = 0.0, system=SYSTEM) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((length, 2))
    return system.simulate(np.full(4, x_init), u, 0.01 * rng.standard_normal((length, 4))), u


X, U = run()


def at(values: np.ndarray, row, value) -> np.ndarray:
    changed = values.copy()
    changed[row] = value
    return changed


HARMED = {
    "offset": (run(system=SYSTEM)[0] + np.cumsum(np.full((301, 4), [0, 0, 0.02, 0.5]), 0) * [0, 0, 1, 1], U, ""),
    "trim": (X, U + np.array([1.0, -0.7]), "a constant offset"),
    "delay": (X[:-1], U[1:], "act one sample later fit: a delay"),
    "shift": (X[1:], U[:-1], "act one sample earlier fit"),
    "rate": (*run(system=double_integrator(time_step=0.05)), "times as long fit: another sampling rate"),
    "glitch": (at(X, (100, 1), X[100, 1] + 5), U, "single glitches"),
    "zeros": (at(X, [50, 60, 70], 0), U, "lost samples"),
    "sentinel": (at(X, (50, 0), -9999), U, "lost samples"),
    "padding": (at(X, slice(250, None), X[250]), at(U, slice(250, None), 0), "padding"),
    "order": (X[:, [2, 3, 0, 1]], U, r"order \[2, 3, 0, 1\] fit"),
    "interleaved": (X[:, [0, 2, 1, 3]], U, r"order \[0, 2, 1, 3\] fit"),
    "swapped inputs": (X, U[:, ::-1], "inputs in the other order fit"),
    "centimetres": (X * [100, 1, 1, 1], U, "state 0 taken 0.01 times"),
    "kilonewtons": (X, U / 1000, "every input taken 1000 times"),
    "glued": (
        np.concatenate([run(40, k, 1.0 * k)[0][:-1] for k in range(8)] + [run(40, 7, 7.0)[0][-1:]]),
        np.concatenate([run(40, k)[1] for k in range(8)]),
        "glued episodes or resets",
    ),
}


@pytest.mark.parametrize("name", HARMED)
def test_what_is_wrong_with_data_is_found_and_named(name, tmp_path):
    states, inputs, cause = HARMED[name]
    found = mismatch(SYSTEM, states[None], inputs[None])
    assert found.ratio > 2
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs)
    if found.ratio >= 5:
        with pytest.raises(
            DataError, match=rf"a\.npz: the data do not obey .*times its process noise.*{cause}"
        ) as told:
            NpzRecordings(str(tmp_path)).record(SYSTEM)
        assert "\n" not in str(told.value)
    assert NpzRecordings(str(tmp_path), allow_mismatch=True).record(SYSTEM).notes["recording_residual"] == found.ratio


def test_good_data_have_a_residual_of_one_and_cost_no_word(tmp_path, caplog):
    np.savez(tmp_path / "a.npz", states=X, inputs=U)
    with caplog.at_level(logging.WARNING):
        notes = NpzRecordings(str(tmp_path)).record(SYSTEM).notes
    assert notes["recording_residual"] == pytest.approx(1.0, abs=0.05)
    assert notes["excitation_condition"] < 3
    assert not caplog.text


def test_where_no_noise_is_configured_steps_are_the_measure():
    quiet = double_integrator(process_noise=0.0)
    states = quiet.simulate(np.zeros(4), U)[None]
    assert mismatch(quiet, states, U[None]).ratio < 1e-3
    assert mismatch(quiet, states, U[None] + 0.5).ratio > 5


SINE = np.stack([5 * np.sin(0.3 * np.arange(400)), 5 * np.cos(0.3 * np.arange(400))], -1)
POOR = {
    "constant": at(U, (slice(None), 1), 0.25),
    "zero": at(U, (slice(None), 1), 0.0),
    "trembling": at(U, (slice(None), 1), 0.25 + 1e-7 * U[:, 0]),
    "twice the same": U[:, [0, 0]],
    "sine": SINE,
    "sine in float32": SINE.astype(np.float32),
    "sine of 12 bits": np.round(SINE / 5 * 2047) / 2047 * 5,
}


@pytest.mark.parametrize("name", POOR)
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e6])
def test_inputs_that_do_not_excite_are_refused_in_every_precision_and_unit(name, scale):
    with pytest.raises(ExcitationError, match=r"^where: .*every input vary on its own"):
        check_excited(scale * np.asarray(POOR[name], dtype=np.float64)[None], 5, "where")


@pytest.mark.parametrize("inputs", [U, (U > 0).astype(float), np.repeat(U[::2], 2, axis=0), U * [1e-3, 1e3]])
def test_inputs_that_excite_are_taken(inputs):
    assert check_excited(inputs[None], 5, "where") < 100


FORMS = {
    "plain": {"states": X, "inputs": U},
    "other names": {"observations": X, "actions": U},
    "trailing axis": {"states": X[..., None], "inputs": U[..., None]},
    "batch axis": {"states": X[None], "inputs": U[None]},
    "float32": {"states": X.astype(np.float32), "inputs": U.astype(np.float32)},
    "as many": {"states": X[:-1], "inputs": U},
    "metadata": {"states": X, "inputs": U, "meta": np.array({"robot": 7}, dtype=object)},
    "time": {"states": X, "inputs": U, "time": 0.1 * np.arange(301)},
    "dt": {"states": X, "inputs": U, "dt": np.array(0.1)},
}


@pytest.mark.parametrize("name", FORMS)
def test_what_can_be_read_in_one_way_only_is_taken(name, tmp_path):
    np.savez(tmp_path / "a.npz", **FORMS[name])
    recording = NpzRecordings(str(tmp_path)).record(SYSTEM)
    np.testing.assert_allclose(recording.states[0], X[: recording.length + 1], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_tables_are_read_by_the_names_of_their_columns(ending, tmp_path):
    table = pd.DataFrame(np.hstack([X[:-1], U]), columns=["x", "y", "vx", "vy", "ax", "ay"])
    table.to_csv(tmp_path / "a.csv", index=False) if ending == "csv" else table.to_parquet(tmp_path / "a.parquet")
    np.testing.assert_allclose(NpzRecordings(str(tmp_path), COLUMNS).record(SYSTEM).states[0], X[:-1], rtol=1e-12)
    with pytest.raises(DataError, match=r"has no column 'z'; found x, y, vx"):
        NpzRecordings(str(tmp_path), {"states": ["z"], "inputs": ["ax"]}).record(SYSTEM)
    with pytest.raises(DataError, match=r"say which columns are which: recording\.columns="):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


REFUSED = {
    "transposed": ({"states": X.T, "inputs": U.T}, r"shape \(4, 301\); expected \(any, 4\); transpose it\?"),
    "outputs": ({"u": U, "y": X[1:, :1]}, "input-output data are not offered"),
    "objects": ({"states": np.array([X, X[:5]], dtype=object), "inputs": U}, "Object arrays cannot be loaded"),
    "nan": ({"states": at(X, (7, 0), np.nan), "inputs": U}, "not finite, first in row 7"),
    "rows": ({"states": X[:-5], "inputs": U}, "has 296 states and 300 inputs; expected one state more, or as many"),
    "time": (
        {"states": X, "inputs": U, "time": 0.02 * np.arange(301)},
        r"its time step is 0\.02 s, the system's 0\.1 s",
    ),
    "dt": ({"states": X, "inputs": U, "dt": np.array(0.2)}, r"its time step is 0\.2 s"),
    "ends": ({"states": X, "inputs": U, "episode_ends": np.array([50, 20])}, "expected rising numbers of rows"),
    "text": ({"states": np.array([["a"]]), "inputs": U}, "expected real numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_is_refused_with_the_remedy(name, tmp_path):
    arrays, told = REFUSED[name]
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(DataError, match=rf"^{tmp_path}/a\.npz: .*{told}"):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


def test_episodes_in_one_file_are_cut_where_they_end(tmp_path):
    states, inputs, _ = HARMED["glued"]
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs, episode_ends=40 * np.arange(1, 9))
    recording = NpzRecordings(str(tmp_path)).record(SYSTEM)
    assert recording.notes["recording_residual"] == pytest.approx(1, abs=0.1)
    assert recording.length == 39


def demonstrations(folder: Path, count: int, seed: int = 0) -> None:
    folder.mkdir(parents=True)
    for k in range(count):
        states, inputs = run(30, seed + k, 1.0)
        np.savez(folder / f"{k}.npz", states=states, inputs=inputs, initial_state=states[0], target_state=states[-1])


def test_demonstrations_are_held_against_the_system_and_against_the_test_set(tmp_path, caplog):
    demonstrations(tmp_path / "train", 20)
    demonstrations(tmp_path / "test", 5, seed=17)
    data = NpzTrajectories(str(tmp_path))
    assert data.train(LQR(), SYSTEM).notes["residual"] == pytest.approx(1, abs=0.1)
    assert data.test(LQR(), SYSTEM).notes == {"also_in_train": 3}
    assert "3 of 5 test trajectories are also in train" in caplog.text
    with pytest.raises(DataError, match=r"train: the data do not obey .* another sampling rate"):
        data.train(LQR(), double_integrator(time_step=0.2))

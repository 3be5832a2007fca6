"""Data are held against the system that they are used with: what is wrong is refused, and its cause named."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from dadiff.datasets import NpzRecordings, NpzTrajectories, recording_of
from dadiff.datasets.excitation import check_excited, tell_held
from dadiff.datasets.physics import mismatch
from dadiff.errors import DataError, ExcitationError
from dadiff.store.record import is_odd
from dadiff.systems import Linear, double_integrator, unknown
from dadiff.tasks import LQR

SYSTEM, UNKNOWN = double_integrator(), unknown(4, 2)
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
    "weak actuators": (
        run(system=replace(SYSTEM, B=SYSTEM.B * [1.0, 0.4]))[0],
        U,
        r"act \(1, 0\.4\) times as strongly",
    ),
    "rounded": (np.round(X, 1), U, r"rounded to steps of .0\.1, 0\.1, 0\.1, 0\.1. explain it: record finer"),
    "another model": (
        run(system=replace(SYSTEM, A=SYSTEM.A - 0.1 * np.eye(4)))[0],
        U,
        "of their own fit: another robot",
    ),
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


def test_a_recording_in_one_other_unit_is_taken_where_dynamics_have_no_offset_and_it_is_said(tmp_path, caplog):
    counts = {"states": np.round(1000 * X).astype(np.int32), "inputs": np.round(1000 * U).astype(np.int16)}
    np.savez(tmp_path / "a.npz", **counts)
    taken = NpzRecordings(str(tmp_path)).record(SYSTEM)
    assert taken.notes["recording_residual"] > 100
    assert "everything taken 0.001 times fits" in caplog.text
    assert "the same in all units" in caplog.text
    lifted = replace(SYSTEM, c=np.array([0, 0, 0.2, 0]))
    np.savez(tmp_path / "a.npz", states=1000 * run(system=lifted)[0], inputs=1000 * U)
    with pytest.raises(DataError, match="a constant offset"):
        NpzRecordings(str(tmp_path)).record(lifted)


@pytest.mark.parametrize("bad", ["glitch", "order", "trim"])
def test_one_bad_file_among_many_is_found_and_named(bad, tmp_path):
    for k in range(30):
        states, inputs = HARMED[bad][:2] if k == 17 else run(seed=k + 1)
        np.savez(tmp_path / f"{k:02d}.npz", states=states[:31], inputs=inputs[:30])
    tau = [np.load(file) for file in sorted(tmp_path.glob("*.npz"))]
    found = mismatch(SYSTEM, np.stack([t["states"] for t in tau]), np.stack([t["inputs"] for t in tau]))
    assert found.worst[0] == 17 or bad == "glitch"  # which lies after its first 30 steps
    assert bad == "glitch" or "the other 29 of 30 trajectories obey it" in found.cause


def test_a_robot_of_a_fleet_is_judged_like_a_system(tmp_path):
    robots = Linear(np.stack([SYSTEM.A] * 2), np.stack([SYSTEM.B, 0.3 * SYSTEM.B]), process_noise=0.01, robots=2)
    for k in range(2):
        (tmp_path / f"robot_{k}").mkdir()
        np.savez(tmp_path / f"robot_{k}" / "a.npz", states=X, inputs=U)
    with pytest.raises(DataError, match=r"robot_1/a\.npz: the data do not obey .*times as strongly fit"):
        NpzRecordings(str(tmp_path)).record(robots)
    notes = NpzRecordings(str(tmp_path), allow_mismatch=True).record(robots).notes
    assert notes["recording_residual"] > 5


@pytest.mark.parametrize(("harm", "told"), [
    ("padding", "padding"), ("glitch", "single glitches"), ("glued", "glued episodes"), ("delay", "one sample later"),
    ("zeros", "lost samples"), ("shift", "one sample earlier"),
])  # fmt: skip
def test_data_of_an_unknown_system_are_held_against_what_fits_them(harm, told, tmp_path, caplog):
    states, inputs, _ = HARMED[harm]
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs)
    NpzRecordings(str(tmp_path), allow_mismatch=True).record(UNKNOWN)
    assert told in caplog.text


@pytest.mark.parametrize("harm", ["trim", "rate", "order", "interleaved", "centimetres", "kilonewtons"])
def test_what_needs_no_system_to_be_right_is_no_matter_where_it_is_unknown(harm, tmp_path, caplog):
    states, inputs, _ = HARMED[harm]
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs)
    assert NpzRecordings(str(tmp_path)).record(UNKNOWN).notes["recording_residual"] == pytest.approx(1, abs=0.1)
    assert not caplog.text


@pytest.mark.parametrize("system", ["known", "unknown"])
def test_files_of_two_plants_disagree(system, tmp_path, caplog):
    np.savez(tmp_path / "a.npz", states=X, inputs=U)
    np.savez(tmp_path / "b.npz", states=run(system=replace(SYSTEM, B=SYSTEM.B / 2))[0], inputs=U)
    NpzRecordings(str(tmp_path)).record(UNKNOWN if system == "unknown" else SYSTEM)
    assert "times as strongly fit: an actuator that was changed" in caplog.text


@pytest.mark.parametrize("harm", ["trim", "offset"])
def test_with_an_offset_estimated_such_data_are_as_good_as_any(harm, tmp_path, caplog):
    np.savez(tmp_path / "a.npz", states=HARMED["trim"][0], inputs=HARMED["trim"][1])
    notes = NpzRecordings(str(tmp_path), offset="estimated").record(SYSTEM).notes
    assert notes["recording_residual"] == pytest.approx(1, abs=0.05)
    assert notes["offset_residual"] > 2
    assert is_odd("offset_residual", notes)
    assert "the robot has an offset that the configured system has not, c = [" in caplog.text


def test_where_no_noise_is_configured_what_the_residual_would_be_is_said(tmp_path):
    np.savez(tmp_path / "a.npz", states=X, inputs=U)
    told = (
        r"as system\.process_noise is 0 \(if the residual is noise, set it to \[0\.0\d+, 0\.0\d+, 0\.0\d+, 0\.0\d+\]\)"
    )
    with pytest.raises(DataError, match=told):
        NpzRecordings(str(tmp_path)).record(double_integrator(process_noise=0.0))


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


@pytest.mark.parametrize(("inputs", "samples"), [
    (np.repeat(U[::3], 3, axis=0), 3), (U, 1), (np.repeat(U[::2], 2, axis=0)[:, [0]], 2), ((U > 0).astype(float), 1),
    (np.stack([np.repeat(U[::2, 0], 2), U[:, 1]], -1), 1), (np.full((20, 2), 0.3), 1),
])  # fmt: skip
def test_inputs_that_are_held_are_noticed(inputs, samples, caplog):
    assert tell_held([inputs], "where") == samples
    assert ("held for" in caplog.text) == (samples > 1)


@pytest.mark.parametrize(
    "inputs", [9.81 + 0.1 * U, U, (U > 0).astype(float), np.repeat(U[::2], 2, axis=0), U * [1e-3, 1e3]]
)
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
    "uneven time": {"states": X, "inputs": U, "time": 0.1 * np.arange(301) + 0.02 * np.sin(np.arange(301))},
    "long double": {"states": X.astype(np.longdouble), "inputs": U},
    "big endian": {"states": X.astype(">f8"), "inputs": U.astype(">f4")},
    "Fortran": {"states": np.asfortranarray(X), "inputs": np.asfortranarray(U)},
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
    "objects": (
        {"states": np.array([X, X[:5]], dtype=object), "inputs": U},
        "array states cannot be read .it holds Python objects",
    ),
    "nan": ({"states": at(X, (7, 0), np.nan), "inputs": U}, "not finite, first in row 7"),
    "rows": ({"states": X[:-5], "inputs": U}, "has 296 states and 300 inputs; expected one state more, or as many"),
    "time": (
        {"states": X, "inputs": U, "time": 0.02 * np.arange(301)},
        r"its time step is 0\.02 s, the system's 0\.1 s",
    ),
    "dt": ({"states": X, "inputs": U, "dt": np.array(0.2)}, r"its time step is 0\.2 s"),
    "dt nan": ({"states": X, "inputs": U, "dt": np.array(np.nan)}, "array dt holds a value that is not finite"),
    "time nan": ({"states": X, "inputs": U, "time": at(0.1 * np.arange(301), 5, np.nan)}, "time holds .* not finite"),
    "time text": (
        {"states": X, "inputs": U, "time": np.arange(301).astype("U4")},
        "time holds <U4; expected real",
    ),
    "time short": (
        {"states": X, "inputs": U, "time": 0.1 * np.arange(99)},
        r"shape \(99,\); expected \(301,\)",
    ),
    "no time": (
        {"states": X, "inputs": U, "time": np.full(301, np.datetime64("NaT", "s"))},
        "time holds a value that is not finite",
    ),
    "ends": ({"states": X, "inputs": U, "episode_ends": np.array([50, 20])}, "expected rising numbers of rows"),
    "text": ({"states": np.array([["a"]]), "inputs": U}, "expected real numbers"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_is_refused_with_the_remedy(name, tmp_path):
    arrays, told = REFUSED[name]
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(DataError, match=rf"^{tmp_path}/a\.npz: .*{told}"):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


JUMPING = {
    "starts anew": np.concatenate([0.1 * np.arange(40)] * 7 + [0.1 * np.arange(41)]),
    "a gap": 0.1 * np.arange(321) + np.repeat(np.arange(9), 40)[:321] * 3.0,
}


@pytest.mark.parametrize("name", JUMPING)
def test_time_stamps_that_jump_cut_a_file_into_episodes(name, tmp_path, caplog):
    states, inputs, _ = HARMED["glued"]
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs, time=JUMPING[name])
    assert NpzRecordings(str(tmp_path)).record(SYSTEM).notes["recording_residual"] == pytest.approx(1, abs=0.1)
    assert "its time stamps jump before row 40, 80" in caplog.text


def written_as(kind: str, folder: Path, runs) -> dict | None:
    """Runs in the files of others; returns how the columns are called, where that has to be said."""
    folder.mkdir()
    if kind == "minari":
        with h5py.File(folder / "main_data.hdf5", "w") as file:
            for k, (x, u) in enumerate(runs):
                file[f"episode_{k}/observations"], file[f"episode_{k}/actions"] = x, u
        return None
    if kind == "d4rl":
        ends = np.cumsum([len(x) for x, _ in runs])
        with h5py.File(folder / "maze.hdf5", "w") as file:
            file["observations"] = np.concatenate([x for x, _ in runs])
            file["actions"] = np.concatenate([np.vstack([u, u[-1:]]) for _, u in runs])
            file["terminals"] = np.zeros(ends[-1], bool)
            file["timeouts"] = np.isin(np.arange(ends[-1]), ends - 1)
        return None
    tables = [pd.DataFrame({"observation.state": list(x[:-1]), "action": list(u), "episode_index": k,
                            "timestamp": 0.1 * np.arange(len(u))}) for k, (x, u) in enumerate(runs)]  # fmt: skip
    if kind == "lerobot":
        (folder / "data" / "chunk-000").mkdir(parents=True)
        (folder / "meta").mkdir()
        pd.DataFrame({"task": ["go"]}).to_parquet(folder / "meta" / "tasks.parquet")
        for k, table in enumerate(tables):
            table.to_parquet(folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
        return None
    names = [*COLUMNS["states"], *COLUMNS["inputs"]]
    times = [pd.date_range("2026-01-01", periods=len(u), freq="100ms") for _, u in runs]
    wide = [pd.DataFrame(np.hstack([x[:-1], u]), columns=names).assign(run=k, t=times[k])
            for k, (x, u) in enumerate(runs)]  # fmt: skip
    options = {"sep": ";", "decimal": ","} if kind == "semicolons" else {}
    pd.concat(wide).to_csv(folder / "all.csv", index=False, encoding="utf-8-sig", **options)
    return COLUMNS | {"episode": "run", "time": "t"}


@pytest.mark.parametrize("kind", ["minari", "d4rl", "lerobot", "csv", "semicolons"])
def test_episodes_are_read_as_others_write_them(kind, tmp_path):
    runs = [run(40 + 7 * k, k, 1.0 * k) for k in range(4)]
    columns = written_as(kind, tmp_path / "data", runs)
    recording = NpzRecordings(str(tmp_path / "data"), columns).record(SYSTEM)
    assert recording.notes["recording_residual"] == pytest.approx(1, abs=0.15)
    for (x, u), (states, inputs) in zip(runs, recording.runs, strict=True):
        np.testing.assert_allclose(states, x[: len(states)], rtol=1e-6)
        np.testing.assert_allclose(inputs, u[: len(inputs)], rtol=1e-6)
        assert len(inputs) >= len(u) - 1


@pytest.mark.parametrize(("write", "told"), [
    (lambda f: f.create_group("observations").create_dataset("state", data=X), "observations is a group of state;"),
    (lambda f: f.__setitem__("observations", h5py.ExternalLink("/etc/passwd", "/")), "lies in another file"),
    (lambda f: f.create_dataset("observations", (10**9, 10**4), dtype="f8"), "observations holds .* of memory"),
    (lambda f: f.__setitem__("observations", h5py.Empty("f8")), "observations is empty"),
    (lambda f: f.__setitem__("episode_0", h5py.ExternalLink("/etc/passwd", "/")), "episode_0 lies in another file"),
    (lambda f: None, "has no array states or observations; found"),
])  # fmt: skip
def test_hdf5_that_cannot_be_taken_is_refused(write, told, tmp_path):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        write(file)
        file["actions"] = U
    with pytest.raises(DataError, match=told):
        NpzRecordings(str(tmp_path)).record(SYSTEM)
    (tmp_path / "a.hdf5").write_bytes(b"not hdf5 at all")
    with pytest.raises(DataError, match=r"a\.hdf5: cannot be read as HDF5"):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


@pytest.mark.parametrize(("content", "told"), [
    ("x,y,vx,vy,ax,ay\nm,m,m/s,m/s,m/s2,m/s2\n0,0,0,0,1,1\n", "column 'x' holds 'm' in row 0; expected numbers"),
    ("x,y,vx,vy,ax,ay\n0,0,0,0,1,1\n1,,0,0,1,1\n0,0,0,0,1,1\n", "states holds .* not finite, first in row 1"),
    ("0,0,0,0,1,1\n0,0,0,0,1,1\n", "has no column 'x'; found 0"),
    ("x,y,vx,vy,ax,ay\n", "has 0 states and 0 inputs|cannot be read|not finite|at least two states"),
    ("", "cannot be read as a table"),
    ("x,y\n1,2,3\n1\n\"", "cannot be read as a table|has no column"),
])  # fmt: skip
def test_tables_that_cannot_be_taken_are_refused_with_the_remedy(content, told, tmp_path):
    (tmp_path / "a.csv").write_text(content)
    with pytest.raises(DataError, match=rf"a\.csv: .*({told})"):
        NpzRecordings(str(tmp_path), COLUMNS).record(SYSTEM)


ODD_TABLES = {
    "lists of lists": ({"x": [[[1.0]]] * 9}, COLUMNS, "'x' holds lists of something else than numbers"),
    "lists of two lengths": ({"x": [[1.0]] * 8 + [[1.0, 2.0]]}, COLUMNS, "'x' holds lists of different lengths"),
    "lists of text": ({"x": [["a"]] * 9}, COLUMNS, "'x' holds lists of something else than numbers"),
    "a list missing": ({"x": [[1.0]] * 8 + [None]}, COLUMNS, "'x' holds lists of"),
    "no states": ({}, COLUMNS | {"states": []}, r"columns\.states names 0 columns; expected at least one"),
    "two times": ({}, COLUMNS | {"time": ["x", "y"]}, r"columns\.time names 2 columns; expected one"),
    "no episode": ({"run": [1.0] * 8 + [np.nan]}, COLUMNS | {"episode": "run"}, "row 8 belongs to no episode"),
}


@pytest.mark.parametrize("name", ODD_TABLES)
def test_odd_tables_are_refused_with_column_and_reason(name, tmp_path):
    changed, columns, told = ODD_TABLES[name]
    pd.DataFrame(np.hstack([X[:9], U[:9]]), columns=[*"xyzw", "ax", "ay"]).rename(
        columns={"z": "vx", "w": "vy"}
    ).assign(**changed).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(DataError, match=rf"a\.parquet: .*{told}"):
        NpzRecordings(str(tmp_path), columns).record(SYSTEM)


def test_two_columns_of_one_name_and_names_on_several_levels_are_refused():
    table = pd.DataFrame(np.hstack([X[:9], U[:9]]), columns=["x", "x", "vx", "vy", "ax", "ay"])
    with pytest.raises(DataError, match="has several columns 'x'"):
        recording_of([table], {"states": ["x"], "inputs": ["ax"]}, SYSTEM)
    table.columns = pd.MultiIndex.from_product([["a"], [*"xyzwuv"]])
    with pytest.raises(DataError, match="has no column 'x'"):
        recording_of([table], {"states": ["x"], "inputs": ["u"]}, SYSTEM)


def test_episodes_in_one_file_are_cut_where_they_end(tmp_path):
    states, inputs, _ = HARMED["glued"]
    np.savez(tmp_path / "a.npz", states=states, inputs=inputs, episode_ends=40 * np.arange(1, 9))
    recording = NpzRecordings(str(tmp_path)).record(SYSTEM)
    assert recording.notes["recording_residual"] == pytest.approx(1, abs=0.1)
    assert sorted(np.isfinite(recording.inputs[..., 0]).sum(-1)) == [39] * 7 + [40]


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
    assert data.test(LQR(), SYSTEM).notes == {"also_in_train": 3, "residual": pytest.approx(1, abs=0.1)}
    assert "3 of 5 test trajectories are also in train" in caplog.text
    with pytest.raises(DataError, match=r"train: the data do not obey .* another sampling rate"):
        data.train(LQR(), double_integrator(time_step=0.2))

"""Laws of data sets: generated ones repeat, files are read and never executed, complaints name the place."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from laws import composed, presets

from dadiff.behaviours import Hankel, Known, Transitions, compared
from dadiff.config.build import build
from dadiff.datasets import Generated, NpzRecordings, NpzTrajectories
from dadiff.datasets.cached import load_data, save_data
from dadiff.datasets.logs import read_runs
from dadiff.errors import ConfigError, DataError, NotApplicableError
from dadiff.systems import GaussianExcitation, Linear, double_integrator
from dadiff.tasks import LQR, Demonstrations
from dadiff.trajectory import Channel, Layout
from dadiff.trajectory.hankel import trajectory_matrix

SYSTEM, TASK = double_integrator(), LQR(horizon=6)


def write(folder: Path, name: str, **changes) -> Path:
    """One trajectory as stored by someone else; a change of None leaves the array out."""
    rng = np.random.default_rng(len(name))
    made = TASK.demonstrations(SYSTEM, 1, rng)
    states, inputs = SYSTEM.layout(TASK.horizon).split(made.trajectories[0])
    E = LQR().condition(SYSTEM).unpack(made.environment[0])
    arrays = {"states": states, "inputs": inputs, "initial_state": E["x_init"], "target_state": E["target"], **changes}
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / name, **{key: value for key, value in arrays.items() if value is not None})
    return folder / name


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder with three trajectories to train on and two to test on."""
    for name in ("a.npz", "bb.npz", "ccc.npz"):
        write(tmp_path / "train", name)
    for name in ("dddd.npz", "eeeee.npz"):
        write(tmp_path / "test", name)
    return tmp_path


# --- generated


def test_sizes_are_as_asked_and_the_same_seed_gives_the_same_data():
    one, two, other = (Generated(50, 7, seed=seed) for seed in (1, 1, 2))
    train, test = one.train(TASK, SYSTEM), one.test(TASK, SYSTEM)
    assert train.trajectories.shape == (50, SYSTEM.layout(6).size)
    assert test.reference.shape == (7, SYSTEM.layout(6).size)
    assert np.array_equal(train.trajectories, two.train(TASK, SYSTEM).trajectories)
    assert np.array_equal(test.reference, two.test(TASK, SYSTEM).reference)
    assert not np.array_equal(test.reference, other.test(TASK, SYSTEM).reference)


@pytest.mark.parametrize("name", presets("task"))
def test_test_cases_from_stretched_ranges_start_and_end_farther_out(name):
    config = composed(f"task={name}")
    few = {"robots": 2, "interpolation": 1, "extrapolation": 1}
    task = build({k: few.get(k, value) for k, value in config["task"].items()}, "task")
    system = task.target(build(config["system"], "system"))
    near, far = (Generated(2, 20, test_ranges=factor).test(task, system) for factor in (1.0, 2.0))
    for field in ("x_init", "target"):
        within = [np.abs(cases.get(field)).max() for cases in (near, far)]
        assert 1.3 * within[0] < within[1] < 3 * within[0]


def test_a_range_with_ends_is_stretched_about_its_middle():
    task = LQR(init_range=[1.0, [2.0, 4.0], 0.0, 0.0]).stretched(2.0)
    assert task.init_range == [2.0, [1.0, 5.0], 0.0, 0.0]
    assert task.target_range == 8.0


def test_stretching_the_test_cases_leaves_the_demonstrations():
    assert len({str(Generated(9, test_ranges=factor).determined_by("train")) for factor in (1.0, 2.0)}) == 1
    assert len({str(Generated(9, test_ranges=factor).determined_by("test")) for factor in (1.0, 2.0)}) == 2


def test_a_task_without_ranges_says_that_it_cannot_be_stretched():
    with pytest.raises(NotApplicableError, match="test_ranges is 2, but object has no"):
        Generated(2, 2, test_ranges=2.0).test(object(), SYSTEM)


def test_the_test_cases_do_not_move_with_the_training_size():
    small, large = (Generated(size, 5).test(TASK, SYSTEM).environment for size in (10, 1000))
    assert np.array_equal(small, large)


def test_no_test_case_is_a_training_environment():
    data = Generated(100, 100)
    train, test = data.train(TASK, SYSTEM).environment, data.test(TASK, SYSTEM).environment
    assert not (train[:, None] == test[None]).all(-1).any()


@pytest.mark.parametrize("sizes", [(0, 10), (10, 0), (-1, 10)])
def test_sizes_out_of_range_are_refused_in_one_line(sizes):
    with pytest.raises(ConfigError, match=r"^dataset: [^\n]*$"):
        Generated(*sizes)


def test_what_is_cached_is_what_was_made(tmp_path):
    train = replace(Generated(20, 5).train(TASK, SYSTEM), notes={"share": 0.5})
    save_data(tmp_path, lambda: train)
    again = Demonstrations(**load_data(tmp_path))
    assert np.array_equal(again.trajectories, train.trajectories)
    assert np.array_equal(again.environment, train.environment)
    assert again.notes == {"share": 0.5}


# --- trajectories from files


def test_files_become_demonstrations_and_cases_with_their_own_references(folder):
    data = NpzTrajectories(str(folder))
    train, test = data.train(TASK, SYSTEM), data.test(TASK, SYSTEM)
    assert train.trajectories.shape == (3, SYSTEM.layout(6).size)
    with np.load(folder / "test" / "dddd.npz") as stored:
        states, inputs = SYSTEM.layout(6).split(test.reference[0])
        assert np.array_equal(states, stored["states"])
        assert np.array_equal(inputs, stored["inputs"])
        assert np.array_equal(test.x_init[0], stored["initial_state"])
        assert np.array_equal(test.get("target")[0], stored["target_state"])


def test_controls_is_another_name_for_inputs_and_other_arrays_are_ignored(folder):
    plain = NpzTrajectories(str(folder)).train(TASK, SYSTEM).trajectories
    with np.load(folder / "train" / "a.npz") as stored:
        arrays = dict(stored)
    arrays["controls"] = arrays.pop("inputs")
    np.savez(folder / "train" / "a.npz", **arrays, cost=np.array([{"any": "thing"}], dtype=object))
    assert np.array_equal(NpzTrajectories(str(folder)).train(TASK, SYSTEM).trajectories, plain)


def test_sizes_take_the_first_files_by_name(folder):
    data = NpzTrajectories(str(folder), train_size=2, test_size=1)
    assert len(data.train(TASK, SYSTEM).trajectories) == 2
    assert len(data.test(TASK, SYSTEM).reference) == 1


def test_the_fingerprint_follows_the_content_and_not_the_place(folder, tmp_path_factory):
    copy = tmp_path_factory.mktemp("copy")
    for file in folder.rglob("*.npz"):
        (copy / file.relative_to(folder)).parent.mkdir(exist_ok=True)
        (copy / file.relative_to(folder)).write_bytes(file.read_bytes())
    data, moved = NpzTrajectories(str(folder)), NpzTrajectories(str(copy))
    for part in ("train", "test"):
        assert moved.determined_by(part) == data.determined_by(part)
    write(copy / "train", "a.npz", states=np.zeros((7, 4)))
    assert moved.determined_by("train") != data.determined_by("train")
    assert moved.determined_by("test") == data.determined_by("test")


class Bomb:
    """Leaves a trace where it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


BAD = {
    "missing": ({"states": None}, "has no array states or observations; found inputs, initial_state, target_state"),
    "no inputs": ({"inputs": None}, "has no array inputs or controls; found"),
    "nan": ({"states": np.full((7, 4), np.nan)}, "array states holds a value that is not finite"),
    "infinite": ({"target_state": np.full(4, np.inf)}, "array target_state holds a value that is not finite"),
    "horizon": ({"states": np.zeros((9, 4))}, "has 9 states and 6 inputs; expected one state more"),
    "state_dim": ({"states": np.zeros((7, 3))}, r"array states has shape (7, 3); expected (any, 4)"),
    "input_dim": ({"inputs": np.zeros((6, 1))}, r"array inputs has shape (6, 1); expected (any, 2)"),
    "dimensions": ({"initial_state": np.zeros((1, 4))}, r"array initial_state has shape (1, 4); expected (4)"),
    "start": ({"initial_state": np.ones(4)}, "initial_state is [1.0, 1.0, 1.0, 1.0], but states begin at ["),
    "text": ({"states": np.array([["a"] * 4] * 7)}, "array states holds <U1; expected real numbers"),
    "complex": ({"states": np.zeros((7, 4), complex)}, "array states holds complex128; expected real numbers"),
    "times": ({"states": np.zeros((7, 4), "datetime64[s]")}, "array states holds datetime64[s]; expected real numbers"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD.keys())
def test_a_bad_array_is_named_with_its_file(folder, changes, message):
    file = write(folder / "train", "bb.npz", **changes)
    with pytest.raises(DataError, match="^" + re.escape(f"{file}: {message}")):
        NpzTrajectories(str(folder)).train(TASK, SYSTEM)


def test_pickled_objects_are_refused_and_never_loaded(folder, tmp_path):
    trace = tmp_path / "executed"
    file = write(folder / "train", "bb.npz", states=np.array([Bomb(trace)], dtype=object))
    with pytest.raises(DataError, match=re.escape(f"{file}: array states cannot be read (it holds Python objects")):
        NpzTrajectories(str(folder)).train(TASK, SYSTEM)
    assert not trace.exists()


def damaged(content: bytes) -> dict[str, bytes]:
    return {
        "empty": b"",
        "text": b"not an archive",
        "cut": content[:-40],
        "overwritten": content[:150] + bytes(200) + content[350:],
        "header": content.replace(b"{'descr'", b"{'desrc'", 1),
    }


@pytest.mark.parametrize("kind", damaged(b""))
def test_a_damaged_file_is_named(folder, kind):
    file = folder / "train" / "bb.npz"
    with np.load(file) as stored:
        arrays = dict(stored)
    np.savez_compressed(file, **arrays) if kind == "overwritten" else None
    file.write_bytes(damaged(file.read_bytes())[kind])
    with pytest.raises(
        DataError,
        match=f"^{re.escape(str(file))}: (is not a readable|an array cannot|array states cannot|has no)",
    ):
        NpzTrajectories(str(folder)).train(TASK, SYSTEM)


def test_every_truncation_of_a_file_is_refused(folder):
    file = folder / "train" / "a.npz"
    whole = file.read_bytes()
    for length in range(0, len(whole), 61):
        file.write_bytes(whole[:length])
        with pytest.raises(DataError, match=re.escape(str(file))):
            read_runs(file, SYSTEM, None)


def test_an_array_that_is_not_in_an_archive_is_refused(tmp_path):
    with (tmp_path / "a.npz").open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(DataError, match=r"a\.npz: is not a readable \.npz file; write it with numpy\.savez"):
        read_runs(tmp_path / "a.npz", SYSTEM, None)


@pytest.mark.parametrize("part", ["train", "test"])
def test_empty_and_missing_folders_are_named(folder, part):
    data = NpzTrajectories(str(folder))
    for file in (folder / part).iterdir():
        file.unlink()
    with pytest.raises(DataError, match=rf"{part}: holds no file that ends in \.npz, \.csv"):
        data.determined_by(part)
    (folder / part).rmdir()
    with pytest.raises(DataError, match=f"{part}: there is no such folder"):
        data.determined_by(part)


def test_a_task_with_another_condition_needs_another_data_set(folder):
    class Elsewhere(LQR):
        def condition(self, system):
            return Layout((Channel("x_init", 4), Channel("goal", 26)))

    with pytest.raises(ConfigError, match=r"E = \[x_init \(4\); target \(4\)\], .* has x_init \(4\), goal \(26\)"):
        NpzTrajectories(str(folder)).train(Elsewhere(horizon=6), SYSTEM)


# --- recordings from files


def record(folder: Path, name: str, system: Linear = SYSTEM, length: int = 60, seed: int = 0, **changes) -> Path:
    made = GaussianExcitation(length, process_noise=0.0, seed=seed).record(system)
    folder.mkdir(exist_ok=True)
    np.savez(folder / name, **{"states": made.states[0], "controls": made.inputs[0], **changes})
    return folder / name


def test_own_recordings_teach_the_dynamics(tmp_path, system):
    for seed in range(3):
        record(tmp_path, f"{seed}.npz", system, seed=seed)
    recording = NpzRecordings(str(tmp_path)).record(system)
    assert (recording.count, recording.length) == (3, 60)
    layout = system.layout(6)
    learned, known = Hankel().fit(layout, recording=recording), Known().fit(layout, system)
    assert compared(learned, known)["principal_angle"] < 1e-10


def test_all_samples_of_recordings_of_different_lengths_are_used(tmp_path):
    record(tmp_path, "a.npz", length=130)
    record(tmp_path, "b.npz", length=50)
    recording = NpzRecordings(str(tmp_path)).record(SYSTEM)
    assert (recording.count, recording.length) == (2, 130)
    assert len(Transitions.of(recording.states, recording.inputs).x) == 130 + 50
    layout = SYSTEM.layout(10)
    H = trajectory_matrix(recording.states, recording.inputs, layout)
    each = [trajectory_matrix(recording.states[[k], : S + 1], recording.inputs[[k], :S], layout)
            for k, S in enumerate((130, 50))]  # fmt: skip
    assert np.array_equal(H, np.concatenate(each, axis=-1))


def test_recordings_of_another_system_are_named(tmp_path):
    file = record(tmp_path, "a.npz", double_integrator(axes=1))
    with pytest.raises(DataError, match=re.escape(f"{file}: array states has shape (61, 2); expected (any, 4)")):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


def test_a_recording_needs_one_state_more_than_inputs(tmp_path):
    file = record(tmp_path, "a.npz", states=np.zeros((59, 4)))
    with pytest.raises(DataError, match=re.escape(f"{file}: has 59 states and 60 inputs; expected one state more")):
        NpzRecordings(str(tmp_path)).record(SYSTEM)


def test_a_fleet_has_a_folder_a_robot(tmp_path):
    robots = Linear(np.stack([SYSTEM.A] * 2), np.stack([SYSTEM.B] * 2), robots=2)
    record(tmp_path / "robot_0", "a.npz")
    with pytest.raises(DataError, match="no recordings for robot_1; expected one folder for each of 2 robots"):
        NpzRecordings(str(tmp_path)).record(robots)
    record(tmp_path / "robot_1", "a.npz", length=50)
    with pytest.raises(DataError, match="robot_1: holds 1 recordings with S = 50, robot_0 1 with 60"):
        NpzRecordings(str(tmp_path)).record(robots)
    record(tmp_path / "robot_1", "a.npz", seed=1)
    assert NpzRecordings(str(tmp_path)).record(robots).inputs.shape == (2, 1, 60, 2)
    before = NpzRecordings(str(tmp_path)).fingerprint()
    record(tmp_path / "robot_1", "a.npz", seed=2)
    assert NpzRecordings(str(tmp_path)).fingerprint() != before


def test_a_missing_folder_of_recordings_is_named(tmp_path):
    with pytest.raises(DataError, match="nowhere: there is no such folder"):
        NpzRecordings(str(tmp_path / "nowhere")).fingerprint()

"""Environments of one's own: read from yaml and npz, and refused in one line where they are unusable."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from dadiff.datasets.environments import load_environments
from dadiff.errors import DadiffError, DataError, InfeasibleError
from dadiff.systems import double_integrator
from dadiff.tasks.environments import check, decode
from dadiff.tasks.obstacles import Obstacles

GOOD: dict[str, Any] = {
    "x_init": [0, 0, 0.5, 0],
    "target": [3, 1],
    "waypoints": [{"position": [0.5, 0.2], "time": 7}, {"position": [2.5, 1.2], "time": 30}],
    "obstacles": [{"centre": [1.5, 0.7], "radius": 0.4}],
}
BARE: dict[str, Any] = {"x_init": [0, 0, 0, 0], "target": [1, 1]}


def write(folder: Path, environments: Any) -> Path:
    path = folder / "environments.yaml"
    path.write_text(yaml.safe_dump(environments))
    return path


def test_yaml_environments_are_read_and_solved(tmp_path: Path) -> None:
    task = Obstacles()
    E = load_environments(write(tmp_path, [GOOD, BARE]), task)
    e = decode(E, task.condition(), task.horizon)
    np.testing.assert_array_equal(e.time, [[7, 30], [0, 0]])
    np.testing.assert_array_equal(e.present, [[True, False, False, False], [False] * 4])
    cases = task.solve(double_integrator(process_noise=0.0), E)
    assert cases.reference.shape == (2, 244)
    assert cases.notes["unsolved"] == 0


def test_npz_holds_the_same(tmp_path: Path) -> None:
    empty = [np.nan] * 3
    np.savez(
        tmp_path / "environments.npz",
        x_init=[GOOD["x_init"], BARE["x_init"]],
        target=[GOOD["target"], BARE["target"]],
        waypoints=[[[0.5, 0.2, 7], [2.5, 1.2, 30]], [empty, empty]],
        obstacles=[[[1.5, 0.7, 0.4]], [empty]],
    )
    task = Obstacles()
    np.testing.assert_array_equal(
        load_environments(tmp_path / "environments.npz", task),
        load_environments(write(tmp_path, [GOOD, BARE]), task),
    )


def changed(**fields: Any) -> dict[str, Any]:
    return copy.deepcopy(GOOD) | fields


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in GOOD.items() if key != name}


def waypoint(position: list, time: Any) -> dict[str, Any]:
    return {"position": position, "time": time}


BAD = [
    (without("x_init"), DataError, "environment 1: 'x_init' is missing"),
    (without("target"), DataError, "environment 1: 'target' is missing"),
    (changed(goal=[1, 1]), DataError, "environment 1: 'goal' is not known"),
    (changed(obstacles=[{"centre": [1, 1]}]), DataError, r"environment 1: obstacles\[0\]: 'radius' is missing"),
    (changed(obstacles={"centre": [1, 1]}), DataError, "environment 1: obstacles is dict; expected a list"),
    (changed(x_init=[0, 0, 1]), DataError, "environment 1: x_init has shape"),
    (changed(target=["a", 1]), DataError, "environment 1: target is"),
    (changed(target=[float("nan"), 1]), DataError, r"environment 1: target is \(nan, 1\); every number must be finite"),
    (changed(obstacles=[{"centre": [1.5, 0.7], "radius": -1}]), DataError, r"obstacles\[0\].radius is -1"),
    (changed(obstacles=GOOD["obstacles"] * 5), DataError, "obstacles are 5; task.max_obstacles is 4"),
    (changed(waypoints=GOOD["waypoints"] * 2), DataError, "waypoints are 4; task.max_waypoints is 2"),
    (
        changed(waypoints=[waypoint([0, 1], 0)]),
        DataError,
        r"waypoints\[0\].time is 0; expected a whole number in 1..40",
    ),
    (changed(waypoints=[waypoint([0, 1], 41)]), DataError, r"waypoints\[0\].time is 41"),
    (changed(waypoints=[waypoint([0, 1], 4.5)]), DataError, r"waypoints\[0\].time is 4.5"),
    (changed(waypoints=[waypoint([0, 1], 7)] * 2), DataError, r"waypoints\[1\].time is 7, the time of waypoints\[0\]"),
    (changed(waypoints=[waypoint([0, 1], 40)]), DataError, r"waypoints\[0\].time is 40, the time of the target"),
    (changed(x_init=[1.5, 0.6, 0, 0]), InfeasibleError, r"x_init \(1.5, 0.6\) lies inside obstacles\[0\]"),
    (changed(x_init=[1.0, 0.7, 2, 0]), InfeasibleError, r"x_init \(after one step\) \(1.2, 0.7\) lies inside"),
    (changed(target=[1.5, 0.5]), InfeasibleError, r"target \(1.5, 0.5\) lies inside obstacles\[0\]"),
    (
        changed(waypoints=[waypoint([1.6, 0.7], 9)]),
        InfeasibleError,
        r"waypoints\[0\].position \(1.6, 0.7\) lies inside",
    ),
    ([1, 2], DataError, "environment 1: expected a mapping"),
]


def test_a_waypoint_may_be_due_at_the_first_step_and_at_the_last_but_one(tmp_path: Path) -> None:
    at_ends = changed(waypoints=[waypoint([0.1, 0.1], 1), waypoint([2.5, 1.2], 39)])
    task = Obstacles()
    E = load_environments(write(tmp_path, [at_ends]), task)
    np.testing.assert_array_equal(decode(E, task.condition(), task.horizon).time, [[1, 39]])


@pytest.mark.parametrize(("environment", "error", "message"), BAD, ids=[message for *_, message in BAD])
def test_bad_environments_are_named_in_one_line(
    tmp_path: Path, environment: Any, error: type[DadiffError], message: str
) -> None:
    path = write(tmp_path, [GOOD, environment])
    with pytest.raises(error, match=message) as caught:
        load_environments(path, Obstacles())
    assert str(caught.value).startswith(f"{path}: environment 1: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.yaml", None, "no such file"),
        ("environments.csv", b"1,2", "ends in .yaml or .npz"),
        ("broken.yaml", b"- {x_init: [", "not readable as yaml"),
        ("mapping.yaml", b"x_init: 1", "expected a list of environments; found dict"),
        ("empty.yaml", b"[]", "holds no environment"),
        ("broken.npz", b"PK", "is not a readable .npz file"),
        ("array.npz", b"\x93NUMPY", "is not a readable .npz file"),
    ],
)
def test_unusable_files_are_named_in_one_line(tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        load_environments(tmp_path / name, Obstacles())
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_npz_with_missing_or_misshapen_arrays_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "environments.npz"
    np.savez(path, x_init=np.zeros((2, 4)))
    with pytest.raises(DataError, match="'target' is missing"):
        load_environments(path, Obstacles())
    np.savez(path, x_init=np.zeros((2, 4)), target=np.zeros((3, 2)))
    with pytest.raises(DataError, match="different numbers of environments"):
        load_environments(path, Obstacles())
    np.savez(path, x_init=0.0, target=np.zeros((1, 2)))
    with pytest.raises(DataError, match="x_init is a single number"):
        load_environments(path, Obstacles())
    np.savez(path, x_init=np.zeros((2, 4)), target=np.ones((2, 2)), obstacles=np.zeros((2, 3)))
    with pytest.raises(DataError, match=r"obstacles has shape \(2, 3\)"):
        load_environments(path, Obstacles())


def test_drawn_environments_pass_the_check() -> None:
    task = Obstacles(distribution="hard")
    e, _ = task.distribution_for(0.1).sample(20, np.random.default_rng(0))
    check(e, task.horizon, 0.1)

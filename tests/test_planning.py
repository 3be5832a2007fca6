"""Planners: the plan of a file is the plan of the run, bit for bit; what is foreign executes nothing."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import save as arrays_to_bytes

import dadiff
from dadiff.behaviours import HankelLowRank, IdentifiedSoft, Inpainting, Known, TrajectorySet
from dadiff.denoisers import MLP, EncoderDecoder, Gaussian
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.conditional import Conditional
from dadiff.diffusion.enforcement import CleanEstimate
from dadiff.diffusion.estimate import Estimate
from dadiff.diffusion.measured import Measured
from dadiff.diffusion.samplers import DDIM
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import CheckpointError, DadiffError, DataError, ShapeError
from dadiff.planning import Planner, Plans
from dadiff.planning.cli import main
from dadiff.randomness import torch_generator
from dadiff.systems import GaussianExcitation, Linear, double_integrator
from dadiff.systems.system import Bounds
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

SYSTEM, TASK, SCHEDULE = double_integrator(), LQR(), paper_linear()
LAYOUT = SYSTEM.layout(TASK.horizon)


def planner(network: bool | Recipe = False, initial_state: str = "fixed", system: Linear = SYSTEM) -> Planner:
    if network:
        recipe = MLP(width=16, blocks=1) if network is True else network
        denoiser = recipe.build(LAYOUT, TASK.condition(system), SCHEDULE, torch_generator(0, "initialisation"))
    else:
        denoiser = Gaussian().exact(TASK.law(system), physical(LAYOUT), SCHEDULE)
    behaviour = Known(initial_state).fit(LAYOUT, system=system)
    return Planner(
        TASK,
        system,
        SCHEDULE,
        DDIM(10),
        denoiser,
        physical(LAYOUT),
        behaviour,
        CleanEstimate(),
        initial_state == "fixed",
    )


def plan_of(one: Planner, **options: object) -> Plans:
    return one.plan(x_init=[0, 0, 0.5, 0], target=[1, 2, 0, 0], samples=3, seed=1, **options)


def test_a_plan_obeys_the_dynamics_and_starts_where_the_robot_is():
    plans = plan_of(planner())
    assert plans.states.shape == (3, 31, 4)
    assert plans.inputs.shape == (3, 30, 2)
    x = SYSTEM.simulate(np.array([0, 0, 0.5, 0.0]), plans.inputs)
    np.testing.assert_allclose(plans.states, x, atol=1e-12)


@pytest.mark.parametrize("network", [False, True, EncoderDecoder(channels=8, latent_dim=4)])
def test_a_planner_from_a_file_plans_bit_for_bit_alike(tmp_path, network):
    before = planner(network)
    after = Planner.load(before.save(tmp_path / "robot.zip"))
    np.testing.assert_array_equal(plan_of(after).tau, plan_of(before).tau)
    assert after.layout == before.layout


def test_the_same_seed_gives_the_same_plans_and_another_others():
    one = planner(network=True)
    np.testing.assert_array_equal(plan_of(one).tau, plan_of(one).tau)
    other = one.plan(x_init=[0, 0, 0.5, 0], target=[1, 2, 0, 0], samples=3, seed=2)
    assert np.abs(plan_of(one).tau - other.tau).max() > 1e-3


def test_many_conditions_at_once_are_planned_as_one_by_one():
    one = planner()
    E = TASK.sample_environments(SYSTEM, (5,), np.random.default_rng(0))
    together = one.plan(E, samples=2)
    assert together.tau.shape == (5, 2, LAYOUT.size)
    starts = np.repeat(one.condition.get(E, "x_init")[:, None], 2, axis=1)
    np.testing.assert_allclose(together.states[:, :, 0], starts, atol=1e-12)


def test_another_robot_is_served_by_the_same_network(tmp_path):
    heavy = Linear(SYSTEM.A, 0.5 * SYSTEM.B, time_step=0.1)
    loaded = Planner.load(planner(network=True).save(tmp_path / "robot.zip"))
    plans = plan_of(loaded.of(heavy, Known("fixed")))
    np.testing.assert_allclose(heavy.simulate(plans.states[:, 0], plans.inputs), plans.states, atol=1e-12)


BAD_FIELDS = [
    ({"x_init": [0] * 4}, "'target' is missing; expected x_init, target"),
    ({"x_init": [0] * 4, "target": [0] * 4, "speed": 1}, "'speed' is not known; expected x_init, target"),
    ({"x_init": [0] * 3, "target": [0] * 4}, r"x_init has shape \(3,\); expected 4 numbers"),
    ({"x_init": [0, 0, 0, float("nan")], "target": [0] * 4}, "every number must be finite"),
    ({"x_init": "here", "target": [0] * 4}, "x_init is 'here'; expected 4 numbers"),
]


@pytest.mark.parametrize(("fields", "message"), BAD_FIELDS, ids=[message for _, message in BAD_FIELDS])
def test_fields_of_the_condition_are_checked(fields, message):
    with pytest.raises(DataError, match=message) as caught:
        planner().plan(**fields)
    assert "\n" not in str(caught.value)


def test_a_condition_of_another_size_is_refused():
    with pytest.raises(ShapeError, match=r"its last dimension must be 8: x_init, target"):
        planner().plan(np.zeros(7))


def rewritten(path: Path, change) -> Path:
    """The file with its description changed."""
    with zipfile.ZipFile(path) as file:
        description, arrays = json.loads(file.read("planner.json")), file.read("arrays.safetensors")
    change(description)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("planner.json", json.dumps(description))
        file.writestr("arrays.safetensors", arrays)
    return path


def foreign_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps(_Trap(path.parent / "executed")))


class _Trap:
    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self):
        return Path.touch, (self.place,)


def empty_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("other.txt", "")


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("planner.json", b" " * 10_000_000)
        file.writestr("arrays.safetensors", b"")


def truncated(path: Path) -> None:
    planner().save(path)
    path.write_bytes(path.read_bytes()[:-200])


def without_arrays(path: Path) -> None:
    planner().save(path)
    with zipfile.ZipFile(path) as file:
        description = file.read("planner.json")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("planner.json", description)
        file.writestr("arrays.safetensors", arrays_to_bytes({}))


def described_as(path: Path, description: object) -> None:
    """A file whose description is another."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("planner.json", description if isinstance(description, str) else json.dumps(description))
        file.writestr("arrays.safetensors", arrays_to_bytes({}))


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


def _shorter_condition(description: dict) -> None:
    channels = description["planner"]["denoiser"]["fields"]["condition"]["fields"]["channels"]
    next(iter(channels.values())).pop()


def changed(change):
    return lambda path: rewritten(planner(network=True).save(path), change)


FILES = {
    "no planner of dadiff, or damaged": foreign_pickle,
    "holds other.txt; expected planner.json and arrays.safetensors": empty_zip,
    "is compressed": bomb,
    "or damaged": truncated,
    "which is no part of a planner": without_arrays,
    "has format 99, this version reads up to": changed(lambda d: d.update(format=99)),
    "is no planner of dadiff": changed(lambda d: d.update(format="x")),
    "lacks a part of a planner": changed(lambda d: d["planner"].pop("schedule")),
    "which is not built from a file; to trust its package": changed(
        lambda d: d["planner"]["task"].update({"class": "os.path:join"})
    ),
    "names dadiff.store.cli:main, which is not built": changed(
        lambda d: d["planner"]["task"].update({"class": "dadiff.store.cli:main"})
    ),
    "which is no dataclass": changed(lambda d: d["planner"]["task"].update({"class": "dadiff.tasks.lqr:np"})),
    "does not fit this version": changed(lambda d: d["planner"]["task"]["fields"].update(speed=1)),
    "horizon is -1": changed(lambda d: d["planner"]["task"]["fields"].update(horizon=-1)),
    "its coordinates has tau of 184 entries, its task and system 190": changed(
        lambda d: d["planner"]["task"]["fields"].update(horizon=31)
    ),
    "its denoiser has tau of 6000000004 entries": changed(
        lambda d: d["planner"]["denoiser"]["fields"]["layout"]["fields"].update(horizon=10**9)
    ),
    "its denoiser takes E of 4 entries, its task 8": changed(_shorter_condition),
    "schedule of its Planner is 1e9, which is no Schedule": changed(lambda d: d["planner"].update(schedule="1e9")),
    "holds .'number': 'x'., which is no part of a planner": changed(
        lambda d: d["planner"].update(schedule={"number": "x"})
    ),
    "system of its Planner is LQR": changed(lambda d: d["planner"].update(system=d["planner"]["task"])),
    "robot.zip: is no planner of dadiff; write": lambda path: described_as(path, [1, 2]),
    "damaged .maximum recursion": lambda path: described_as(path, nested(100_000)),
    "tensor network": changed(lambda d: d["planner"]["denoiser"]["fields"]["recipe"]["fields"].update(width=8)),
}


@pytest.mark.parametrize(("message", "make"), FILES.items(), ids=FILES)
def test_what_is_no_planner_is_one_line_and_executes_nothing(tmp_path, message, make):
    path = tmp_path / "robot.zip"
    make(path)
    with pytest.raises(CheckpointError, match=message) as caught:
        Planner.load(path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"samples": 0}, "samples is 0; ask for at least 1"),
        ({"environment": np.zeros(8)}, "both E and its fields x_init, target are given"),
        (
            {"samples": 2, "start": Plans(LAYOUT, np.zeros((3, LAYOUT.size)), 0)},
            r"start has shape \(3, 184\), expected",
        ),
        ({"seed": -1}, "seed of sampling noise: is -1"),
    ],
)
def test_what_cannot_be_planned_is_refused(arguments, message):
    with pytest.raises(DadiffError, match=message):
        planner().plan(**{"x_init": [0, 0, 0, 0], "target": [1, 2, 0, 0], **arguments})


def test_a_planner_with_a_function_says_that_it_cannot_be_stored():
    from dadiff.planning.codec import Encoder

    with pytest.raises(CheckpointError, match=r"planner.system: is a function, which cannot be stored"):
        Encoder()(lambda x: x, "planner.system")


def test_plans_are_tables_with_a_row_a_time(tmp_path):
    plans = plan_of(planner())
    table = plans.table()
    assert len(table) == 3 * 31
    assert list(table)[:3] == ["plan", "t", "seconds"]
    read = pd.read_csv(plans.save(tmp_path / "plan.csv"))
    np.testing.assert_allclose(read.to_numpy()[:, 3:7], plans.states.reshape(-1, 4))
    with np.load(plans.save(tmp_path / "plan.npz")) as stored:
        np.testing.assert_array_equal(stored["inputs"], plans.inputs)
    with pytest.raises(DataError, match=r"written as \.csv or \.npz"):
        plans.save(tmp_path / "plan.txt")


def test_the_shell_gives_the_plans_of_python(tmp_path, capsys):
    one = planner()
    file = str(one.save(tmp_path / "robot.zip"))
    main([file, "--x-init", "0,0,0.5,0", "--target=1,2,0,0", "--samples", "3", "--seed", "1",
          "--output", str(tmp_path / "p.npz"), "--plot", str(tmp_path / "p.png"),
          "--animate", str(tmp_path / "p.gif")])  # fmt: skip
    with np.load(tmp_path / "p.npz") as stored:
        np.testing.assert_array_equal(stored["states"], plan_of(one).states)
    assert (tmp_path / "p.png").stat().st_size > 10_000
    assert (tmp_path / "p.gif").stat().st_size > 10_000
    (tmp_path / "case.yaml").write_text("x_init: [0, 0, 0.5, 0]\ntarget: [1, 2, 0, 0]\n")
    main([file, "--condition", str(tmp_path / "case.yaml")])
    assert "plan" in capsys.readouterr().out


WRONG = [
    (["--x-init", "0,0,0,0"], "'target' is missing"),
    (["--x-init", "a,b", "--target", "0,0,0,0"], "--x-init is 'a,b'; expected numbers"),
    (["--x-init"], "expected the fields of the condition as --name numbers"),
    (["--samples", "0", "--x-init", "0,0,0,0", "--target", "0,0,0,0"], "--samples is 0"),
    (["--condition", "nowhere.yaml"], "cannot be read"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=[message for _, message in WRONG])
def test_the_shell_answers_mistakes_in_one_line(tmp_path, capsys, arguments, message):
    file = str(planner().save(tmp_path / "robot.zip"))
    with pytest.raises(SystemExit) as caught:
        main([file, *arguments])
    assert caught.value.code == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_stored_run_is_a_planner_that_gives_the_runs_plans(tmp_path):
    """The real command line, then another process that has only the file."""
    subprocess.run(
        [sys.executable, "-m", "dadiff", "training.steps=20", "denoiser.width=32", "dataset.train_size=50",
         "dataset.test_size=3", "evaluation.samples=2", "sampler=ddim", "sampler.num_steps=5",
         "projector=known_fixed", "progress=false", f"output_dir={tmp_path}/out"],
        check=True, capture_output=True,
    )  # fmt: skip
    folder = next((tmp_path / "out/runs").glob("[0-9a-f]*"))
    loaded = Planner.load(folder)
    with np.load(folder / "examples.npz") as examples:
        fields = {name: examples[f"environment_{name}"] for name in ("x_init", "target")}
        stored = examples["states"]
    plans = loaded.plan(loaded.condition.pack(**fields), samples=2, seed=0)
    np.testing.assert_array_equal(plans.states, stored)
    moved = Planner.load(loaded.save(tmp_path / "robot.zip"))
    (tmp_path / "out").rename(tmp_path / "gone")
    np.testing.assert_array_equal(moved.plan(loaded.condition.pack(**fields), samples=2, seed=0).states, stored)


TINY = [
    "sampler=ddim", "sampler.num_steps=5", "dataset.train_size=60", "dataset.test_size=2", "evaluation.samples=2",
    "training.steps=10", "denoiser.width=8", "tracking.enabled=false", "progress=false",
]  # fmt: skip
WITHOUT_A_NETWORK = [option for option in TINY if not option.startswith(("training", "denoiser"))]
RUNS = {
    "gaussian": [*WITHOUT_A_NETWORK, "denoiser=gaussian", "projector=none"],
    "moment_matched": [*WITHOUT_A_NETWORK, "denoiser=moment_matched", "projector=hankel_lowrank"],
    "fleet": [*WITHOUT_A_NETWORK, "denoiser=moment_matched", "task=fleet", "task.robots=40",
              "system=damped_integrators", "task.interpolation=1", "task.extrapolation=1", "projector=identified"],
    "regression": [*TINY[2:], "training=regression", "sampler=once"],
    "closed loop": [*TINY, "evaluation=closed_loop", "evaluation.replan_every=[10]"],
    "few": [*TINY[2:], "sampler=few", "projector=known_fixed"],
}  # fmt: skip


@pytest.mark.parametrize("overrides", RUNS.values(), ids=RUNS)
def test_every_run_is_a_planner_that_gives_its_plans(tmp_path, monkeypatch, overrides):
    monkeypatch.setattr("dadiff.evaluation.closed_loop.TIMED_SECONDS", 0.0)
    run = dadiff.run([*overrides, f"output_dir={tmp_path}/out"])
    moved = Planner.load(Planner.load(run.folder).save(tmp_path / "robot.zip"))
    with np.load(run.folder / "examples.npz") as examples:
        shown = np.argsort(examples["robots"]) if "robots" in examples else Ellipsis
        E = moved.condition.pack(**{name: examples[f"environment_{name}"] for name in moved.condition.names})
        stored = examples["states"]
    (tmp_path / "out").rename(tmp_path / "gone")
    np.testing.assert_array_equal(moved.plan(E[shown], samples=2, seed=0).states, stored[shown])


def test_the_file_of_a_known_law_holds_what_it_is_made_from(tmp_path):
    """Not its maps, which for n = 40 and T = 100 have 145 MB: the system and the expert's gains."""
    one = planner()
    law_bytes = TASK.law(SYSTEM).noise_map.nbytes
    assert one.save(tmp_path / "robot.zip").stat().st_size < law_bytes
    np.testing.assert_array_equal(plan_of(Planner.load(tmp_path / "robot.zip")).tau, plan_of(one).tau)


def test_errors_are_dadiffs_own(tmp_path):
    with pytest.raises(DadiffError, match="no such file"):
        Planner.load(tmp_path / "nowhere.zip")
    with pytest.raises(DadiffError, match=r"holds no planner.json"):
        Planner.load(tmp_path)


def every_set() -> dict[str, TrajectorySet]:
    shown = TASK.demonstrations(SYSTEM, 50, np.random.default_rng(0)).trajectories
    recording = GaussianExcitation(length=200).record(SYSTEM)
    limited = replace(SYSTEM, bounds=Bounds(-2.0, 2.0))
    learned = {kind.__name__: kind().fit(LAYOUT, SYSTEM, recording, shown) for kind in (HankelLowRank, IdentifiedSoft)}
    plain = {kind.__name__: kind().fit(LAYOUT, SYSTEM) for kind in (Inpainting, Known)}
    learned["DoubtedManifold"] = IdentifiedSoft(features=("identity",)).fit(LAYOUT, SYSTEM, recording)
    return {**learned, **plain, "Limited": Known(bounds="enforced").fit(LAYOUT, limited)}


@pytest.mark.parametrize(
    "name", ["HankelLowRank", "IdentifiedSoft", "DoubtedManifold", "Inpainting", "Known", "Limited"]
)
@pytest.mark.parametrize("enforcement", [Conditional(), Conditional("measured"), CleanEstimate()], ids=str)
def test_every_set_and_the_estimates_law_are_in_the_file(tmp_path, name, enforcement):
    shown = TASK.demonstrations(SYSTEM, 300, np.random.default_rng(0))
    made = Estimate.of_demonstrations(LAYOUT, physical(LAYOUT), shown.trajectories, shown.environment)
    weighed = Measured(made.covariance, made.deviation, made.unit, LAYOUT, {"1": made.covariance})
    before = replace(planner(), behaviour=every_set()[name], enforcement=enforcement, estimate=weighed)
    after = Planner.load(before.save(tmp_path / "robot.zip"))
    np.testing.assert_array_equal(plan_of(after).tau, plan_of(before).tau)

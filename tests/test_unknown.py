"""An unknown system: learned from data, planned for, and nothing said of it that only the system could tell."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from test_physics import SYSTEM, run

import dadiff
from dadiff.datasets.own import OwnEnvironments
from dadiff.errors import DadiffError, NotApplicableError
from dadiff.planning import Planner
from dadiff.running.data import outside
from dadiff.systems import double_integrator, require_affine, unknown
from dadiff.tasks import LQR
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory import Channel, Layout

NEEDS_THE_SYSTEM = ("rollout_state_error", "gap", "dynamics_residual", "cost_ratio", "prediction_error",
                    "principal_angle", "spread_ratio", "model_cost_ratio")  # fmt: skip
FEW = ["denoiser=moment_matched", "evaluation.samples=2", "tracking.enabled=false", "progress=false",
       "system=unknown", "system.states=4", "system.inputs=2"]  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Demonstrations and a recording about a trim, and a recording of another robot."""
    root, task = tmp_path_factory.mktemp("own"), LQR(horizon=8)
    layout, shift = SYSTEM.layout(8), np.array([5.0, -3, 0, 0])
    for part, count, seed in (("train", 120, 0), ("test", 4, 1)):
        (root / part).mkdir()
        shown = task.demonstrations(SYSTEM, count, np.random.default_rng(seed))
        for k, (x, u) in enumerate(zip(*layout.split(shown.trajectories), strict=True)):
            ends = {"initial_state": x[0] + shift, "target_state": shown.environment[k, 4:] + shift}
            np.savez(root / part / f"{k:03d}.npz", states=x + shift, inputs=u + 0.3, **ends)
    for name, sign in (("log", 1.0), ("other", -1.0)):
        (root / name).mkdir()
        states, inputs = run(200, seed=3)
        np.savez(root / name / "a.npz", states=states + shift, inputs=sign * inputs + 0.3)
    return root


def planned(folders, *words: str, output: str = "out"):
    given = [f"dataset.path={folders}"] if "dataset=generated" not in words else []
    return dadiff.run([*FEW, "dataset=npz", *given, "task.horizon=8", f"output_dir={folders / output}", *words])


@pytest.mark.parametrize("projector", ["identified", "hankel_lowrank", "koopman", "identified_soft"])
def test_it_is_planned_for_from_a_recording_and_only_what_is_known_is_scored(folders, projector):
    done = planned(folders, "recording=npz", f"recording.path={folders / 'log'}", f"projector={projector}",
                   "projector.offset=estimated")  # fmt: skip
    assert done.status == "finished"
    assert done.metrics["planned_state_error"] < 0.1
    assert done.metrics["recording_residual"] == pytest.approx(1, abs=0.1)
    assert done.metrics["demonstrations_residual"] == pytest.approx(1, abs=0.15)
    assert not set(NEEDS_THE_SYSTEM) & set(done.metrics)
    assert np.isnan(done.arrays()["rollout_states"]).all()
    plan = Planner.load(done.folder).plan(x_init=[5, -3, 0, 0], target=[6, -3, 0, 0], samples=2)
    x, u = plan.states, plan.inputs
    tolerance = 0.3 if projector == "identified_soft" else 0.02
    np.testing.assert_allclose(x[..., 1:, :], SYSTEM.step(x[..., :-1, :], u - 0.3), atol=tolerance)


@pytest.mark.parametrize("projector", ["none", "inpainting", "identified"])
def test_without_a_recording_the_demonstrations_are_enough(folders, projector):
    words = ["projector.learn_from=demonstrations", "projector.offset=estimated"] if projector == "identified" else []
    assert planned(folders, f"projector={projector}", *words).metrics["planned_state_error"] < 0.1


REFUSED = {
    "known": (["projector=known"], "unknown.*projector that learns"),
    "rollout": (["projector=rollout"], "needs the system, which is unknown"),
    "generated": (["dataset=generated"], "unknown.*use dataset=npz"),
    "simulated recording": (["projector=identified"], "nothing can be simulated with it.*recording=npz"),
    "known offset": (["projector=identified", "projector.learn_from=demonstrations", "projector.offset=known"],
                     "needs the system, which is unknown"),
    "closed loop": (["projector=none", "evaluation=closed_loop"], "evaluation=default"),
    "exact": (["projector=none", "evaluation=exact"], "evaluation=default"),
    "exact denoiser": (["projector=none", "denoiser=gaussian"], "needs the system, which is unknown"),
    "obstacles": (["projector=none", "task=obstacles", "dataset=generated", "task.horizon=40"], "unknown"),
    "fleet": (["projector=none", "task=fleet", "dataset=generated"], "from a family"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_the_system_is_refused_in_a_line(folders, name):
    words, told = REFUSED[name]
    with pytest.raises(DadiffError, match=told) as error:
        planned(folders, *words, output="refused")
    assert "\n" not in str(error.value)


def test_a_recording_of_another_robot_than_the_demonstrations_is_refused(folders):
    words = [
        "recording=npz",
        f"recording.path={folders / 'other'}",
        "projector=identified",
        "projector.offset=estimated",
    ]
    with pytest.raises(DadiffError, match="train: the data do not obey the dynamics that the recording shows"):
        planned(folders, *words, output="refused")
    done = planned(folders, *words, "dataset.allow_mismatch=true")
    assert done.metrics["demonstrations_residual"] > 5
    assert "demonstrations / noise" in str(dadiff.running.summary.one_run(done))


def test_environments_in_centimetres_are_said_by_their_target(tmp_path, caplog):
    (tmp_path / "cm.yaml").write_text(
        "- {x_init: [0, 0, 0, 0], target: [300, 100], obstacles: [{centre: [150, 50], radius: 40}]}"
    )
    task, robot = Obstacles(), double_integrator(process_noise=0.0)
    own = OwnEnvironments(str(tmp_path / "cm.yaml"), train_size=60)
    learned, asked = own.train(task, robot).environment, own.test(task, robot).environment
    assert outside(task.condition(robot), learned, asked) == 1
    assert re.search(r"of (target|obstacles|waypoints), case 0 has (300|150|1e|40).* other units", caplog.text)
    assert outside(task.condition(robot), learned, own.generated.test(task, robot).environment) == 0


def test_it_has_no_step_and_no_matrices():
    with pytest.raises(NotApplicableError, match="unknown"):
        unknown(2, 1).step(np.zeros(2), np.zeros(1))
    with pytest.raises(NotApplicableError, match="what needs the system, which is unknown"):
        require_affine(unknown(2, 1), "what")


@pytest.mark.parametrize(("factor", "count"), [(1.0, 0), (100.0, 4), (1.2, 0)])
def test_conditions_far_outside_of_what_was_learned_from_are_counted_and_said(factor, count, caplog):
    condition, rng = Layout((Channel("x_init", 2), Channel("target", 1))), np.random.default_rng(0)
    learned, asked = rng.uniform(-1, 1, (200, 3)), factor * np.tile([0.5, -0.9, 0.9], (4, 1))
    assert outside(condition, learned, asked) == count
    assert ("other units?" in caplog.text) == bool(count)


def test_a_value_that_never_varied_is_far_as_soon_as_it_differs(caplog):
    condition = Layout((Channel("x_init", 1), Channel("obstacles", 1)))
    assert outside(condition, np.array([[0.0, 0.3], [1.0, 0.3]]), np.array([[0.5, 0.3], [0.5, 0.31]])) == 1
    assert "of obstacles, case 1 has 0.31 where training had 0.3 to 0.3" in caplog.text


OWN_DATA = (Path(__file__).parent.parent / "docs" / "your-own-data.md").read_text()


def test_a_newcomer_gets_through_the_page_on_own_data(tmp_path, monkeypatch, capsys):
    """Its scripts and commands one after the other, as written; trainings are kept short."""
    monkeypatch.chdir(tmp_path)
    small = ["denoiser=moment_matched", "evaluation.samples=1", "tracking.enabled=false", "progress=false"]
    done = []
    for kind, block in re.findall(r"^```(python|text)\n(.*?)^```", OWN_DATA, flags=re.DOTALL | re.MULTILINE):
        if kind == "python":
            exec(compile(block, "page", "exec"), {})
        else:
            words = shlex.split(block)[1:]
            few = [] if "dataset=npz" in words else ["dataset.train_size=60", "dataset.test_size=2"]
            done.append(dadiff.run([*words, *small, *few]))
    assert [run.status for run in done] == ["finished"] * 3
    assert all(run.metrics["recording_residual"] == pytest.approx(1, abs=0.1) for run in done)
    told = capsys.readouterr().out
    assert "[1.0, 0.0, 0.1, 0.0]" in told.replace("-0.0", "0.0")

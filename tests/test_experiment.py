"""One run, whole: from configuration to stored result, with the exact denoiser so that nothing is trained."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from laws import composed

from dadiff.errors import ConfigError, DadiffError, ExcitationError, StoreError
from dadiff.launching import jobs
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.store import StoredRun

SMALL = (
    "denoiser=gaussian",
    "sampler=ddim",
    "sampler.num_steps=10",
    "task.horizon=8",
    "dataset.train_size=40",
    "dataset.test_size=3",
    "evaluation.samples=2",
    "recording.length=60",
    "progress=false",
    "device=cpu",
    "tracking.enabled=false",
)


@pytest.fixture(scope="module")
def base() -> dict[str, dict[str, Any]]:
    """Small configurations by projector; composing is slower than running."""
    return {
        name: composed(f"projector={name}", *SMALL)
        for name in ("none", "known", "hankel", "hankel_lowrank", "identified", "rollout")
    }


@pytest.fixture
def run(base, tmp_path):
    """Execute a small run: `run("known", "sampler.eta=1.0", folder="out")`."""

    def execute_small(
        projector: str, *overrides: str, folder: str = "out", enforcement: str = "normalised"
    ) -> StoredRun:
        config = copy.deepcopy(base[projector]) | {"output_dir": str(tmp_path / folder)}
        config["enforcement"] = yaml.safe_load((CONF_ENFORCEMENT / f"{enforcement}.yaml").read_text())
        for override in overrides:
            path, _, value = override.partition("=")
            *groups, key = path.split(".")
            (config[groups[0]] if groups else config)[key] = yaml.safe_load(value)
        return execute(Experiment.of(config))

    return execute_small


CONF_ENFORCEMENT = Path(__file__).parent.parent / "conf" / "enforcement"


def per_step(stored: StoredRun) -> pd.DataFrame:
    return pd.read_parquet(stored.folder / "per_step.parquet")


def test_a_run_stores_errors_along_time_and_their_means(run):
    stored = run("known")
    table = per_step(stored)
    assert stored.status == "finished"
    assert len(table) == 3 * 2 * 9
    for name in ("planned_state_error", "planned_input_error", "rollout_state_error", "gap", "dynamics_residual"):
        np.testing.assert_allclose(stored.metrics[name], table[name].mean(), rtol=1e-4, atol=1e-20)
        assert table[name].notna().sum() == (
            54 if name in ("planned_state_error", "rollout_state_error", "gap") else 48
        )
    assert {"cost_ratio", "initial_state_error", "network_calls", "sampling_seconds"} <= set(stored.metrics)
    assert stored.metrics["network_calls"] == 10
    assert stored.record.notes["schedule"] == {"C1": True, "C2": True, "C3": True}
    assert {"config.yaml", "run.json", "per_step.parquet", "per_plan.parquet", "chain.parquet", "examples.npz"} <= {
        file.name for file in stored.folder.iterdir()
    }


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others(run):
    one, two = (run("hankel_lowrank", folder=folder) for folder in ("a", "b"))
    other = run("hankel_lowrank", "evaluation.seed=1", folder="a")
    assert one.key == two.key != other.key
    pd.testing.assert_frame_equal(per_step(one), per_step(two), check_exact=True)
    assert not np.allclose(per_step(one).planned_state_error, per_step(other).planned_state_error)


def test_projector_none_equals_enforcement_none_bit_for_bit(run):
    vanilla, idle = run("none"), run("known", enforcement="none")
    pd.testing.assert_frame_equal(per_step(vanilla), per_step(idle), check_exact=True)
    assert "projection_calls" not in vanilla.metrics


def test_every_projector_makes_admissible_plans_of_noise_free_recordings(run):
    for name in ("known", "hankel", "hankel_lowrank", "identified", "rollout"):
        metrics = run(name, "recording.process_noise=0.0").metrics
        assert metrics["dynamics_residual"] < 1e-18, name
        assert metrics["projection_calls"] == 10
    assert run("none").metrics["dynamics_residual"] >= 0


def test_plans_in_standardised_coordinates_are_admissible_in_physical_units(run):
    stored = run("known", "coordinates=standardised", "projector.initial_state=fixed")
    assert stored.metrics["dynamics_residual"] < 1e-18
    assert stored.metrics["initial_state_error"] < 1e-18
    assert stored.metrics["gap"] < 1e-18


def test_learned_sets_are_measured_against_the_true_one(run):
    noisy, clean = run("hankel_lowrank"), run("hankel_lowrank", "recording.process_noise=0.0")
    assert noisy.metrics["rank"] == clean.metrics["rank"] == 4 + 2 * 8
    assert clean.metrics["principal_angle"] < 1e-10 < 1e-4 < noisy.metrics["principal_angle"] < np.pi / 2
    assert clean.metrics["singular_value_gap"] > 1e6 * noisy.metrics["singular_value_gap"]
    assert "principal_angle" not in run("known").metrics


def test_the_recorder_of_theorem_1_can_be_switched_off_and_changes_nothing_else(run):
    followed, plain = run("known"), run("known", "evaluation.theorem1=false")
    assert followed.has("chain")
    assert not plain.has("chain")
    pd.testing.assert_frame_equal(per_step(followed), per_step(plain), check_exact=True)


def test_a_diverged_run_is_a_result_without_numbers(run):
    stored = run("known", "evaluation.divergence_bound=100.0", "sampler.num_steps=1000", enforcement="literal")
    assert stored.status == "diverged"
    assert 1 <= stored.record.diverged_step <= 1000
    assert not (stored.folder / "per_step.parquet").exists()
    assert not {"planned_state_error", "cost_ratio", "gap"} & set(stored.metrics)


def test_what_is_done_is_read_and_not_done_again(run):
    first = run("known")
    started = first.record.provenance.started, (first.folder / "run.json").stat().st_mtime_ns
    again = run("known")
    assert (again.record.provenance.started, (again.folder / "run.json").stat().st_mtime_ns) == started
    assert (run("known", "force=true").folder / "run.json").stat().st_mtime_ns != started[1]


def test_a_tiny_training_is_done_once_for_two_projectors(tmp_path):
    overrides = [o for o in SMALL if o != "denoiser=gaussian"] + ["training.steps=5", "training.batch_size=8"]
    small = ["denoiser.width=8", "denoiser.blocks=1", "training.warmup=1", f"output_dir={tmp_path}"]
    known, none = (composed(f"projector={name}", *overrides, *small) for name in ("known", "none"))
    Experiment.of(known).build("denoiser")
    models = list((tmp_path / "cache" / "denoiser").glob("*/model.safetensors"))
    stamps = [model.stat().st_mtime_ns for model in models]
    runs = [execute(Experiment.of(known)), execute(Experiment.of(none))]
    assert len(models) == 1
    assert [
        model.stat().st_mtime_ns for model in (tmp_path / "cache" / "denoiser").glob("*/model.safetensors")
    ] == stamps
    assert runs[0].record.links["denoiser"] == runs[1].record.links["denoiser"] == models[0].parent.name


# --- refused


def left_behind(folder: Path) -> list[Path]:
    return list(folder.glob("runs/*/run.json"))


@pytest.mark.parametrize(
    ("projector", "overrides", "enforcement", "error", "message"),
    [
        ("hankel", ["recording.length=20"], "normalised", ExcitationError, "record S >= 27"),
        ("hankel", ["recording.length=200"], "normalised", ExcitationError, "H H† is the identity"),
        ("hankel", ["recording.input_std=0.0"], "normalised", ExcitationError, "n + mT = 20 are needed"),
        ("known", ["projector.initial_state=fixed"], "literal", ConfigError, "meaningless"),
        ("rollout", [], "literal", ConfigError, "meaningless"),
        (
            "known",
            ["task.state_cost=[1.0]"],
            "normalised",
            ConfigError,
            "state_cost has 1 entries, the system 4 states",
        ),
    ],
)
def test_a_refusal_is_one_line_and_leaves_no_run_behind(
    run, tmp_path, projector, overrides, enforcement, error, message
):
    with pytest.raises(error) as caught:
        run(projector, *overrides, enforcement=enforcement)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert left_behind(tmp_path / "out") == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a GPU")
def test_a_gpu_that_is_not_there_is_refused(run, tmp_path):
    with pytest.raises(
        ConfigError, match="device: cuda is asked for, but torch sees no GPU; use device=auto or device=cpu"
    ):
        run("known", "device=cuda")
    assert left_behind(tmp_path / "out") == []


def test_an_output_folder_that_cannot_be_written_is_refused(run, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreError, match=r"^[^\n]*file[^\n]*$"):
        run("known", folder="file/below")


def test_noise_prediction_is_refused_where_nothing_of_the_signal_is_left(tmp_path):
    overrides = [o for o in SMALL if o != "denoiser=gaussian"]
    config = composed("denoiser=mlp", "denoiser.prediction=noise", *overrides, f"output_dir={tmp_path}")
    with pytest.raises(ConfigError, match="prediction=noise divides by sqrt\\(alpha_bar_L\\)"):
        execute(Experiment.of(config))
    assert left_behind(tmp_path) == []


TRAINED = ("denoiser=mlp", "denoiser.width=8", "denoiser.blocks=1", *(o for o in SMALL if o != "denoiser=gaussian"))
BOUNDED = ("projector=known_bounded", "system.bounds={input_low: -2, input_high: 2}")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["enforcement=qp_filter", "projector=known_fixed"], "it is about bounds, and this projector keeps to none"),
        (["enforcement=barrier", "projector=known_fixed"], "it is about bounds, and this projector keeps to none"),
        (["enforcement=constricting_tube", "projector=identified"], "it is about bounds"),
        (["enforcement=literal", "projector=known_fixed"], "literal scales the sample"),
        (["projector=hankel", "recording.length=20"], "record S >= 27"),
        (["projector=known_bounded"], "bounds are to be enforced, and the system has none"),
        (["projector=identified_soft", "projector.residual=each"], "too long to be held"),
        (["evaluation=closed_loop", "task=obstacles", "task.horizon=40"], "needs a task that steers"),
        (["projector=known", "evaluation=exact"], "the law of a trained denoiser is not known"),
        (["projector=known", "denoiser=mlp_recording"], "holds no recording"),
    ],
)  # fmt: skip
def test_what_cannot_be_planned_with_is_refused_before_anything_is_trained(monkeypatch, tmp_path, overrides, message):
    def train(*_: object, **__: object) -> None:
        pytest.fail("trained in vain")

    monkeypatch.setattr("dadiff.denoisers.learning.train", train)
    monkeypatch.setattr("dadiff.behaviours.doubt.DOUBTED_UP_TO", 20)
    config = composed(*TRAINED, *overrides, f"output_dir={tmp_path}")
    with pytest.raises(DadiffError) as single:
        execute(Experiment.of(config))
    with pytest.raises(DadiffError) as swept:
        jobs.build([config], "denoiser")
    assert message in str(single.value)
    assert str(single.value) == str(swept.value)


def test_bounds_that_are_enforced_and_gradients_that_are_there_are_not_refused(monkeypatch, tmp_path):
    class Trained(Exception):
        pass

    def train(*_: object, **__: object) -> None:
        raise Trained

    monkeypatch.setattr("dadiff.denoisers.learning.train", train)
    for overrides in (
        (*BOUNDED, "enforcement=qp_filter"),
        (*BOUNDED, "enforcement=barrier"),
        ("projector=known_fixed", "enforcement=pigdm"),
    ):
        with pytest.raises(Trained):
            execute(Experiment.of(composed(*TRAINED, *overrides, f"output_dir={tmp_path}")))


def test_a_run_that_is_refused_leaves_what_it_shares_to_the_others(tmp_path):
    small = (*TRAINED, "training.steps=2", "training.batch_size=8", "training.warmup=0", f"output_dir={tmp_path}")
    refused, fine = (composed(*small, f"enforcement={e}", "projector=known_fixed") for e in ("qp_filter", "post_hoc"))
    jobs.build([refused, fine], "denoiser")
    assert len(list(tmp_path.glob("cache/denoiser/*/model.safetensors"))) == 1

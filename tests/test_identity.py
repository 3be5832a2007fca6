"""Laws of identity: a key moves with what can change a result and with nothing else."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest
import yaml
from laws import composed

from dadiff.running.digest import digest
from dadiff.running.identity import identify


@cache
def usual(*overrides: str) -> dict[str, Any]:
    return composed(*overrides)


def changed(overrides: tuple[str, ...], base: tuple[str, ...] = ()) -> dict[str, Any]:
    """A configuration with `a.b=value` written into it."""
    config = copy.deepcopy(usual(*base))
    for override in overrides:
        path, _, value = override.partition("=")
        *groups, key = path.split(".")
        (config[groups[0]] if groups else config)[key] = yaml.safe_load(value)
    return config


def key(*overrides: str, base: tuple[str, ...] = ()) -> str:
    return identify(changed(overrides, base)).key


HANKEL = ("projector=hankel_lowrank",)
VANILLA = ("projector=none",)
EXACT = ("denoiser=gaussian",)


@pytest.mark.parametrize(
    "override",
    [
        "system.process_noise=0.02",
        "task.horizon=20",
        "task.state_cost=[1.0, 1.0, 1.0, 1.0]",
        "dataset.train_size=99",
        "dataset.seed=7",
        "schedule.slope=0.0005",
        "denoiser.width=16",
        "training.steps=10",
        "sampler.eta=1.0",
        "projector.initial_state=fixed",
        "enforcement.floor=0.1",
        "evaluation.samples=3",
        "coordinates=standardised",
    ],
)
def test_what_can_change_the_result_changes_the_key(override):
    assert key(override) != key()


@pytest.mark.parametrize(
    ("override", "base"),
    [
        ("output_dir=elsewhere", ()),
        ("device=cpu", ()),
        ("progress=false", ()),
        ("force=true", ()),
        ("tracking.enabled=false", ()),
        ("tracking.experiment=other", ()),
        ("recording.length=500", ()),  # known reads no recording
        ("recording.length=500", VANILLA),
        ("enforcement.floor=0.1", VANILLA),
        ("training.steps=10", EXACT),
    ],
)
def test_what_cannot_change_the_result_leaves_the_key(override, base):
    assert key(override, base=base) == key(base=base)


def test_a_recording_counts_where_a_projector_reads_it():
    assert key("recording.length=500", base=HANKEL) != key(base=HANKEL)
    assert identify(usual()).recording is None
    assert identify(usual(*HANKEL)).recording is not None


def test_the_order_of_keys_and_the_names_of_presets_do_not_count():
    config = usual()
    backwards = {group: config[group] for group in reversed(config)}
    assert identify(backwards).key == key()
    assert identify({**config, "choices": {}}).key == key()


def test_a_default_left_out_is_a_default_written_out():
    config = copy.deepcopy(usual())
    del config["projector"]["initial_state"], config["sampler"]["spacing"]
    assert identify(config).key == key()


def test_cells_that_differ_in_projector_share_data_and_training():
    known, hankel, vanilla = (identify(usual(*base)) for base in ((), HANKEL, VANILLA))
    assert len({known.key, hankel.key, vanilla.key}) == 3
    assert known.demonstrations.key == hankel.demonstrations.key == vanilla.demonstrations.key
    assert known.cases.key == hankel.cases.key
    assert known.denoiser.key == hankel.denoiser.key == vanilla.denoiser.key


def test_a_training_follows_what_it_learns_from():
    trained = identify(usual()).denoiser.key
    for override in (
        "system.process_noise=0.02",
        "dataset.train_size=99",
        "training.steps=10",
        "schedule.slope=0.0005",
    ):
        assert identify(changed((override,))).denoiser.key != trained, override
    for override in ("sampler.num_steps=7", "dataset.test_size=99", "evaluation.samples=3"):
        assert identify(changed((override,))).denoiser.key == trained, override
    assert identify(usual(*EXACT)).denoiser is None


def test_data_from_files_count_by_content_and_not_by_place(tmp_path):
    def write(place: str, value: float) -> tuple[str, ...]:
        for part in ("train", "test"):
            (tmp_path / place / part).mkdir(parents=True, exist_ok=True)
            np.savez(tmp_path / place / part / "a.npz", states=np.full((31, 4), value))
        return ("dataset=npz", f"dataset.path={tmp_path / place}")

    one, same, other = write("one", 1.0), write("same", 1.0), write("other", 2.0)
    assert key(base=one) == key(base=same) != key(base=other)


def test_the_name_is_for_people():
    assert identify(usual()).name == "lqr/known/conditional/mlp/dpm_solver/seed=0"
    assert identify(changed(("recording.length=300",), HANKEL)).name.startswith("lqr/hankel_lowrank/S=300/w=0.01/")
    assert "known_fixed/" in identify(changed(("projector.initial_state=fixed",))).name
    assert "dpm_solver(eta=1.0)" in identify(changed(("sampler.eta=1.0",))).name


def test_axes_are_flat_and_name_the_choices():
    axes = identify(usual(*HANKEL)).axes
    assert axes["projector"] == "hankel_lowrank"
    assert axes["recording.length"] == 100
    assert (axes["seed"], axes["coordinates"], axes["initial_state"]) == (0, "physical", "free")
    assert all(not isinstance(value, dict) for value in axes.values())


def test_a_digest_is_stable_and_refuses_what_has_no_stable_form():
    assert digest({"b": 1, "a": [0.1, None, "x"]}) == digest({"a": [0.1, None, "x"], "b": 1}) == "3cbe6ba4a782a061"
    with pytest.raises(ValueError, match="not JSON compliant"):
        digest(float("nan"))

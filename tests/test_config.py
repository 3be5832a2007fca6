"""Laws of configuration: the signature is the schema, complaints name file and key, strangers' classes stay unbuilt."""

from __future__ import annotations

import copy
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, ClassVar

import pytest
import yaml
from laws import CONF, composed

from dadiff.behaviours import Hankel, Known
from dadiff.config import assemble, build
from dadiff.errors import ConfigError
from dadiff.launching import jobs


@cache
def usual() -> dict[str, Any]:
    return composed()


def with_value(override: str) -> dict[str, Any]:
    """The usual configuration with `key=value` written into it, which is what Hydra does, only faster."""
    path, _, value = override.partition("=")
    config = copy.deepcopy(usual())
    *groups, key = path.split(".")
    node = config[groups[0]] if groups else config
    node[key] = yaml.safe_load(value)
    return config


def refused(make: Callable[[], dict[str, Any]]) -> str:
    """The one line with which a configuration is refused."""

    with pytest.raises(ConfigError) as caught:
        assemble(make())
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_node_becomes_its_component():
    node = {"_target_": "dadiff.behaviours.Hankel", "allow_identity": True}
    assert build(node, "projector") == Hankel(allow_identity=True)


def test_defaults_written_out_or_left_out_are_the_same():
    short, long = (
        {"_target_": "dadiff.behaviours.Known"},
        {"_target_": "dadiff.behaviours.Known", "initial_state": "free", "sweeps": 1, "bounds": "ignored"},
    )
    nodes = [assemble({**usual(), "projector": node}).nodes["projector"] for node in (short, long)]
    assert nodes == [long, long]
    assert build(short, "projector") == build(long, "projector") == Known()


def test_what_no_yaml_can_hold_is_told_with_what_can_make_it():
    told = refused(lambda: build({"_target_": "dadiff.systems.Linear", "A": [[1]], "B": [[1]]}, "system"))
    assert told.startswith(
        "system: A is [[1]]: input should be an instance of ndarray; no yaml holds one: let _target_"
    )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "projector.foo=1",
            "projector (projector/known.yaml): key 'foo' is not known; known keys: initial_state, sweeps",
        ),
        (
            "projector.initial_state=held",
            "projector (projector/known.yaml): initial_state is 'held': input should be 'free' or 'fixed'",
        ),
        ("task.horizon=thirty", "task (task/lqr.yaml): horizon is 'thirty': input should be a valid integer"),
        ("task.horizon=30.0", "task (task/lqr.yaml): horizon is 30.0: input should be a valid integer"),
        ("task.state_cost=a", "task (task/lqr.yaml): state_cost is 'a': input should be a valid number"),
        ("task.state_cost=[a]", "task (task/lqr.yaml): state_cost is ['a']: input should be a valid number"),
        (
            "tracking.enabled=maybe",
            "tracking (tracking/sqlite.yaml): enabled is 'maybe': input should be a valid boolean",
        ),
        ("sampler.eta=true", "sampler (sampler/dpm_solver.yaml): eta is True: input should be a valid number"),
        ("training.loss_weight=none", "training (training/quick.yaml): loss_weight is 'none': input should be"),
        ("device=tpu", "config.yaml: device is 'tpu': input should be 'auto', 'cpu' or 'cuda'"),
        ("seed=-0.5", "config.yaml: seed is -0.5: input should be a valid integer"),
        ("schedule.num_steps=0", "schedule: num_steps is 0; it must be at least 1"),
        ("schedule.slope=0.1", "schedule: beta_11 = 1.1 lies outside [0, 1]"),
        ("recording.length=0", "recording: length is 0"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_key_in_one_line(override, message):
    assert refused(lambda: with_value(override)).startswith(message)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "+projector.initial_sate=free",
            "projector (projector/known.yaml): key 'initial_sate' is not known; did you mean initial_state?",
        ),
        ("+sede=1", "config.yaml: key 'sede' is not known; did you mean seed?"),
        ("dataset=npz", "dataset.path is missing; give dataset.path=..."),
        ("recording=npz", "recording.path is missing; give recording.path=..."),
        ("evaluation.seed=${sead}", "Interpolation key 'sead' not found"),
        ("~projector", "projector: no component is configured; choose one with projector=..."),
    ],
)
def test_so_is_one_on_the_command_line(override, message):
    assert refused(lambda: composed(override)).startswith(message)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("dadiff.behaviours.Knwon", "cannot be found"),
        ("dadiff.nowhere.Known", "cannot be found"),
        ("Known", "expected the dotted name of a class or function"),
        ("subprocess.run", "lies outside dadiff and is not built; to trust its package add components=[subprocess]"),
        ("os.system", "lies outside dadiff"),
        ("builtins.eval", "lies outside dadiff"),
        ("dadiffx.Known", "lies outside dadiff"),
        ("dadiff.running.provenance.subprocess.run", "cannot be found"),
        ("dadiff.folders.Path", "is no class or function of dadiff"),
        ("dadiff.config.build.importlib", "is no class or function of dadiff"),
        ("dadiff.config.build.TARGET", "is no class or function of dadiff"),
    ],
)
def test_only_the_packages_own_classes_are_built(target, message):
    text = refused(lambda: with_value(f"projector._target_={target}"))
    assert text.startswith("projector (projector/known.yaml): _target_ ")
    assert message in text


@dataclass(frozen=True)
class Own:
    """A component of the user's own package."""

    strength: float = 1.0
    needs: ClassVar[frozenset[str]] = frozenset()

    def fit(self, layout, system=None, recording=None, demonstrations=None):
        """Nothing."""


def loose(strength=1.0) -> Own:
    """One whose signature says nothing of types."""


@pytest.fixture
def own_package(monkeypatch):
    module = ModuleType("mine")
    module.Own, module.loose, module.ClassVar = Own, loose, ClassVar
    for thing in (Own, loose):
        monkeypatch.setattr(thing, "__module__", "mine")
    monkeypatch.setitem(sys.modules, "mine", module)


def test_a_package_that_the_user_names_is_trusted(own_package):
    node = {"_target_": "mine.Own", "strength": 2}
    assert build(node, "projector", ["mine"]) == Own(2)
    with pytest.raises(ConfigError, match=r"to trust its package add components=\[mine\]"):
        build(node, "projector")


def test_own_components_are_checked_as_well(own_package):
    with pytest.raises(ConfigError, match=r"^projector: strength is 'much': input should be a valid number"):
        build({"_target_": "mine.Own", "strength": "much"}, "projector", ["mine"])
    with pytest.raises(ConfigError, match=r"^projector: strength has no type in loose; annotate every parameter"):
        build({"_target_": "mine.loose", "strength": 1.0}, "projector", ["mine"])


def test_sizes_are_written_once():
    config = composed("system.process_noise=0.07", "seed=5")
    assert config["recording"]["process_noise"] == 0.07
    assert {config[group]["seed"] for group in ("dataset", "recording", "training", "evaluation")} == {5}


def test_everything_is_checked_before_anything_is_built():
    """A type in the last group stops the run before the range of the first one is looked at."""

    def both() -> dict[str, Any]:
        config = with_value("system.axes=0")
        return config | {"evaluation": config["evaluation"] | {"samples": "many"}}

    assert refused(both).startswith("evaluation (evaluation/default.yaml): samples")


def test_a_key_misspelt_inside_a_preset_is_named_with_its_file(tmp_path):
    shutil.copytree(CONF, tmp_path / "conf", symlinks=False)
    preset = tmp_path / "conf" / "sampler" / "dpm_solver.yaml"
    preset.write_text(preset.read_text().replace("num_steps", "num_stebs"))
    config = composed(conf=tmp_path / "conf")
    with pytest.raises(ConfigError, match=r"^sampler \(sampler/dpm_solver\.yaml\): key 'num_stebs' .* num_steps\?$"):
        assemble(config)


def test_a_misspelt_parameter_on_the_command_line_is_told_with_its_file():
    told = refused(lambda: composed("projector.initial_sate=fixed"))
    assert told == "projector (projector/known.yaml): key 'initial_sate' is not known; did you mean initial_state?"


def test_a_configuration_is_resolved_once_in_a_trained_run(tmp_path, monkeypatch):
    small = [
        "dataset.train_size=20",
        "dataset.test_size=2",
        "training.steps=2",
        "training.warmup=1",
        "denoiser.width=8",
    ]
    few = ["sampler=ddim", "sampler.num_steps=2", "evaluation.samples=1", "tracking.enabled=false", "progress=false"]
    config, resolved = composed(*small, *few, f"output_dir={tmp_path}"), []
    monkeypatch.setattr("dadiff.running.parts.assemble", lambda config: resolved.append(config) or assemble(config))
    assert jobs.run(config).status == "finished"
    assert len(resolved) == 1

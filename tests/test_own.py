"""Laws of own components: found from the current folder, known by their sources, never taken for what they were."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import dadiff
from dadiff.cli import overrides_first
from dadiff.config.own import load, sources_of
from dadiff.config.trust import VARIABLE
from dadiff.errors import ConfigError
from dadiff.interface import configuration, settle
from dadiff.launching.plan import make_plan
from dadiff.running.identity import Identity, identify
from dadiff.store import Cache

SMALL = [
    "denoiser=gaussian",
    "sampler=ddim",
    "sampler.num_steps=5",
    "dataset.train_size=20",
    "dataset.test_size=2",
    "evaluation.samples=1",
    "tracking.enabled=false",
    "progress=false",
    "components=[ownlab]",
]
PARTS = {
    "system": """
import numpy as np
from dadiff.systems import Linear
def own(gain: float = 0.1) -> Linear:
    return Linear(np.eye(4) + 0.1 * np.eye(4, k=2), gain * np.eye(4)[:, 2:], process_noise=0.01)
""",
    "projector": """
from dataclasses import dataclass
from dadiff.behaviours import Known
@dataclass(frozen=True)
class own(Known):
    gain: float = 0.1
""",
    "task": """
from dataclasses import dataclass
from dadiff.tasks import LQR
@dataclass(frozen=True)
class own(LQR):
    gain: float = 0.1
""",
    "dataset": """
from dataclasses import dataclass
from dadiff.datasets import Generated
@dataclass(frozen=True)
class own(Generated):
    gain: float = 0.1
""",
}


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """An empty folder with a package of own components, one a group, and a yaml of one line for each."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "ownlab")
    monkeypatch.setattr(sys, "path", [*sys.path])
    for group, source in PARTS.items():
        (tmp_path / "ownlab").mkdir(exist_ok=True)
        (tmp_path / "ownlab" / f"{group}.py").write_text(source)
        (tmp_path / "conf" / group).mkdir(parents=True)
        package = "# @package _global_\ntask:\n  " if group == "task" else ""
        (tmp_path / "conf" / group / "own.yaml").write_text(f"{package}_target_: ownlab.{group}.own\n")
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] == "ownlab"]:
        del sys.modules[name]


def edit(lab: Path, group: str, new: str = "0.2") -> None:
    path = lab / "ownlab" / f"{group}.py"
    path.write_text(path.read_text().replace("0.1", new))


def identity(group: str) -> Identity:
    settle()
    return identify(configuration([*SMALL[1:], "denoiser=mlp", f"{group}=own"], "conf"))


def keys(identity: Identity) -> dict[str, str]:
    return {"run": identity.key, **identity.links}


@pytest.mark.parametrize(
    ("group", "kept"),
    [("system", set()), ("task", set()), ("dataset", set()), ("projector", {"demonstrations", "cases", "denoiser"})],
)
def test_an_edit_changes_the_key_and_all_that_is_made_with_it(lab, group, kept):
    before, same = keys(identity(group)), keys(identity(group))
    edit(lab, group)
    after = keys(identity(group))
    assert before == same
    assert {kind for kind in before if before[kind] == after[kind]} == kept
    edit(lab, group, "0.1")  # as it is now: nothing to change
    (lab / "ownlab" / "helper.py").write_text("x = 1\n")  # which it may use
    assert identity(group).key != after["run"]


def test_a_yaml_of_one_line_is_enough_and_what_was_edited_is_run_anew(lab):
    first = dadiff.run([*SMALL, "system=own"], "conf")
    assert "/own/" in first.name
    edit(lab, "system", "0.3")
    second = dadiff.run([*SMALL, "system=own"], "conf")
    assert second.key != first.key
    assert not np.allclose(second.arrays()["inputs"], first.arrays()["inputs"])
    assert load("ownlab.system").own().B[2, 0] == 0.3


def test_what_has_no_sources_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "inmemory", type(sys)("inmemory"))
    with pytest.raises(ConfigError, match="inmemory has no source files"):
        sources_of("inmemory.Thing")


def made_at(output_dir: str) -> dict[str, int]:
    return {e.kind: (e.folder / "manifest.json").stat().st_mtime_ns for e in Cache(output_dir).entries()}


def test_force_makes_everything_anew_and_a_sweep_does_so_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few = [*SMALL[1:-1], "training.steps=2", "training.warmup=1", "training.batch_size=8", "denoiser.width=8"]
    dadiff.run(few)
    before = made_at("outputs")
    dadiff.run([*few, "force=true"])
    after = made_at("outputs")
    assert before.keys() == after.keys() == {"demonstrations", "cases", "denoiser"}
    assert all(before[kind] != after[kind] for kind in before)
    plan = make_plan([configuration([*few, "force=true", f"projector={name}"]) for name in ("known", "none")])
    assert [preparation.artefact.kind for preparation in plan.preparations] == ["demonstrations", "denoiser", "cases"]


@pytest.mark.parametrize(
    "given",
    [
        ["--config-dir", "conf", "a=1", "-m", "b=2,3"],
        ["-m", "a=1", "--config-dir", "conf", "b=2,3"],
        ["a=1", "-m", "b=2,3", "--config-dir", "conf"],
    ],
)
def test_options_and_overrides_come_in_any_order(given):
    ordered = overrides_first(given)
    assert ordered[:2] == ["a=1", "b=2,3"]
    assert sorted(ordered) == sorted(given)

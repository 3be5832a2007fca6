"""Every preset in conf/: it builds its component, writes out every parameter, and says in a comment what it is."""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

import pytest
import yaml
from laws import CONF, composed, presets

from dadiff.config import GROUPS, build
from dadiff.config.build import TARGET, resolve

# What presets leave for the user to say, and where a preset makes sense only beside another one.
GIVEN = {
    ("dataset", "npz"): ["dataset.path=somewhere"],
    ("dataset", "environments"): ["dataset.path=somewhere.yaml"],
    ("system", "inline"): ["system.A=[[1,0.1],[0,1]]", "system.B=[[0],[0.1]]"],
    ("system", "unknown"): ["system.states=4", "system.inputs=2"],
    ("recording", "npz"): ["recording.path=somewhere"],
}
# Where a component stands for what its methods ask of it.
METHODS = {
    "task": ("target", "condition", "demonstrations", "cases", "score"),
    "dataset": ("train", "test"),
    "recording": ("record",),
    "sampler": ("steps",),
    "projector": ("fit", "needs"),
    "enforcement": ("clean", "sample", "end", "affine"),
    "schedule": ("beta", "alpha_bar", "conditions"),
    "denoiser": ("trainable",),
    "tracking": ("prepare", "log_run"),
}
PRESETS = [(group, preset) for group in GROUPS for preset in presets(group)]

every_preset = pytest.mark.parametrize(("group", "preset"), PRESETS, ids=lambda value: value)


@cache
def column(k: int) -> dict[str, Any]:
    """The k-th preset of every group that has as many, composed at once."""
    chosen = {group: presets(group)[k] for group in GROUPS if k < len(presets(group))}
    given = [override for pair in chosen.items() for override in GIVEN.get(pair, [])]
    return composed(*(f"{group}={preset}" for group, preset in chosen.items()), *given)


def composed_node(group: str, preset: str) -> dict[str, Any]:
    return column(presets(group).index(preset))[group]


@every_preset
def test_it_builds_its_component_and_hides_no_parameter(group, preset):
    node = composed_node(group, preset)
    component = build(node, group)
    for name in METHODS.get(group, ()):
        assert hasattr(component, name), name
    parameters = set(inspect.signature(resolve(node, group)).parameters)
    assert set(node) - {TARGET} == parameters, "every parameter has its line in the preset"


@every_preset
def test_its_first_line_says_what_it_is(group, preset):
    first = (CONF / group / f"{preset}.yaml").read_text().splitlines()[0]
    assert first.startswith("# ")
    assert len(first) > 15


def test_no_group_is_empty_and_every_folder_is_a_group():
    folders = {folder.name for folder in CONF.iterdir() if folder.is_dir()}
    assert folders - {"hydra", "preset", "sweeps"} == set(GROUPS) == {group for group, _ in PRESETS}


@pytest.mark.parametrize("name", presets("preset"))
def test_every_preset_of_several_groups_composes(name):
    assert composed(f"+preset={name}")["choices"] != composed()["choices"]


def test_the_defaults_list_is_a_table_of_contents():
    entries = yaml.safe_load((CONF / "config.yaml").read_text())["defaults"]
    chosen = {key for entry in entries if isinstance(entry, dict) for key in entry}
    assert set(GROUPS) <= chosen

"""What a stranger's file may do: choose among the components of each group, and nothing else."""

from __future__ import annotations

import os
from typing import Any

import pytest
import yaml
from hydra import compose, initialize_config_dir
from laws import CONF, composed, node, presets

from dadiff.cli import check_what_is_printed
from dadiff.config import GROUPS, assemble
from dadiff.config.build import resolve
from dadiff.config.protocols import PROTOCOLS
from dadiff.config.trust import VARIABLE, trust, trusted
from dadiff.errors import ConfigError
from dadiff.launching import guard, register

ACTING = (
    "dadiff.store.cli.main",
    "dadiff.store.cli.prune",
    "dadiff.sync.main",
    "dadiff.cli.main",
    "dadiff.tracking.download.download",
    "dadiff.denoisers.checkpoints.load",
    "dadiff.launching.work.perform",
    "dadiff.store.Results",
    "dadiff.errors.DadiffError",
)


@pytest.mark.parametrize("group", GROUPS)
def test_every_preset_is_a_component_of_its_group(group):
    for preset in presets(group):
        content = yaml.safe_load((CONF / group / f"{preset}.yaml").read_text())
        if "_target_" in (written := content.get(group, content)):
            resolve(written, group)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("target", ACTING)
def test_what_acts_is_no_component_of_any_group(group, target):
    with pytest.raises(ConfigError, match=rf"^{group}: {target.rpartition('.')[0].split('.')[0]}.* is no {group}"):
        resolve({"_target_": target}, group)


@pytest.mark.parametrize("group", GROUPS)
def test_components_of_other_groups_are_refused(group):
    for other in GROUPS:
        written = (
            next(w for w in (node(other, p) for p in presets(other)) if "_target_" in w) if other != "task" else {}
        )
        if other != group and written:
            with pytest.raises(ConfigError, match=f"is no {group}"):
                resolve(written, group)


@pytest.mark.parametrize("path", sorted({path for paths in PROTOCOLS.values() for path in paths}))
def test_what_components_extend_is_not_built_itself(path):
    group = next(group for group, paths in PROTOCOLS.items() if path in paths)
    if path.endswith(("Schedule", "Training", "Evaluation", "Tracking")):  # components themselves
        assert resolve({"_target_": path}, group).__name__ == path.rpartition(".")[2]
    else:
        with pytest.raises(ConfigError, match="is abstract; name a class that extends it"):
            resolve({"_target_": path}, group)


def test_a_file_does_not_give_trust(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    config = composed() | {"components": ["mine"]}
    with pytest.raises(ConfigError, match=rf"components=\[mine\], or by {VARIABLE}=mine"):
        assemble(config)
    trust(["mine"])
    assert assemble(config).settings.components == ["mine"]
    assert trusted() == ("mine",)


def with_hydra(*overrides: str) -> Any:
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides), return_hydra_config=True)


@pytest.mark.parametrize(
    "override",
    [
        "+hydra.callbacks.a._target_=os.getcwd",
        "hydra.run.dir=elsewhere",
        "hydra.sweep.dir=elsewhere",
        "hydra.output_subdir=.hydra",
        "hydra.job.chdir=true",
        "+hydra.job.env_set.LD_PRELOAD=mine.so",
        "hydra/job_logging=default",
        "+hydra.job_logging.handlers.console.filename=elsewhere",
        "hydra.job_logging.handlers.console.class=logging.FileHandler",
        "hydra.job_logging.handlers.console.stream=ext://antigravity.x",
        "+hydra.job_logging.formatters.simple.class=mine.Formatter",
        "+hydra.job_logging.formatters.simple.()=mine.formatter",
        "+hydra.hydra_logging.filters.a.()=mine.filter",
        "hydra/launcher=slurm +hydra.launcher.options.a._target_=os.getcwd",
        "++hydra.sweeper.a._target_=os.getcwd",
        "output_dir=null",
        "output_dir=[a,b]",
        "output_dir=''",
        "output_dir=3",
    ],
)
def test_hydra_is_asked_to_do_nothing_but_compose(override):
    with pytest.raises(ConfigError) as caught:
        with_hydra(*override.split(" "))
    assert "\n" not in str(caught.value)
    assert override.split("=")[0].split(" ")[-1].lstrip("+").split(".")[0].split("/")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        ("projectr=known", "key 'projectr' is not known; did you mean projector?"),
        ("projector=knwn", "did you mean known?"),
        ("+name=a=b", "quote what is special in it"),
        ("dry_run", "is no override; write group=choice or group.key=value"),
        ("sampler=[", "cannot be read as key=value"),
        ("seed=${nowhere}", "nowhere"),
        (
            "task={hrizon:1}",
            "task does not take this value; choose a preset, task=name, or set parameters, task.name=value",
        ),
        ("seed=1,2", "seed=1,2 may be a sweep or a list; write -m to sweep over it, or 'seed=[1,2]'"),
        ("training.steps=1,2", "training.steps=1,2 may be a sweep or a list"),
        ("+sweeps=lqr_quick training.steps=1,2 projectr=known", "key 'projectr' is not known; did you mean projector?"),
    ],
)
def test_mistakes_that_hydra_finds_are_told_in_one_line(mistake, told):
    with pytest.raises(ConfigError) as caught:
        composed(*mistake.split(" "))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["seed=range(0,100000)"], "100,000 runs"),
        (["seed=range(0,1000000000000)", "projector=none,known"], "2,000,000,000,000 runs"),
        (["seed=range(5,1)"], "seed: ranges over nothing"),
        (["seed=range(0,5,0)"], "seed: ranges over nothing"),
        (["output_dir=a,b"], "output_dir: the runs of a sweep share one output folder"),
    ],
)
def test_the_cells_of_a_sweep_are_counted_before_they_are_made(given, told):
    config = with_hydra()
    with pytest.raises(ConfigError, match=told):
        guard.check_sweep(config, given)


def test_variables_of_the_trusting_process_reach_its_jobs(monkeypatch):
    monkeypatch.setenv(VARIABLE, "a, b,,a")
    trust(["c"])
    assert os.environ[VARIABLE] == "a,b,c"


@pytest.mark.parametrize("given", [["--resolve"], ["--experimental-rerun", "x"]])
def test_options_that_mean_nothing_here_are_told_in_a_line(given):
    with pytest.raises(ConfigError, match=rf"^{given[0]}: "):
        check_what_is_printed(given)

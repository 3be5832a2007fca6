"""Laws of the plain Python interface: it does what the command line does, and its top level stays light."""

from __future__ import annotations

import subprocess
import sys

import pytest

import dadiff
from dadiff.errors import ConfigError, StoreError

SMALL = [
    "denoiser=gaussian",
    "sampler=ddim",
    "sampler.num_steps=5",
    "dataset.train_size=20",
    "dataset.test_size=2",
    "evaluation.samples=1",
    "tracking.enabled=false",
    "progress=false",
]


def test_runs_of_one_process_are_rows_of_one_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known, vanilla = dadiff.run(SMALL), dadiff.run([*SMALL, "projector=none"])
    again = dadiff.run(SMALL)
    assert again.record == known.record
    table = dadiff.results("outputs").set_index("key")
    assert list(table.projector[[known.key, vanilla.key]]) == ["known", "none"]
    assert table.gap[known.key] == known.metrics["gap"]
    assert {"name", "status", "cases", "seconds", "folder"} <= set(table.columns)


def test_what_is_refused_is_one_line():
    with pytest.raises(ConfigError, match=r"^[^\n]*[Dd]id you mean[^\n]*$"):
        dadiff.run([*SMALL, "projector.initial_sate=fixed"])
    with pytest.raises(ConfigError, match="dry run"):
        dadiff.run([*SMALL, "dry_run=true"])
    with pytest.raises(StoreError, match="nowhere: there is no such folder"):
        dadiff.results("nowhere")


def test_the_top_level_is_light_and_knows_its_names():
    code = "import sys, dadiff; dir(dadiff); sys.exit(bool({'torch', 'hydra', 'pandas', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert {"run", "results", "Planner"} <= set(dir(dadiff))
    with pytest.raises(AttributeError, match="nonesuch"):
        _ = dadiff.nonesuch

"""A sweep that comes back from MLflow gives the numbers of the results folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up import MadeUp

from dadiff.reporting import cli
from dadiff.sync import sync

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tracked(tmp_path_factory) -> tuple[Path, str]:
    """A results folder, and the MLflow store that mirrors it."""
    folder = tmp_path_factory.mktemp("outputs")
    store = MadeUp(folder)
    store.run(1.0)
    store.run(0.2, projector="known", enforcement="normalised")
    store.run(status="diverged", step=3, projector="known", enforcement="literal")
    store.sweep()
    sync(folder)
    return folder, f"sqlite:///{folder}/mlflow.db"


@pytest.mark.parametrize("name", ["lqr_made_up", "dadiff"])
def test_parent_run_and_experiment(tracked, name, tmp_path):
    folder, uri = tracked
    common = ["--definition", "default", "--out"]
    assert cli.main(["lqr_made_up", "--output-dir", str(folder), *common, str(tmp_path / "disk")]) == 0
    assert cli.main([name, "--tracking-uri", uri, *common, str(tmp_path / "mlflow")]) == 0
    disk, mlflow = (json.loads((tmp_path / part / "report.json").read_text()) for part in ("disk", "mlflow"))
    rows = [
        {row["label"]: row["values"] for row in part["tables"]["summary"]["content"]["rows"]} for part in (disk, mlflow)
    ]
    assert rows[0] == rows[1]
    assert {cell["outcome"] for cell in mlflow["cells"]} == {"finished", "diverged at step 3"}


def test_the_report_links_to_the_runs(tracked, tmp_path):
    folder, _ = tracked
    assert cli.main(["lqr_made_up", "--output-dir", str(folder), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "index.html").read_text().count("http://127.0.0.1:5000/#/experiments/1/runs/") == 3


def test_an_unknown_name(tracked, capsys):
    assert cli.main(["nonesuch", "--tracking-uri", tracked[1]]) == 1
    assert "no sweep and no experiment 'nonesuch' with runs" in capsys.readouterr().err

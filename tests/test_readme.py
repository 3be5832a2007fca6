"""Every command and every example of the README and of docs/ runs."""

import csv
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from dadiff.errors import ConfigError
from dadiff.reporting import cli as reporting
from dadiff.reporting import publishing
from dadiff.reporting.claims import read_ledger
from dadiff.reporting.definitions import FOLDER

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path.relative_to(ROOT).as_posix(): path.read_text() for path in DOCUMENTS}
SMALL = ["dataset.train_size=40", "dataset.test_size=2", "evaluation.samples=1", "schedule.num_steps=30"]
SMALL += ["training.steps=3", "training.warmup=0", "progress=false"]


def blocks(language: str, text: str) -> list[str]:
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", block, flags=re.MULTILINE) for indent, block in found]


LINES = [line.split("#")[0] for text in TEXTS.values() for block in blocks("sh", text) for line in block.splitlines()]
COMMANDS = [shlex.split(line)[1:] for line in dict.fromkeys(LINES) if line.startswith("dadiff ")]
EXAMPLES = [
    pytest.param(block, id=f"{name}-{block.splitlines()[2]}")
    for name, text in TEXTS.items()
    for block in blocks("python", text)
    if not block.startswith("# my")
]


def dadiff(arguments: list[str], folder: Path) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-m", "dadiff", *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=250, check=False
    )


def write_models(folder: Path) -> None:
    """The models of the documents, verbatim, under the names in their first lines."""
    for block in [block for text in TEXTS.values() for block in blocks("xml", text)]:
        (folder / re.match(r"<!-- (\w+\.xml) -->", block)[1]).write_text(block)


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_commands_run(arguments, tmp_path):
    if any("mujoco" in argument for argument in arguments):
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    small = [] if "dry_run=true" in arguments else SMALL
    done = dadiff([*arguments, *small], tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search("conditional|normalised", done.stdout + done.stderr)


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_run(example, tmp_path, monkeypatch):
    if "mujoco" in example:
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    monkeypatch.chdir(tmp_path)
    write_models(tmp_path)
    small = ", ".join(f'"{override}"' for override in [*SMALL, "tracking.enabled=false"])
    exec(compile(example.replace('"training=quick"]', f'"training=quick", {small}]'), "example", "exec"), {})


OWN = [
    shlex.split(line)[1:]
    for text in TEXTS.values()
    for line in re.findall(r"`(dadiff [^`]*components=\[mylab\][^`]*)`", text)
]


def write_own_files(folder: Path) -> None:
    """The own components of the documents, verbatim, where their first lines say."""
    for block in [block for text in TEXTS.values() for kind in ("python", "yaml") for block in blocks(kind, text)]:
        if path := re.match(r"# (my[\w/.]+)\n", block):
            (folder / path[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / path[1]).write_text(block)


def test_own_components_run_as_written_from_an_empty_folder(tmp_path):
    write_own_files(tmp_path)
    assert len(OWN) >= 2
    for arguments in OWN:
        done = dadiff([*arguments, "denoiser=gaussian", "tracking.enabled=false", *SMALL], tmp_path)
        assert done.returncode == 0, done.stderr
    assert "lqr/damped/conditional/gaussian" in done.stderr
    refused = dadiff(["--config-dir", "myconf", "projector=damped"], tmp_path)
    assert refused.returncode == 1
    assert "components=[mylab]" in refused.stderr


OWN_RIVAL = """
from dataclasses import dataclass

from dadiff.diffusion.enforcement import Never


@dataclass(frozen=True)
class Mine(Never):
    def clean(self, tau0_hat, at):
        return (tau0_hat + at.project(tau0_hat)) / 2
"""


@pytest.mark.slow
def test_a_method_comes_onto_the_benches_as_contributing_says(tmp_path, monkeypatch, capsys):
    for name, text in {"mylab/mine.py": OWN_RIVAL, "myconf/enforcement/mine.yaml": "_target_: mylab.mine.Mine"}.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text)
    lines = [line.strip() for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines()]
    sweeps = [shlex.split(line)[1:] for line in lines if line.startswith("dadiff ") and "enforcement=mine" in line]
    (report,) = (shlex.split(line)[1:] for line in lines if line.startswith("dadiff-report rivals_mine"))
    few = [[], [f"task.{group}=2" for group in ("robots", "interpolation", "extrapolation")]]
    for arguments, less in zip(sweeps, few, strict=True):
        done = dadiff(["--config-dir", "myconf", *arguments, "components=[mylab]", *SMALL, *less], tmp_path)
        assert done.returncode == 0, done.stderr
    monkeypatch.chdir(tmp_path)
    assert reporting.main(report) == 0, capsys.readouterr().err
    (table,) = tmp_path.glob("outputs/reports/*/tables/by_cost.csv")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == 2
    assert all(float(row["exact_distance_mean"]) > 0 for row in rows)


def test_what_documents_say_of_published_reports_is_what_these_say():
    root, claims = ROOT / "reports" / "published", read_ledger(FOLDER / "claims.yaml")
    assert publishing.documents(root) == DOCUMENTS
    for path in DOCUMENTS:
        assert path.read_text() == publishing.fill(path, root, claims)
    assert all(
        f"<!-- {kind}" in "".join(TEXTS.values())
        for kind in ("figure: ", "sentences: ", "ledger: short", "ledger: all", "bench: beside", "bench: alone")
    )


def test_a_block_of_unknown_kind_is_named(tmp_path):
    document = tmp_path / "README.md"
    document.write_text("<!-- table: all -->\n<!-- end -->\n")
    with pytest.raises(ConfigError, match="unknown kind 'table'; expected figure, sentences, ledger, bench"):
        publishing.fill(document, tmp_path / "reports" / "published", [])


def test_the_readme_is_short():
    assert len(TEXTS["README.md"].splitlines()) <= 150


def test_what_is_published_is_whole_small_and_knows_no_place():
    folder = ROOT / "reports" / "published"
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 8e6
    for name in (path.name for path in folder.iterdir() if path.is_dir()):
        parts = {path.name for path in (folder / name).iterdir()}
        assert {"README.md", "report.json", "configurations.yaml", "figures", "tables"} <= parts
        assert f"`{name}`" in TEXTS["docs/results.md"]
    for path in files:
        assert not re.search(r"(?<![\w.])/(tmp|home|root|work)/", path.read_text())


def test_an_own_figure_is_drawn_as_written(tmp_path, monkeypatch, capsys):
    write_own_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DADIFF_COMPONENTS", "")
    (said,) = re.findall(r"`dadiff-report lqr_quick (--definition \S+) --components mylab`", TEXTS["docs/extending.md"])
    store = str(ROOT / "tests" / "data" / "store")
    command = ["lqr_made_up", *said.split(), "--output-dir", store, "--out", "out"]
    assert reporting.main(command) == 1
    assert "trust it with --components mylab" in capsys.readouterr().err
    assert reporting.main([*command, "--components", "mylab"]) == 0
    assert (tmp_path / "out" / "figures" / "best.svg").is_file()
    assert json.loads((tmp_path / "out" / "report.json").read_text())["figures"]["best"]["content"]["lowest"]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_and_pictures_are_there(document):
    for target in re.findall(r"\]\(((?!https?:)[^)#]+)", document.read_text()):
        assert (document.parent / target).exists()

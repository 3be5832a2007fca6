"""Every command and every example of the README runs."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from dadiff.reporting import published
from dadiff.reporting.claims import read_ledger
from dadiff.reporting.definitions import FOLDER

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
SMALL = ["dataset.train_size=40", "dataset.test_size=2", "evaluation.samples=1", "schedule.num_steps=30"]
SMALL += ["training.steps=3", "training.warmup=0", "progress=false"]


def blocks(language: str) -> list[str]:
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", README, flags=re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


COMMANDS = [line.split("#")[0].split()[1:] for line in "".join(blocks("sh")).splitlines() if line.startswith("dadiff")]
EXAMPLES = [block for block in blocks("python") if "class " not in block]


def dadiff(arguments: list[str], folder: Path) -> subprocess.CompletedProcess:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-m", "dadiff", *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=250, check=False
    )


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_commands_run(arguments, tmp_path):
    small = [] if "dry_run=true" in arguments else SMALL
    done = dadiff([*arguments, *small], tmp_path)
    assert done.returncode == 0, done.stderr
    assert "normalised" in done.stdout + done.stderr


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: text.splitlines()[2])
def test_examples_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ", ".join(f'"{override}"' for override in [*SMALL, "tracking.enabled=false"])
    exec(compile(example.replace('"training=quick"]', f'"training=quick", {small}]'), "README.md", "exec"), {})


OWN = [shlex.split(line)[1:] for line in re.findall(r"`(dadiff [^`]*components=\[mylab\][^`]*)`", README)]


def write_own_files(folder: Path) -> None:
    """The README's own components, verbatim, where their first lines say."""
    for block in [*blocks("python"), *blocks("yaml")]:
        if path := re.match(r"# (my[\w/.]+)\n", block):
            (folder / path[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / path[1]).write_text(block)


def test_own_components_run_as_written_from_an_empty_folder(tmp_path):
    write_own_files(tmp_path)
    assert len(OWN) == 2
    for arguments in OWN:
        done = dadiff([*arguments, "denoiser=gaussian", "tracking.enabled=false", *SMALL], tmp_path)
        assert done.returncode == 0, done.stderr
    assert "lqr/damped/normalised/gaussian" in done.stderr
    refused = dadiff(["--config-dir", "myconf", "projector=damped"], tmp_path)
    assert refused.returncode == 1
    assert "components=[mylab]" in refused.stderr


def test_the_table_of_verdicts_is_that_of_the_published_reports():
    pattern = r"^\| (.*?) \| (.*?) \| (.*?) \| \[`?(\w+)`?\]\(reports/published/(\w+)\) \|$"
    rows = re.findall(pattern, README, flags=re.MULTILINE)
    said = published.verdicts(ROOT / "reports" / "published", read_ledger(FOLDER / "claims.yaml"))
    assert rows == [(line.claim.claim, line.verdict, line.effect_words, name, name) for name, line in said]


def test_what_is_published_is_whole_small_and_knows_no_place():
    folder = ROOT / "reports" / "published"
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 8e6
    for name in (path.name for path in folder.iterdir() if path.is_dir()):
        parts = {path.name for path in (folder / name).iterdir()}
        assert {"README.md", "report.json", "configurations.yaml", "figures", "tables"} <= parts
        assert f"`{name}`" in README
    for path in files:
        assert not re.search(r"(?<![\w.])/(tmp|home|root|work)/", path.read_text())


def test_pictures_of_the_readme_are_there():
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", README):
        assert (ROOT / picture).is_file()

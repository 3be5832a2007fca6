"""The wheel holds all that a run needs: it works from an empty folder, with nothing of the checkout in reach."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_readme import OWN, SMALL, write_own_files

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_an_installed_wheel_runs_from_an_empty_folder(tmp_path):
    wheels, site, empty = tmp_path / "wheels", tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", wheels, ROOT], check=True)
    subprocess.run([*pip, "install", "--no-deps", "--target", site, next(wheels.glob("*.whl"))], check=True)
    environment = os.environ | {"PYTHONPATH": str(site), "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "dadiff", "denoiser=gaussian", "dataset.test_size=2", "evaluation.samples=1"]
    done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (empty / "outputs/mlflow.db").is_file()
    write_own_files(empty)
    for arguments in OWN:
        own = [sys.executable, "-m", "dadiff", *arguments, "denoiser=gaussian", *SMALL]
        done = subprocess.run(own, cwd=empty, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    code = "import dadiff; print(dadiff.run(['denoiser=gaussian', 'dataset.test_size=2']), dadiff.results().gap)"
    subprocess.run([sys.executable, "-c", code], cwd=empty, env=environment, check=True)
    where = [sys.executable, "-c", "import dadiff; print(dadiff.__file__)"]
    assert str(site) in subprocess.run(where, cwd=empty, env=environment, capture_output=True, text=True).stdout

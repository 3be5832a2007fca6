"""Writes what the LQR report of the committed store must say: `python tests/data/make_expected.py`."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path

from dadiff.reporting import cli

HERE = Path(__file__).parent

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(HERE):
        cli.main(["lqr_made_up", "--output-dir", "store", "--out", folder])
        (HERE / "expected").mkdir(exist_ok=True)
        shutil.copy(Path(folder) / "report.json", HERE / "expected" / "lqr_made_up.json")

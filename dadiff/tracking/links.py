"""Where stored runs are found in MLflow's pages, read from the database beside them; nothing is asked or changed."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

LOCAL_UI = "http://127.0.0.1:5000"
"""Where `mlflow ui` answers."""

RUNS = """
SELECT tags.value, runs.experiment_id, runs.run_uuid FROM runs JOIN tags ON tags.run_uuid = runs.run_uuid
WHERE tags.key = 'key' AND runs.lifecycle_stage = 'active'
"""


def pages(output_dir: Path) -> dict[str, str]:
    """Key of a run -> its page in the UI that is opened on the folder's own database; empty if there is none."""
    path = output_dir.absolute() / "mlflow.db"
    if not path.is_file():
        return {}
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as connection:
            found = connection.execute(RUNS).fetchall()
    except sqlite3.Error:
        return {}  # a mirror that is damaged is told of, and made again, when it is next written to
    return {key: f"{LOCAL_UI}/#/experiments/{experiment}/runs/{run}" for key, experiment, run in found}

"""Installs what is named into the environment that runs this, at the versions of constraints.txt.

    .venv/bin/python tools/install.py '.[test,lint]'

With uv, which needs a sixth of pip's time: the one on the path, else one from the package index. uv does not read pip's
configuration, so that where packages come from is told to it here, and pip is asked which of torch's builds it would
take, since the two choose otherwise among builds of one version. Where uv cannot be had or cannot do it, pip does.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

CONSTRAINTS = ["-c", "constraints.txt"]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
SAME = {  # a setting of pip -> the variable that says the same to uv, and what stands between several values there
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "default-timeout": ("UV_HTTP_TIMEOUT", " "),
}
FIXED = {"UV_INDEX_STRATEGY": "unsafe-best-match"}  # the best version of all indexes, as with pip


def main(what: list[str]) -> int:
    """Install; returns the exit code."""
    uv = find_uv()
    if uv is not None:
        settings = pip_settings(subprocess.run([*PIP, "config", "list"], capture_output=True, text=True).stdout)
        wanted = [*constraints(settings), *torch_build(), *editable(what)]
        command = [uv, "pip", "install", "--quiet", "--python", sys.executable, *wanted]
        if subprocess.run(command, env=variables(settings) | os.environ).returncode == 0:
            return 0
    sys.stderr.write("uv could not install it: pip does, which takes longer\n" if uv else "no uv: pip takes longer\n")
    return subprocess.run([*PIP, "install", *CONSTRAINTS, *editable(what)]).returncode


def find_uv() -> str | None:
    """The program uv: on the path, in this environment, or installed into it now; None where it cannot be had."""
    own = Path(sys.executable).with_name("uv")
    found = shutil.which("uv") or shutil.which(own)
    if found is None:
        subprocess.run([*PIP, "install", *CONSTRAINTS, "uv"], stderr=subprocess.DEVNULL)
        found = shutil.which(own)
    return found


def torch_build() -> list[str]:
    """The file that pip would install torch from, as a requirement; nothing where torch is installed already."""
    command = [*PIP, "install", "--dry-run", "--no-deps", "--report", "-", *CONSTRAINTS, "torch"]
    asked = subprocess.run(command, capture_output=True, text=True)
    installs = json.loads(asked.stdout)["install"] if asked.returncode == 0 else []
    return [f"torch @ {item['download_info']['url']}" for item in installs]


def pip_settings(listed: str) -> dict[str, str]:
    """What `pip config list` says that holds for `pip install`: name -> value."""
    found: dict[str, dict[str, str]] = {}
    for line in listed.splitlines():
        where, _, value = line.partition("=")
        section, _, name = where.rpartition(".")
        found.setdefault(section, {})[name] = ast.literal_eval(value)
    return {**found.get("global", {}), **found.get("install", {}), **found.get(":env:", {})}


def variables(settings: Mapping[str, str]) -> dict[str, str]:
    """The environment that tells uv where pip's packages come from."""
    said = {name: settings[name].split() for name in SAME if name in settings}
    told = {SAME[name][0]: SAME[name][1].join(values) for name, values in said.items()}
    return told | FIXED | ({"UV_NO_INDEX": "1"} if settings.get("no-index") in ("1", "true", "yes", "on") else {})


def constraints(settings: Mapping[str, str]) -> list[str]:
    """Arguments for the project's constraints, and for those of pip's configuration."""
    return [*CONSTRAINTS, *(part for file in settings.get("constraint", "").split() for part in ("-c", file))]


def editable(what: list[str]) -> list[str]:
    """The project itself is installed in place."""
    return [part for name in what for part in (["-e", name] if name.startswith(".") else [name])]


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

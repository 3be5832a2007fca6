"""What the installer tells uv of pip's configuration, so that both take the same packages from the same places."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

TOOL = Path(__file__).parent.parent / "tools" / "install.py"
LISTED = """\
:env:.find-links='/here/wheels'
:env:.default-timeout='180'
global.cert='/etc/certificates.crt'
global.constraint='/a.txt /b.txt'
global.extra-index-url='file:///one/simple file:///two/simple'
global.find-links='/elsewhere'
install.index-url='https://example.org/simple'
freeze.timeout='10'
"""


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("install", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_environment_stands_above_the_command_and_that_above_what_is_global(tool):
    settings = tool.pip_settings(LISTED)
    assert settings["find-links"] == "/here/wheels"
    assert settings["index-url"] == "https://example.org/simple"
    assert "timeout" not in settings


def test_uv_is_told_where_packages_come_from(tool):
    assert tool.variables(tool.pip_settings(LISTED)) == {
        "UV_DEFAULT_INDEX": "https://example.org/simple",
        "UV_INDEX": "file:///one/simple file:///two/simple",
        "UV_FIND_LINKS": "/here/wheels",
        "UV_HTTP_TIMEOUT": "180",
        "SSL_CERT_FILE": "/etc/certificates.crt",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
    }
    assert tool.variables({"no-index": "true"})["UV_NO_INDEX"] == "1"
    assert tool.variables({}) == tool.FIXED


def test_the_projects_constraints_come_first_and_pips_own_are_kept(tool):
    found = tool.constraints(tool.pip_settings(LISTED))
    assert found == ["-c", "constraints.txt", "-c", "/a.txt", "-c", "/b.txt"]
    assert tool.constraints({}) == ["-c", "constraints.txt"]


def test_the_project_is_installed_in_place_and_others_are_not(tool):
    assert tool.editable([".[test]", "uv"]) == ["-e", ".[test]", "uv"]


def test_uv_is_pinned_as_everything_is():
    assert any(line.startswith("uv==") for line in (TOOL.parent.parent / "constraints.txt").read_text().splitlines())

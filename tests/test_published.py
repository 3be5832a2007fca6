"""Published reports are pages made from their numbers, of this format and the one before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dadiff.errors import StoreError
from dadiff.reporting import cli, published, story
from dadiff.reporting.claims import read_ledger
from dadiff.reporting.definitions import FOLDER
from dadiff.reporting.render import PANEL, with_panel

ROOT = FOLDER / "published"
STORE = Path(__file__).parent / "data" / "store"
CLAIMS = read_ledger(FOLDER / "claims.yaml")


@pytest.mark.parametrize("folder", published.folders(ROOT), ids=lambda path: path.name)
def test_the_page_of_a_published_report_is_that_of_its_numbers(folder):
    assert (folder / "README.md").read_text() == published.page(folder, CLAIMS)


def test_the_index_is_that_of_the_reports():
    text = (ROOT / "README.md").read_text()
    assert text == published.index(ROOT, CLAIMS)
    for folder in published.folders(ROOT):
        assert f"[{folder.name}]({folder.name}/README.md)" in text


def test_all_of_it_stays_small():
    assert sum(path.stat().st_size for path in ROOT.rglob("*") if path.is_file()) < 8e6


def test_what_is_published_says_what_the_report_says(fresh, tmp_path):
    whole = published.read(fresh.parent.parent / "out")
    found = published.read(fresh)
    sizes = [(folder / "report.json").stat().st_size for folder in (fresh, fresh.parent.parent / "out")]
    assert sizes[0] < 0.75 * sizes[1]
    assert found["cells"][0].keys() == {"key", "status"}
    assert published.page(fresh, CLAIMS) == published.page(_with_commands_of(whole, found, fresh, tmp_path), CLAIMS)
    for here, there in zip(found["tables"].values(), whole["tables"].values(), strict=True):
        rows = zip(here["content"]["rows"], there["content"]["rows"], strict=True)
        assert all(row["runs"] == other["runs"] and row["label"] == other["label"] for row, other in rows)
    lines, others = (story.ledger(content, CLAIMS) for content in (found, whole))
    assert lines == others


def _with_commands_of(whole: dict, found: dict, fresh: Path, folder: Path) -> Path:
    """A folder with the unpacked report, and links to the figures."""
    (folder / "report.json").write_text(json.dumps({**whole, "commands": found["commands"]}))
    (folder / "figures").symlink_to(fresh / "figures")
    return folder


def test_figures_carry_their_own_panel():
    drawings = list(ROOT.glob("*/figures/*.svg"))
    assert drawings
    for path in drawings:
        content = path.read_bytes()
        assert content.count(PANEL) == 1
        assert with_panel(content) == content


@pytest.fixture(scope="module")
def fresh(tmp_path_factory) -> Path:
    """A report of today's format, published."""
    out = tmp_path_factory.mktemp("report")
    command = ["lqr_made_up", "--output-dir", str(STORE), "--out", str(out / "out")]
    assert cli.main([*command, "--publish", str(out / "published" / "lqr_made_up")]) == 0
    return out / "published" / "lqr_made_up"


def test_publishing_writes_the_page_and_the_index(fresh):
    page = (fresh / "README.md").read_text()
    assert page.startswith("# LQR with and without dynamics in the denoising\n")
    assert "output_dir=" not in page
    assert "--output-dir" not in page
    assert "![State and control error along the horizon](figures/errors.svg)" in page
    assert "lqr_made_up" in (fresh.parent / "README.md").read_text()


def test_elsewhere_no_index_is_written(tmp_path):
    command = ["lqr_made_up", "--output-dir", str(STORE), "--out", str(tmp_path / "out")]
    assert cli.main([*command, "--publish", str(tmp_path / "mine")]) == 0
    assert (tmp_path / "mine" / "README.md").is_file()
    assert not (tmp_path / "README.md").exists()


def test_the_sentences_come_from_the_numbers(fresh):
    content = published.read(fresh)
    helps, harms, claims = story.sentences(content, story.ledger(content, CLAIMS))
    rows = content["tables"]["summary"]["content"]["rows"]
    ratios = {row["label"]: story.ratio_of(row, "planned_state_error") for row in rows}
    below = {label: ratio for label, ratio in ratios.items() if ratio and ratio.high < 1}
    lowest = min(below, key=lambda label: below[label].value)
    assert helps.startswith(f"Helps: {len(below)} of ")
    assert f"the lowest with {lowest}: {story.number(below[lowest].value)} [" in helps
    assert "gave no result" in harms
    assert claims.startswith("Of ")


def test_a_line_has_the_counts_and_effects_of_its_findings(fresh):
    lines = {line.claim.id: line for line in story.ledger(published.read(fresh), CLAIMS)}
    line = lines["fig2_significantly"]
    assert line.verdict == "holds only if mlp (2 of 3)"
    assert line.counts == {"so": 2, "open": 0, "not": 1}
    assert len(line.points) == 3
    assert line.bound == 0.5
    assert line.effect_words.endswith("over 3")
    assert line.unit == "state error ‖x(t) − x*(t)‖² over that of vanilla"


def test_reports_of_the_older_format_are_judged_by_their_stored_intervals():
    content = published.read(ROOT / "hankel_length")
    assert content["format"] == 1
    lines = {line.claim.id: line for line in story.ledger(content, CLAIMS)}
    assert lines["longer_recording"].verdict == "holds for 4 of 4"
    assert any("the projector is the identity" in detail for detail in lines["longer_recording"].details)
    assert lines["known_beats_unknown"].counts["not"] == 0
    assert lines["known_beats_unknown_slightly"].word == "does not hold"
    assert all(line.older for line in lines.values())


def test_cells_of_tables_keep_their_bars():
    assert published.markdown(["a|b"], [["c\nd"]]) == "| a\\|b |\n| --- |\n| c d |"


def test_a_folder_without_a_report_is_named(tmp_path):
    with pytest.raises(StoreError, match=r"holds no report\.json"):
        published.read(tmp_path)

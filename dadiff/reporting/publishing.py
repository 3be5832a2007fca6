"""Writes what is made from published reports and the kept bench: pages, their index, parts of the README and of docs/.

    python -m dadiff.reporting.publishing reports/published

Parts of documents stand between marks that name them:

    <!-- figure: fleet/cost -->    a figure of a published report, and what it found
    <!-- sentences: paper_lqr -->  what a published report found, in its three sentences
    <!-- ledger: short -->         one verdict a claim, of the claims that have a short name
    <!-- ledger: all -->           the same of all claims, with exceptions and effects in full
    <!-- bench: beside -->         how long one plan takes beside what else plans, from docs/bench.json
    <!-- bench: alone -->          what the same bench found that is compared with nothing
    <!-- end -->
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dadiff.errors import ConfigError
from dadiff.reporting import published, story
from dadiff.reporting.claims import Claim, read_ledger
from dadiff.reporting.definitions import FOLDER
from dadiff.reporting.labels import with_interval
from dadiff.reporting.story import Line

BLOCK = re.compile(r"(<!-- (\w+): ([\w/]+) -->\n).*?(?=<!-- end -->)", flags=re.DOTALL)


def write_pages(root: Path) -> list[Path]:
    """Write `README.md` of every published report and of the folder that holds them, and what documents say of them."""
    claims = read_ledger(FOLDER / "claims.yaml")
    pages = {folder / "README.md": published.page(folder, claims) for folder in published.folders(root)}
    pages[root / "README.md"] = published.index(root, claims)
    for path, text in pages.items():
        path.write_text(text, "utf-8")
    return [*pages, *fill_documents(root)]


def fill_documents(root: Path) -> list[Path]:
    """Write the README and the docs anew, with their blocks as `fill` makes them."""
    claims, found = read_ledger(FOLDER / "claims.yaml"), documents(root)
    for path in found:
        path.write_text(fill(path, root, claims), "utf-8")
    return found


def fill(document: Path, root: Path, claims: list[Claim]) -> str:
    """The text of a document with its blocks made from the reports that are published in `root`.

    Raises:
        ConfigError: if a block is of no kind that there is.
    """

    def made(found: re.Match[str]) -> str:
        if found[2] not in KINDS:
            raise ConfigError(f"{document}: a block of unknown kind {found[2]!r}; expected {', '.join(KINDS)}")
        return found[1] + KINDS[found[2]](found[3], root, claims, _prefix(document, root)) + "\n"

    return BLOCK.sub(made, document.read_text("utf-8"))


def documents(root: Path) -> list[Path]:
    """The README and the docs of the repository that holds the published reports, where they lie there."""
    top = root.absolute().parent.parent
    return [path for path in (top / "README.md", *sorted((top / "docs").glob("*.md"))) if path.is_file()]


def _prefix(document: Path, root: Path) -> str:
    up = len(document.absolute().parent.relative_to(root.absolute().parent.parent).parts)
    return "../" * up + "reports/published"


def _figure(which: str, root: Path, claims: list[Claim], prefix: str) -> str:
    name, _, figure = which.partition("/")
    part = published.read(root / name)["figures"][figure]
    return f"![{part.get('found') or part['title']}]({prefix}/{name}/figures/{figure}.svg)"


def _sentences(name: str, root: Path, claims: list[Claim], prefix: str) -> str:
    content = published.read(root / name)
    said = story.sentences(content, story.ledger(content, claims))
    return "\n".join(
        [*(f"- {sentence}" for sentence in said), "", f"All of it: [`{name}`]({prefix}/{name}/README.md)."]
    )


def _ledger(which: str, root: Path, claims: list[Claim], prefix: str) -> str:
    short = {claim.id: claim.short for claim in claims if claim.short}
    said = published.verdicts(root, claims)
    if which == "short":
        rows = [
            [short[line.claim.id], *_short(line), _link(name, prefix)] for name, line in said if line.claim.id in short
        ]
        return published.markdown(["claim", "verdict", "effect", "report"], rows)
    rows = [[line.claim.claim, line.verdict, _effect(line), _link(name, prefix)] for name, line in said]
    return published.markdown(["claim", "verdict", "effect", "report"], rows)


def _bench(which: str, root: Path, claims: list[Claim], prefix: str) -> str:
    rows = json.loads((root.absolute().parent.parent / "docs" / "bench.json").read_text("utf-8"))["rows"]
    if which == "alone":
        return published.markdown(["what", "takes"], [[r["name"], _amount(r)] for r in rows if r["other"] is None])
    plans = [row for row in rows if row["name"].startswith("one plan") and "processor time" in row["name"]]
    told = [[r["name"].replace(", processor time", ""), f"{1 / r['ratio']:.2g}", r["against"]] for r in plans]
    return published.markdown(["a planner", "times as long", "as"], told)


def _amount(row: Mapping[str, Any]) -> str:
    return f"{row['value']:.3g} {row['unit']}"


def _link(name: str, prefix: str) -> str:
    return f"[`{name}`]({prefix}/{name}/README.md)"


def _effect(line: Line) -> str:
    return f"{line.effect_words} ({line.unit})" if line.effect_words else ""


def _short(line: Line) -> list[str]:
    """The verdict with its count, and the effect of the method in the middle."""
    so, methods = line.counts["so"], sum(line.counts.values())
    verdict = f"{line.word}: {so} of {methods}" if methods > 1 else line.word
    effect = "" if line.effect is None else with_interval(line.effect.value, line.effect.low, line.effect.high)
    return [verdict, f"{effect} {_plain(line.unit)}".strip() if effect else ""]


def _plain(unit: str) -> str:
    """A unit without its formula."""
    return re.sub(r" ‖.*?‖²", "", unit)


KINDS: dict[str, Callable[[str, Path, list[Claim], str], str]] = {
    "figure": _figure,
    "sentences": _sentences,
    "ledger": _ledger,
    "bench": _bench,
}


if __name__ == "__main__":
    for path in write_pages(Path(sys.argv[1])):
        sys.stdout.write(f"{path}\n")

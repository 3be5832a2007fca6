"""Published reports as pages that a code host shows: `README.md` of each folder, and an index of all.

A published folder holds `report.json`, of this format or the one before, and `configurations.yaml`, `figures/*.svg`,
`tables/*.csv`. The pages are made from `report.json` alone, so that they can be written again at any time, which
`dadiff.reporting.publishing` does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dadiff.errors import StoreError
from dadiff.outside import json_of
from dadiff.reporting import slim
from dadiff.reporting.claims import Claim
from dadiff.reporting.definitions import load, names
from dadiff.reporting.labels import column_name, column_value
from dadiff.reporting.story import Line, ledger, main_columns, main_table, ratio_of, sentences

FORMAT = 2
"""Of report.json: 2 has the verdicts' words, counts and effects; 1 had intervals from a bootstrap."""

OLDER = "Its intervals are those of an earlier version: a bootstrap, widened for few seeds."


def read(folder: Path) -> dict[str, Any]:
    """The content of a published report.

    Raises:
        StoreError: if there is none, or it is of a newer version.
    """
    path = folder / "report.json"
    if not path.is_file():
        raise StoreError(f"{folder}: holds no report.json; publish a report there with dadiff-report --publish")
    content: dict[str, Any] = json_of(path)
    if not isinstance(content, dict) or not isinstance(content.get("format"), int):
        raise StoreError(f"{path}: is no report of dadiff, or damaged; write it again with dadiff-report")
    if content["format"] > FORMAT:
        raise StoreError(f"{path}: has format {content['format']}, this version reads up to {FORMAT}; update dadiff")
    return slim.unpacked(content)


def folders(root: Path) -> list[Path]:
    """The published reports, by name."""
    return sorted(path.parent for path in root.glob("*/report.json"))


def page(folder: Path, claims: list[Claim]) -> str:
    """One report: sentences, ledger, figures, one table, and how to make it again."""
    content = read(folder)
    lines = ledger(content, claims)
    parts = [
        f"# {title(content)}",
        _notice(content),
        *sentences(content, lines),
        _ledger(lines),
        *_figures(content, folder),
        _table(content),
        _again(content),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def title(content: Mapping[str, Any]) -> str:
    """The heading of a report's definition; the sweep's name where the definition is not among ours."""
    name = content["definition"]
    return load(name).title if name in names() else str(content["sweep"])


def _notice(content: Mapping[str, Any]) -> str:
    finished = sum(cell["status"] == "finished" for cell in content["cells"])
    words = [f"Sweep `{content['sweep']}`: {finished} of {len(content['cells'])} runs have a result."]
    words += ["A quick sweep, with a small network."] if quick(content) else []
    return " ".join([*words, "Brackets hold 95 % intervals.", *[OLDER] * (content["format"] == 1)])


def quick(content: Mapping[str, Any]) -> bool:
    """Whether a report is of a quick sweep."""
    return any(name.endswith("_quick") for name in content["sweep"].split("+"))


def _ledger(lines: list[Line]) -> str:
    tested = [line for line in lines if line.word != "not tested here"]
    rows = [
        [line.claim.claim, _paper(line.claim), line.verdict, line.effect_words and f"{line.effect_words} ({line.unit})"]
        for line in tested
    ]
    head = ["claim", "the paper", "verdict", "effect (method in the middle; range)"]
    return "## What the paper claims, and what these runs say\n\n" + markdown(head, rows) if rows else ""


def _paper(claim: Claim) -> str:
    return f"“{claim.paper}” ({claim.place})" if claim.paper else claim.place


def _figures(content: Mapping[str, Any], folder: Path) -> list[str]:
    parts = []
    for name, part in content["figures"].items():
        if (folder / "figures" / f"{name}.svg").is_file():
            heading = part.get("found") or part["title"]
            parts.append(f"## {heading}\n\n![{part['title']}](figures/{name}.svg)\n\n{part['facts']}")
    return parts


def _table(content: Mapping[str, Any]) -> str:
    found = main_table(content)
    if found is None:
        return ""
    name, part = found
    table, columns = part["content"], main_columns(part["content"])
    head = [
        "method",
        *(f"{column_name(metric)}{' × ' + table['baseline'] if ratio else ''}" for metric, ratio in columns),
    ]
    rows = [[row["label"], *_cells(row, columns)] for row in table["rows"]]
    usual = f"Names leave out what most have: {table['usual']}. " if table.get("usual") else ""
    csv = f"{usual}All numbers: [tables/{name}.csv](tables/{name}.csv)."
    return f"## {part['title']}\n\n{markdown(head, rows)}\n\n{csv}"


def _cells(row: Mapping[str, Any], columns: list[tuple[str, bool]]) -> list[str]:
    if not row["runs"]:
        return [row["outcome"], *[""] * (len(columns) - 1)]
    return [_cell(row, metric, ratio=ratio) for metric, ratio in columns]


def _cell(row: Mapping[str, Any], metric: str, *, ratio: bool) -> str:
    value = ratio_of(row, metric) if ratio else ratio_of(row, metric, "mean")
    return column_value("" if ratio else metric, value.value, value.low, value.high) if value else "–"


def _again(content: Mapping[str, Any]) -> str:
    commands = [command for command in content["commands"] if command]
    return "Again:\n\n" + "\n".join(f"    {command}" for command in commands)


def index(root: Path, claims: list[Claim]) -> str:
    """All published reports with their first sentence, the best of every leaderboard, and one verdict a claim: that of
    the report that weighs most."""
    contents = {folder.name: read(folder) for folder in folders(root)}
    rows = []
    for name, content in contents.items():
        said = sentences(content, ledger(content, claims))
        rows.append([f"[{name}]({name}/README.md)", title(content), said[0] if said else ""])
    head = ["report", "question", "what was found"]
    leaders = [[line.claim.claim, line.verdict, f"[{name}]({name}/README.md)"] for name, line in verdicts(root, claims)]
    return "\n\n".join(
        [
            "# Published reports",
            markdown(head, rows),
            *_leaderboards(contents),
            "## One verdict a claim",
            markdown(["claim", "verdict", "report"], leaders),
        ]
    ) + "\n"  # fmt: skip


LEADERS = 5


def _leaderboards(contents: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The first rows of main tables that rank their methods."""
    parts = []
    for name, content in contents.items():
        found = main_table(content)
        if found is None or "wins" not in found[1]["content"]["metrics"]:
            continue
        table = found[1]["content"]
        columns = main_columns(table)
        head = ["method", *(column_name(metric) for metric, _ in columns)]
        rows = [[row["label"], *_cells(row, columns)] for row in table["rows"][:LEADERS]]
        link = f"The first {len(rows)} of {len(table['rows'])} in [{name}]({name}/README.md)."
        parts += [f"## {found[1]['title']}: {name}", markdown(head, rows), link]
    return parts


def verdicts(root: Path, claims: list[Claim]) -> list[tuple[str, Line]]:
    """Each claim that a published report tested, with the report that says it for the project.

    That is the one at the paper's scale before a quick one, and of those the one with most methods.
    """
    judged = {folder.name: ledger(read(folder), claims) for folder in folders(root)}
    found = []
    for claim in claims:
        said = [(name, line) for name, lines in judged.items() for line in lines if line.claim.id == claim.id]
        tested = [(name, line) for name, line in said if line.word != "not tested here"]
        if tested:
            found.append(max(tested, key=lambda pair: (weight(pair[0]), len(pair[1].details))))
    return found


def weight(name: str) -> int:
    """Reports at the paper's scale weigh most, quick ones least."""
    return 2 if name.startswith("paper") else 0 if name.endswith("_quick") else 1


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table; bars and line ends inside of cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        "| " + " | ".join(re.sub(r"\s+", " ", cell).replace("|", "\\|") for cell in line) + " |" for line in lines
    )

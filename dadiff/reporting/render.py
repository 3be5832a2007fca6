"""Writes a report: index.html with figures inlined, tables as csv and tex, figures as files, report.json and
configurations.yaml.

The same report gives the same bytes: nothing says when it was written.
"""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from dadiff.errors import StoreError
from dadiff.reporting import configurations, drawings, published, publishing, slim, story
from dadiff.reporting.claims import Verdict, read_ledger
from dadiff.reporting.definitions import FOLDER
from dadiff.reporting.latex import to_latex
from dadiff.reporting.page import FORMS, draw_all, to_html, untagged
from dadiff.reporting.report import Part, Report
from dadiff.reporting.tables import to_csv
from dadiff.store.files import make_folder, strict

PUBLISHED = ("report.json", "configurations.yaml", "tables/*.csv", "figures/*.svg")


PLACE = re.compile(r" (?:[+]*output_dir=|--output-dir )\S+| progress=\w+")
"""Of a command, where its results lay and whether it showed its progress: a reader types it without."""


def render(report: Report, folder: Path) -> Path:
    """Write all files of a report; the path of its index.html. What an older report left there goes, nothing else.

    Raises:
        StoreError: if the folder cannot be written to.
    """
    for part in FORMS:
        make_folder(folder / part)
    older = _parts_in(folder)
    drawn = draw_all([part for part in report.figures if not part.empty])
    try:
        _write_tables(report, folder / "tables")
        for name, drawing in drawn.items():
            for form, content in drawing.files.items():
                whole = drawings.smaller(with_panel(untagged(content))) if form == "svg" else content
                (folder / "figures" / f"{name}.{form}").write_bytes(whole)
        shown = numbers(report)
        (folder / "report.json").write_text(slim.numbers(shown), "utf-8")
        (folder / "configurations.yaml").write_text(configurations.to_yaml(report.evidence.sweep), "utf-8")
        (folder / "index.html").write_text(to_html(report, shown, drawn), "utf-8")
        _remove(folder, older - _parts_in(folder))
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written ({error.strerror}); choose another --out") from None
    return folder / "index.html"


def publish(report: Path, folder: Path) -> None:
    """Copy of a report's folder what is worth keeping under version control: numbers, configurations, figures as SVG.

    Its page is written beside them; in a folder named `published` the index of all reports, too.

    Raises:
        StoreError: if the folder cannot be written to.
    """
    older = _parts_in(folder)
    for part in PUBLISHED:
        for path in sorted(report.glob(part)):
            target = folder / path.relative_to(report)
            make_folder(target.parent)
            if path.suffix == ".csv":
                target.write_text(slim.table(path.read_text("utf-8")), "utf-8")
            else:
                shutil.copyfile(path, target)
    content = json.loads((folder / "report.json").read_text("utf-8"))
    content["commands"] = [PLACE.sub("", command) for command in content["commands"]]
    (folder / "report.json").write_text(slim.numbers(slim.packed(content)), "utf-8")
    _remove(folder, older - _parts_in(folder))
    if folder.absolute().parent.name == "published":
        publishing.write_pages(folder.absolute().parent)
    else:
        (folder / "README.md").write_text(published.page(folder, read_ledger(FOLDER / "claims.yaml")), "utf-8")


def _parts_in(folder: Path) -> set[str]:
    """The files of tables and figures that the report in a folder names; none if there is no report."""
    try:
        content = json.loads((folder / "report.json").read_text("utf-8"))
        shown = [(part, Path(name).name) for part in FORMS for name, shown in content[part].items() if shown["runs"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()
    return {f"{part}/{name}.{form}" for part, name in shown for form in FORMS[part]}


def _remove(folder: Path, parts: set[str]) -> None:
    for part in parts:
        (folder / part).unlink(missing_ok=True)


def with_panel(svg: bytes) -> bytes:
    """An SVG on a white panel of its own, since nobody knows the page that shows it; once is enough."""
    end = svg.index(b">", svg.index(b"<svg")) + 1
    return svg if PANEL in svg else svg[:end] + PANEL + svg[end:]


PANEL = b'<rect width="100%" height="100%" rx="6" fill="#ffffff"/>'


def _write_tables(report: Report, folder: Path) -> None:
    for part in report.tables:
        if not part.empty:
            (folder / f"{part.item.id}.csv").write_text(to_csv(part.content), "utf-8")
            text = to_latex(part.content, f"{part.item.title}. {part.facts}", part.item.id)
            (folder / f"{part.item.id}.tex").write_text(text, "utf-8")


def numbers(report: Report) -> dict[str, Any]:
    """Every number shown, with the keys of its runs, as plain data."""
    sweep = report.evidence.sweep
    cells = [{"key": c.key, "name": c.name, "status": c.status, "outcome": c.outcome} for c in sweep.cells]
    content = {
        "format": published.FORMAT,
        "sweep": sweep.name,
        "definition": report.definition.name,
        "commands": [sweep.command, report.command],
        "cells": cells,
        "duplicates": [[cell.key for cell in group] for group in sweep.duplicates],
        "claims": [_claim(verdict) for verdict in report.verdicts],
        "tables": {part.item.id: _part(part) for part in report.tables},
        "figures": {part.item.id: _part(part) for part in report.figures},
    }
    said: dict[str, Any] = strict(content)
    return {**said, "sentences": story.sentences(said, story.ledger(said, []))}


def _claim(verdict: Verdict) -> dict[str, Any]:
    """A verdict; what its methods were configured with stands in configurations.yaml, by their runs."""
    content: dict[str, Any] = _plain(verdict)
    findings = [{name: part for name, part in found.items() if name != "axes"} for found in content["findings"]]
    return {**content, "findings": findings}


def _part(part: Part) -> dict[str, Any]:
    shown = {
        "title": part.item.title,
        "found": part.found,
        "facts": part.facts,
        "notes": part.notes,
        "runs": part.runs,
    }
    return {**shown, "content": _plain(part.content)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value

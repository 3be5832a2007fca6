"""The page of a report: one HTML file that asks for nothing else, readable without its script.

Figures are inlined as SVG, for a wide screen and for a phone; the three first ones a third time with linear axes. What
they draw of a method carries its name (`data-method`) and its values, so that the script can hide it and say what it
is. Whatever comes from a store is escaped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import jinja2
from markupsafe import Markup, escape

from dadiff.reporting import labels, published, story
from dadiff.reporting.claims import Claim, read_ledger
from dadiff.reporting.definitions import FOLDER
from dadiff.reporting.figures.style import CHOICE, INK, TAG
from dadiff.reporting.figures.style import render as render_figure
from dadiff.reporting.report import Part, Report
from dadiff.reporting.statistics import Estimate
from dadiff.reporting.story import Line
from dadiff.threads import cores

FORMS = {"tables": ("csv", "tex"), "figures": ("pdf", "svg", "png")}
WIDE, NARROW = 2, 1
"""Columns of panels on a page or screen, and on a phone."""

SHOWN = 3
"""Figures that stand on the page; the others fold out."""


@dataclass(frozen=True)
class Drawing:
    """One figure as files, and as SVG for the inside of the page."""

    files: dict[str, bytes]
    inline: Markup


def draw(part: Part) -> Drawing:
    """A figure in all its forms."""
    files = render_figure(part.content, WIDE, FORMS["figures"])
    title, name = part.found or part.item.title, part.item.id
    shapes = {"wide": files, "narrow": render_figure(part.content, NARROW, ("svg",))}
    if shapes["narrow"]["svg"] == files["svg"]:
        shapes = {"wide narrow": files}
    shapes["linear"] = render_figure(part.content, WIDE, ("svg",), linear=True)
    drawn = [
        Markup('<div class="drawing {}">{}</div>').format(
            shape, Markup(inline_svg(found["svg"], title, f"{name}-{shape[:6].strip()}"))
        )
        for shape, found in shapes.items()
        if found
    ]
    return Drawing(files, Markup("").join(drawn))


def draw_all(parts: Sequence[Part]) -> dict[str, Drawing]:
    """All figures by their id, in as many processes as there are cores; the bytes are those of one process."""
    names = [part.item.id for part in parts]
    workers = min(cores(), len(parts))
    if workers < 2:
        return dict(zip(names, map(draw, parts), strict=True))
    with ProcessPoolExecutor(workers) as pool:
        return dict(zip(names, pool.map(draw, parts), strict=True))


def untagged(svg: bytes) -> bytes:
    """A drawing without the names that are meant for the page."""
    return re.sub(rf' id="(?:{TAG}|{CHOICE})[^"]*"'.encode(), b"", svg)


def inline_svg(content: bytes, title: str, prefix: str) -> str:
    """SVG for the inside of a page: ids of its own, the page's text colour, as wide as its place at most."""
    svg = content.decode()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(rf'id="{TAG}([^"|]*)\|([^"]*)"', r'data-method="\1" data-values="\2"', svg)
    svg = re.sub(rf'id="{TAG}([^"|]*)"', r'data-method="\1"', svg)
    svg = re.sub(rf'id="{CHOICE}([^"]*)"', r'data-choice="\1"', svg)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'(href="#|url\(#)', rf"\1{prefix}-", svg)
    svg = svg.replace(INK, "currentColor")
    head, body = svg.split(">", 1)
    width = float(head.partition('width="')[2].partition("pt")[0]) * 4 / 3
    head = re.sub(r' (width|height)="[\d.]+pt"', "", head)
    look = f'role="img" aria-label="{escape(title)}" style="width:100%;max-width:{width:.0f}px;height:auto"'
    return f"{head} {look}>{body}"


def to_html(report: Report, content: Mapping[str, Any], drawings: dict[str, Drawing]) -> str:
    """The page.

    Args:
        content: the report's numbers, as in report.json.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER / "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"metric": labels.column_name, "estimate": _estimate, "forest": forest, "slug": _slug}
    claims = read_ledger(FOLDER / "claims.yaml")
    lines = story.ledger(content, claims)
    main = story.main_table(content)
    return environment.get_template("report.html").render(
        report=report,
        sweep=report.evidence.sweep,
        drawings=drawings,
        lines=lines,
        sentences=story.sentences(content, lines),
        main=next((part for part in report.tables if main and part.item.id == main[0]), None),
        columns=story.main_columns(main[1]["content"]) if main else [],
        quick=published.quick(content),
        elsewhere=_elsewhere(content, claims),
        shown=SHOWN,
    )


def _elsewhere(content: Mapping[str, Any], claims: list[Claim]) -> dict[str, tuple[str, str]]:
    """What the published reports say to each claim, for a quick report that must not contradict them unsaid."""
    if not published.quick(content):
        return {}
    said = published.verdicts(FOLDER / "published", claims)
    return {line.claim.id: (name, line.verdict) for name, line in said if published.weight(name)}


def _slug(word: str) -> str:
    return word.replace(" ", "-")


def _estimate(estimate: Estimate, metric: str = "") -> str:
    return labels.column_value(metric, estimate.value, estimate.low, estimate.high)


FOREST = {"width": 190, "height": 34, "margin": 8}
COLOURS = {True: "var(--yes)", False: "var(--no)", None: "var(--open)"}


def forest(line: Line) -> Markup:
    """The effects of a claim's methods as dots with intervals on one axis, coloured by what they say; empty of none."""
    points = [(label, e, true) for label, e, true in line.points if math.isfinite(e.value)]
    if not points:
        return Markup("")
    values = [x for _, e, _ in points for x in (e.value, e.low, e.high) if math.isfinite(x)]
    values += [line.bound] if line.bound is not None else []
    logarithmic = min(values) > 0
    low, high = (scale(edge(values), logarithmic) for edge in (min, max))

    def place(value: float) -> float:
        share = (scale(value, logarithmic) - low) / (high - low) if high > low else 0.5
        return FOREST["margin"] + share * (FOREST["width"] - 2 * FOREST["margin"])

    marks = [
        _mark(place, e, label, true, 6 + 20 * (k + 0.5) / len(points)) for k, (label, e, true) in enumerate(points)
    ]
    rule = Markup("")
    if line.bound is not None:
        rule = Markup('<line x1="{0:.1f}" x2="{0:.1f}" y1="2" y2="32" class="rule"/>').format(place(line.bound))
    text = f"{line.unit}: {line.effect_words}"
    return Markup('<svg class="forest" viewBox="0 0 {} {}" role="img" aria-label="{}">{}{}</svg>').format(
        FOREST["width"], FOREST["height"], text, rule, Markup("").join(marks)
    )


def scale(value: float, logarithmic: bool) -> float:
    """Where a value lies on an axis."""
    return math.log10(value) if logarithmic else value


def _mark(place: Any, estimate: Estimate, label: str, true: bool | None, y: float) -> Markup:
    words = f"{label}: {labels.with_interval(estimate.value, estimate.low, estimate.high)}"
    whisker = Markup("")
    if math.isfinite(estimate.low) and math.isfinite(estimate.high):
        ends = place(estimate.low), place(estimate.high)
        whisker = Markup('<line x1="{:.1f}" x2="{:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>').format(*ends, y=y)
    return Markup('<g style="color:{}"><title>{}</title>{}<circle cx="{:.1f}" cy="{:.1f}" r="2.6"/></g>').format(
        COLOURS[true], words, whisker, place(estimate.value), y
    )

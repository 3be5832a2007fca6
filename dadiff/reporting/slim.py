"""Drawings and numbers in fewer bytes, for what is kept under version control: nothing that is seen or read changes."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from typing import Any

import numpy as np

DIGITS = 6
"""Of numbers in report.json: the last ones differ between processors."""

CURVE, DRAWN_DIGITS = 9, 4
"""A figure's lists of so many numbers are drawn, not read: they have as many digits as a page can show."""

DEPTH = 3
"""Levels of report.json that have a line an entry; what lies below stands on one."""


def drawing(svg: bytes) -> bytes:
    """An SVG with coordinates to a hundredth of a point, styles once a group, and no blanks between its elements."""
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg.decode(), flags=re.DOTALL)
    text = re.sub(r' transform="rotate\(-?0 [^"]*"', "", text)
    text = re.sub("<[^>]*>", lambda tag: COORDINATE.sub(lambda found: f"{float(found[0]):.2f}", tag[0]), text)
    text = re.sub(r'(?<=style=")[^"]*', lambda found: re.sub("([;:,]) ", r"\1", found[0]), text)
    text = re.sub(r'(?<= d=")[^"]*', lambda found: _path(found[0]), text)
    text = MARKERS.sub(_shared, _short_ids(re.sub(r">\s+<", "><", text)))
    radii = {dot["id"]: float(dot["radius"]) for dot in DOT.finditer(text)}
    return _classes(_bare(DOTS.sub(lambda found: _dots(found, radii), text))).encode()


COORDINATE = re.compile(r'(?<=[ "(,])-?\d+\.\d{3,}(?=[ "),\n])')
MARKERS = re.compile(r"<g(?P<own>(?: [\w-]+=\"[^\"]*\")*)>(?P<marks>(?:<use [^>]*/>)+)</g>")
STYLE = re.compile(r' style="([^"]*)"')


def _shared(found: re.Match[str]) -> str:
    """A group of markers with the style that all of them have, if they do, said once."""
    styles = {style[1] for style in STYLE.finditer(found["marks"])}
    if (
        len(styles) != 1
        or STYLE.search(found["own"])
        or found["marks"].count(" style=") != found["marks"].count("<use ")
    ):
        return found[0]
    return f'<g{found["own"]} style="{styles.pop()}">{STYLE.sub("", found["marks"])}</g>'


DOT = re.compile(r'<path id="(?P<id>\w+)" d="M0 (?P<radius>[\d.]+)(?:C[^"CLM]*){8}z"/>')
DOTS = re.compile(
    r'<g(?P<own>[^>]*) style="fill:(?P<ink>[^;"]*)(?:;fill-opacity:(?P<opacity>[\d.]+))?">'
    r"(?P<marks>(?:<use [^>]*/>){9,})</g>"
)
PLACED = re.compile(r'<use xlink:href="#(\w+)" x="([-\d.]+)" y="([-\d.]+)"/>')
LAYERS = 3
"""Paths that many translucent dots are shared out to, so that where they crowd they are darker, as before."""


def _dots(found: re.Match[str], radii: dict[str, float]) -> str:
    """Many discs of one kind as strokes without length and with round ends: a quarter of the bytes."""
    marks = PLACED.findall(found["marks"])
    if len({mark for mark, _, _ in marks} & set(radii)) != 1 or len(marks) != found["marks"].count("<use "):
        return found[0]
    style = f"fill:none;stroke:{found['ink']};stroke-width:{2 * radii[marks[0][0]]:g}"
    style += f";stroke-opacity:{found['opacity']}" if found["opacity"] else ""
    places = np.array([[float(x), float(y)] for _, x, y in marks])
    layers = "".join(
        f'<path d="{_steps(places[layer::LAYERS])}" style="stroke-linecap:round"/>' for layer in range(LAYERS)
    )
    return f'<g{found["own"]} style="{style}">{layers}</g>'


def _steps(places: np.ndarray) -> str:
    """Dots from one to the next, (dots, 2), in whole hundredths, so that no rounding adds up."""
    hundredths = np.diff(np.round(100 * places).astype(int), axis=0, prepend=0)
    return "".join(f"m{x / 100:g} {y / 100:g}h0" for x, y in hundredths)


NAMED = re.compile(r'(?<=<g) id="[A-Za-z0-9.]+_\d+"')
WRAPPED = re.compile(r"<g>((?:(?!</?g[ >]).)*)</g>", flags=re.DOTALL)


def _bare(text: str) -> str:
    """Without the names that matplotlib counts its groups by, and without groups that say nothing."""
    text, unwrapped = NAMED.sub("", text), 1
    while unwrapped:
        text, unwrapped = WRAPPED.subn(r"\1", text)
    return text


def _classes(text: str) -> str:
    """Styles that are said `OFTEN` as classes."""
    counts = Counter(STYLE.findall(text))
    names = {style: f"s{k:x}" for k, style in enumerate(style for style, count in counts.items() if count >= OFTEN)}
    rules = "".join(f".{name}{{{style}}}" for style, name in names.items())
    text = STYLE.sub(lambda found: f' class="{names[found[1]]}"' if found[1] in names else found[0], text)
    return text.replace("</style>", f"{rules}</style>", 1)


OFTEN = 3


def _short_ids(text: str) -> str:
    """Names of markers and clips as short as can be."""
    names = dict.fromkeys(re.findall(r'(?<= id=")[mpC][0-9a-f_]{6,}', text))
    short = {name: f"i{k:x}" for k, name in enumerate(names)}
    return re.sub(r"(?<=[\"#])[mpC][0-9a-f_]{6,}(?=[\")])", lambda found: short.get(found[0], found[0]), text)


def _path(data: str) -> str:
    """Path data with one blank between numbers and none around letters."""
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", re.sub(r"\s+", " ", data.strip()))


def numbers(content: dict[str, Any]) -> str:
    """JSON to `DIGITS` significant digits, indented where it says what there is and dense below.

    What the methods of figures were configured with stands in configurations.yaml, by their runs.
    """
    figures = {name: _drawn(part) for name, part in content.get("figures", {}).items()}
    return _dense(_rounded({**content, **({"figures": figures} if figures else {})}), 0) + "\n"


def _drawn(value: Any) -> Any:
    """Of a figure: without axes, and curves with the digits that are seen."""
    if isinstance(value, dict):
        return {name: _drawn(part) for name, part in value.items() if name != "axes"}
    if isinstance(value, list):
        digits = DRAWN_DIGITS if len(value) >= CURVE else DIGITS
        return [_rounded(part, digits) if isinstance(part, float) else _drawn(part) for part in value]
    return value


def _dense(value: Any, depth: int) -> str:
    if depth == DEPTH or not value or not isinstance(value, (dict, list)):
        return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    parts = [_dense(part, depth + 1) for part in (value.values() if isinstance(value, dict) else value)]
    if isinstance(value, dict):
        parts = [f"{json.dumps(name, ensure_ascii=False)}: {part}" for name, part in zip(value, parts, strict=True)]
    ends = "{}" if isinstance(value, dict) else "[]"
    blanks = " " * (depth + 1)
    return f"{ends[0]}\n{blanks}" + f",\n{blanks}".join(parts) + f"\n{' ' * depth}{ends[1]}"


def _rounded(value: Any, digits: int = DIGITS) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(part, digits) for name, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part, digits) for part in value]
    return float(f"{value:.{digits + _beside_one(value)}g}") if isinstance(value, float) else value


def _beside_one(value: float) -> int:
    """Digits that a number close to 1 needs more: of costs over the optimum, what lies above 1 is read."""
    beside = abs(value - 1)
    return max(-math.floor(math.log10(beside)) - 2, 0) if beside > 1e-9 else 0

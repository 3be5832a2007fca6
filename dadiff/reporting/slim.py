"""Drawings and numbers in fewer bytes, for what is kept under version control: nothing that is seen or read changes."""

from __future__ import annotations

import json
import re
from typing import Any

DIGITS = 6
"""Of numbers in report.json: the last ones differ between processors."""

DEPTH = 3
"""Levels of report.json that have a line an entry; what lies below stands on one."""


def drawing(svg: bytes) -> bytes:
    """An SVG with coordinates to a hundredth of a point, styles once a group, and no blanks between its elements."""
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg.decode(), flags=re.DOTALL)
    text = re.sub(r' transform="rotate\(-?0 [^"]*"', "", text)
    text = re.sub("<[^>]*>", lambda tag: COORDINATE.sub(lambda found: f"{float(found[0]):.2f}", tag[0]), text)
    text = re.sub(r'(?<=style=")[^"]*', lambda found: re.sub("([;:,]) ", r"\1", found[0]), text)
    text = re.sub(r'(?<= d=")[^"]*', lambda found: _path(found[0]), text)
    return MARKERS.sub(_shared, _short_ids(re.sub(r">\s+<", "><", text))).encode()


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


def _short_ids(text: str) -> str:
    """Names of markers and clips as short as can be."""
    names = dict.fromkeys(re.findall(r'(?<= id=")[mpC][0-9a-f_]{6,}', text))
    short = {name: f"i{k:x}" for k, name in enumerate(names)}
    return re.sub(r"(?<=[\"#])[mpC][0-9a-f_]{6,}(?=[\")])", lambda found: short.get(found[0], found[0]), text)


def _path(data: str) -> str:
    """Path data with one blank between numbers and none around letters."""
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", re.sub(r"\s+", " ", data.strip()))


def numbers(content: dict[str, Any]) -> str:
    """JSON to `DIGITS` significant digits, indented where it says what there is and dense below."""
    return _dense(_rounded(content), 0) + "\n"


def _dense(value: Any, depth: int) -> str:
    if depth == DEPTH or not value or not isinstance(value, (dict, list)):
        return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    parts = [_dense(part, depth + 1) for part in (value.values() if isinstance(value, dict) else value)]
    if isinstance(value, dict):
        parts = [f"{json.dumps(name, ensure_ascii=False)}: {part}" for name, part in zip(value, parts, strict=True)]
    ends = "{}" if isinstance(value, dict) else "[]"
    blanks = " " * (depth + 1)
    return f"{ends[0]}\n{blanks}" + f",\n{blanks}".join(parts) + f"\n{' ' * depth}{ends[1]}"


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value

"""SVG drawings in fewer bytes, for what is kept under version control: nothing that a reader can see changes.

Places are told to a tenth of a point and from one to the next, ticks and crowds of dots are one path each, styles that
are said often are classes. What is already so stays as it is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
DECIMALS = 1
"""Of places; shapes of markers, which are small, have one more."""
OFTEN = 3
CROWD = 9
GRID = (2, 4)
"""Tenths of a point that dots of crowds are placed to, across and down: a tenth of their size."""
ROUND = "stroke-linecap:round"
"""Of dots, and said by each path of them: matplotlib's rule for all elements comes before what a group says."""
LAYERS = 3
"""Paths that many translucent dots are shared out to, so that where they crowd they are darker, as before."""
PLACES = ("x", "y", "width", "height")
OPERANDS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "Q": 4, "Z": 0}

Segment = tuple[str, list[int]]
"""A letter of SVG's path data in upper case, and its places in units of the last decimal, absolute."""


def smaller(svg: bytes) -> bytes:
    """A drawing as matplotlib writes it, or one that is small already, in fewer bytes."""
    ElementTree.register_namespace("", SVG[1:-1])
    ElementTree.register_namespace("xlink", LINK[1:-5])
    root = ElementTree.fromstring(svg)
    _tidy(root, _styles(root))
    shapes = {f"#{shape.get('id')}": shape for shape in root.iter(_name("path"))}
    for group in [group for group in root.iter(_name("g")) if len(group)]:
        _merge_marks(group, shapes)
    _name_used(root)
    _unwrap(root)
    for parent in root.iter():
        _join_ticks(parent)
    _to_classes(root)
    return ElementTree.tostring(root).replace(b" />", b"/>")


def _name(tag: str) -> str:
    return SVG + tag


def _styles(root: Element) -> dict[str, str]:
    """The styles of classes, whose rules go."""
    rules: dict[str, str] = {}
    for style in root.iter(_name("style")):
        rules |= dict(re.findall(r"\.(\w+)\{([^}]*)\}", style.text or ""))
        style.text = re.sub(r"\.\w+\{[^}]*\}", "", style.text or "").strip()
    return rules


def _tidy(root: Element, rules: dict[str, str]) -> None:
    """No metadata, no blanks between elements, styles in full and places rounded."""
    for parent in root.iter():
        for child in list(parent):
            if child.tag.endswith("}metadata"):
                parent.remove(child)
    shapes = {shape for part in root.iter(_name("defs")) for shape in part.iter(_name("path"))}
    for element in root.iter():
        if element.tag != _name("text") and element.tag != _name("tspan") and element.tag != _name("style"):
            element.text = None
        if element.tag != _name("tspan"):
            element.tail = None
        _tidy_attributes(element, rules, DECIMALS + (element in shapes))


def _tidy_attributes(element: Element, rules: dict[str, str], decimals: int) -> None:
    if LINK in element.attrib and element.tag == _name("use"):
        element.set("href", element.attrib.pop(LINK))
    style = rules.get(element.attrib.pop("class", ""), element.get("style", ""))
    if style:
        element.set("style", re.sub(r"([;:,]) ", r"\1", style))
    for name in PLACES:
        if re.fullmatch(r"-?[\d.]+", element.get(name, "")) and element.tag != _name("svg"):
            element.set(name, _written(round(float(element.attrib[name]) * 10**DECIMALS), DECIMALS))
    if element.get("transform"):
        turned = re.sub(r"-?\d+\.\d{3,}", lambda found: f"{float(found[0]):.2f}", element.attrib["transform"])
        element.set("transform", re.sub(r"rotate\(-?0 [^)]*\)", "", turned))
    if not element.get("transform", "").strip():
        element.attrib.pop("transform", None)
    if element.tag == _name("path"):
        parts = list(segments(element.get("d", ""), decimals))
        dots = _is_dots(parts)
        element.set("d", _dots(parts) if dots else path(parts, decimals))
        if dots:
            element.set("style", _merged(element.get("style", ""), ROUND))


def segments(data: str, decimals: int) -> Iterator[Segment]:
    """Path data, absolute or relative, in units of the last decimal; steps that lead nowhere within a line go."""
    unit, letter = 10**decimals, "M"
    at, start = [0.0, 0.0], [0.0, 0.0]
    tokens = re.findall(r"[A-Za-z]|-?(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?", data)
    while tokens:
        if tokens[0].isalpha():
            letter = tokens.pop(0)
        kind, count = letter.upper(), OPERANDS[letter.upper()]
        numbers, tokens = [float(token) for token in tokens[:count]], tokens[count:]
        numbers = _absolute(kind, numbers, at if letter.islower() else [0.0, 0.0], at)
        at = start if kind == "Z" else numbers[-2:]
        start = at if kind == "M" else start
        yield ("L" if kind in "HV" else kind), [round(number * unit) for number in numbers]
        letter = {"M": "L", "m": "l"}.get(letter, letter)


def _absolute(kind: str, numbers: list[float], base: list[float], at: list[float]) -> list[float]:
    if kind == "H":
        return [numbers[0] + base[0], at[1]]
    if kind == "V":
        return [at[0], numbers[0] + base[1]]
    return [number + base[k % 2] for k, number in enumerate(numbers)]


def path(parts: Iterable[Segment], decimals: int) -> str:
    """Path data from one place to the next, so that few digits suffice and no rounding adds up."""
    text, before, at, start = "", "", [0, 0], [0, 0]
    for kind, numbers in parts:
        steps = [number - at[k % 2] for k, number in enumerate(numbers)]
        letter = "m" if kind == "M" else kind.lower()
        if kind == "L" and not any(steps):
            if before == "m":
                text, before = text + "h0", "h"
            continue
        if kind == "L" and 0 in steps:
            letter, steps = ("h", steps[:1]) if steps[1] == 0 else ("v", steps[1:])
        text += _joined([_written(step, decimals) for step in steps], "" if letter == before != "m" else letter)
        at = start if kind == "Z" else numbers[-2:]
        start, before = (at if kind == "M" else start), letter
    return text


def _joined(words: list[str], letter: str) -> str:
    """Numbers with a blank between where no sign parts them; after a letter none is needed."""
    text = letter
    for k, word in enumerate(words):
        text += word if word.startswith("-") or (letter and k == 0) else f" {word}"
    return text


def _written(value: int, decimals: int) -> str:
    """A whole number of the last decimal as short as can be."""
    text = f"{value / 10**decimals:.{decimals}f}".rstrip("0").rstrip(".")
    return re.sub(r"^(-?)0\.", r"\1.", text) if text not in ("", "-0", "-") else "0"


def _is_dots(parts: list[Segment]) -> bool:
    """Whether a path is of several lines without length alone; a single one is a whisker that rounds to none."""
    kinds = "".join(kind for kind, _ in parts)
    whole = re.fullmatch(f"(ML){{{CROWD // LAYERS},}}", kinds)
    return bool(whole) and all(parts[k][1] == parts[k + 1][1] for k in range(0, len(parts), 2))


def _dots(parts: Iterable[Segment]) -> str:
    """Dots of one path from the top down, each place of the grid once."""
    places = sorted({(_nearest(numbers[1], GRID[1]), _nearest(numbers[0], GRID[0])) for _, numbers in parts})
    return path((("ML"[k], [x, y]) for y, x in places for k in range(2)), DECIMALS)


def _nearest(number: int, step: int) -> int:
    return step * round(number / step)


def _merge_marks(group: Element, shapes: dict[str, Element]) -> None:
    """A group of ticks as one path, and a crowd of discs as strokes without length and with round ends."""
    links = {mark.get("href", "") for mark in group}
    styles = {mark.get("style", "") for mark in group}
    if {mark.tag for mark in group} != {_name("use")} or len(links) != 1 or len(styles) != 1:
        return
    shape, style = shapes[links.pop()], _merged(group.get("style", ""), styles.pop())
    places = [(float(mark.get("x", 0)), float(mark.get("y", 0))) for mark in group]
    parts = list(segments(shape.get("d", ""), DECIMALS))
    if [kind for kind, _ in parts] == ["M", "L"]:
        _replace(group, [{"d": _ticks(places, parts)}], _merged(style, shape.get("style", "")))
    elif [kind for kind, _ in parts] == ["M", *"CCCCCCCC", "Z"] and len(places) >= CROWD and "stroke" not in style:
        layers = [{"d": _dots(_lines(places[layer::LAYERS])), "style": ROUND} for layer in range(LAYERS)]
        _replace(group, layers, _stroke(style, abs(2 * segments_of(shape)[0][1][1] / 100)))
    elif style:
        group.set("style", style)
        for mark in group:
            mark.attrib.pop("style", None)


def segments_of(shape: Element) -> list[Segment]:
    """The path of a marker, in hundredths."""
    return list(segments(shape.get("d", ""), DECIMALS + 1))


def _lines(places: list[tuple[float, float]]) -> list[Segment]:
    tenths = [[round(x * 10**DECIMALS), round(y * 10**DECIMALS)] for x, y in places]
    return [(kind, place) for place in tenths for kind in "ML"]


def _ticks(places: list[tuple[float, float]], shape: list[Segment]) -> str:
    moved = [
        (kind, [round(at[k] * 10**DECIMALS) + number for k, number in enumerate(numbers)])
        for at in places
        for kind, numbers in shape
    ]
    return path(moved, DECIMALS)


def _stroke(style: str, width: float) -> str:
    """The style of a disc as that of a stroke of its width with round ends."""
    inked = re.sub(r"^fill(?=[:-])|(?<=;)fill(?=[:-])", "stroke", style)
    return f"fill:none;{inked};stroke-width:{width:g}"


def _replace(group: Element, paths: list[dict[str, str]], style: str) -> None:
    """A group's marks by paths of one style."""
    for mark in list(group):
        group.remove(mark)
    for attributes in paths:
        ElementTree.SubElement(group, _name("path"), attributes)
    group.set("style", style)


def _merged(outer: str, inner: str) -> str:
    """A style with what an inner one says besides, or instead."""
    rules = [rule.split(":", 1) for rule in f"{outer};{inner}".split(";") if rule]
    return ";".join(f"{name}:{value}" for name, value in dict(rules).items())


def _name_used(root: Element) -> None:
    """Short names of what is used, none of what is not; shapes and clips that are not used go."""
    text = " ".join(value for element in root.iter() for value in element.attrib.values())
    used = {name: f"i{k:x}" for k, name in enumerate(dict.fromkeys(re.findall(r"(?:^| |\()#([^ )]+)", text)))}
    for element in root.iter():
        name = element.attrib.pop("id", None)
        if name in used:
            element.set("id", used[name])
        for key in ("href", "clip-path"):
            if "#" in element.get(key, "")[:6]:
                element.set(key, re.sub(r"#([^)]+)", lambda found: f"#{used[found[1]]}", element.attrib[key]))
    for parent in root.iter():
        for child in list(parent):
            unused = parent.tag == _name("defs") and child.tag != _name("style") and not child.get("id")
            if unused:
                parent.remove(child)


def _unwrap(parent: Element) -> None:
    """What lies in groups that say nothing, and the single child of one that says how it looks, without the group."""
    for child in list(parent):
        _unwrap(child)
        where = list(parent).index(child)
        if child.tag in (_name("defs"), _name("g")) and not len(child):
            parent.remove(child)
        elif child.tag == _name("g") and not child.attrib:
            parent[where : where + 1] = list(child)
        elif child.tag == _name("g") and len(child) == 1 and child.attrib.keys() <= {"style"}:
            child[0].set("style", _merged(child.attrib["style"], child[0].get("style", "")))
            parent[where] = child[0]


TICKS = re.compile(r"(?:m[^a-z]*(?:[hv](?!0)[^a-z ]+|l-?[\d.]+[ -][^a-z -]+))+")


def _join_ticks(parent: Element) -> None:
    """The ticks of one look in a group as one path."""
    found: dict[str, Element] = {}
    for child in list(parent):
        if (
            child.tag != _name("path")
            or child.attrib.keys() != {"d", "style"}
            or not TICKS.fullmatch(child.attrib["d"])
        ):
            continue
        first = found.setdefault(child.attrib["style"], child)
        if first is not child:
            parts = [*segments(first.attrib["d"], DECIMALS), *segments(child.attrib["d"], DECIMALS)]
            first.set("d", path(parts, DECIMALS))
            parent.remove(child)


def _to_classes(root: Element) -> None:
    """Styles that are said `OFTEN` as classes."""
    sheet = next(root.iter(_name("style")), None)
    counts = Counter(element.attrib["style"] for element in root.iter() if "style" in element.attrib)
    names = {style: f"s{k:x}" for k, style in enumerate(style for style, n in counts.items() if n >= OFTEN)}
    if sheet is None:
        return
    sheet.text = (sheet.text or "") + "".join(f".{name}{{{style}}}" for style, name in names.items())
    for element in root.iter():
        if element.get("style") in names:
            element.set("class", names[element.attrib.pop("style")])

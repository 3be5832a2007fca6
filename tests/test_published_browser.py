"""The README and the published pages as a code host shows them: readable in both schemes, on a screen and a phone."""

from __future__ import annotations

import pytest
from test_reporting_browser import PAGE, PHONE, axe, browser, contrast, show

from dadiff.reporting import published
from dadiff.reporting.definitions import FOLDER

pytestmark = pytest.mark.slow
__all__ = ["axe", "browser"]

ROOT = FOLDER.parent
PAGES = [ROOT / "README.md", FOLDER / "published" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += [folder / "README.md" for folder in published.folders(FOLDER / "published")]
DRAWINGS = sorted((FOLDER / "published").glob("*/figures/*.svg"))
SCHEMES = ["light", "dark"]
STYLE = """
:root { color-scheme: light dark }
body { font: 16px/1.5 sans-serif; max-width: 830px; margin: 0 auto; padding: 16px; background: #fff; color: #1f2328 }
table { border-collapse: collapse; display: block; width: max-content; max-width: 100%; overflow: auto }
td, th { border: 1px solid #d1d9e0; padding: 6px 13px }
pre { padding: 16px; overflow: auto }
img { max-width: 100% }
a { color: #0969da }
@media (prefers-color-scheme: dark) { body { background: #0d1117; color: #f0f6fc } a { color: #4493f8 } }
"""


@pytest.fixture(scope="module", params=PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def page(request, tmp_path_factory) -> str:
    """The address of a page of markdown in the look of a code host, where what scrolls is reached by keys."""
    markdown = pytest.importorskip("markdown_it").MarkdownIt("commonmark", {"html": True}).enable("table")
    text = markdown.render(request.param.read_text("utf-8"))
    for tag in ("table", "pre"):
        text = text.replace(f"<{tag}>", f'<{tag} tabindex="0">')
    head = f'<base href="{request.param.parent.as_uri()}/"><title>{request.param.parent.name}</title>'
    out = tmp_path_factory.mktemp("page") / "page.html"
    out.write_text(f'<!doctype html><html lang="en">{head}<style>{STYLE}</style><main>{text}</main></html>', "utf-8")
    return out.as_uri()


@pytest.mark.parametrize("size", [PHONE, PAGE])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_axe_finds_nothing(browser, page, axe, scheme, size):
    show(browser, page, size, scheme)
    browser.execute_script(axe)
    found = browser.execute_async_script("axe.run().then(arguments[0])")
    assert [(rule["id"], rule["nodes"][0]["html"]) for rule in found["violations"]] == []
    assert browser.execute_script("return [...document.images].filter(i => !i.naturalWidth).map(i => i.src)") == []


@pytest.mark.parametrize("drawing", DRAWINGS, ids=lambda path: f"{path.parts[-3]}/{path.stem}")
def test_texts_of_published_drawings_stand_out_and_lie_inside(browser, drawing):
    show(browser, drawing.as_uri(), PAGE, "dark")
    panel = browser.execute_script("return getComputedStyle(document.querySelector('rect')).fill")
    texts = browser.execute_script(
        """const box = document.documentElement.getBoundingClientRect();
           return [...document.querySelectorAll('text')].filter(t => t.textContent.trim()).map(t => {
             const r = t.getBoundingClientRect();
             const under = [...document.querySelectorAll('path')].filter(p => {
               const b = p.getBoundingClientRect();
               return b.left <= r.left && b.right >= r.right && b.top <= r.top && b.bottom >= r.bottom
                 && b.width < 200 && getComputedStyle(p).fill != 'none'}).pop();
             return [t.textContent, getComputedStyle(t).fill, under ? getComputedStyle(under).fill : null,
                     r.left < box.left - 2 || r.right > box.right + 2
                     || r.bottom > box.bottom + 2 || r.top < box.top - 2]})"""
    )
    assert texts
    assert [text for text, *_, outside in texts if outside] == []
    assert [text for text, ink, cell, _ in texts if contrast(cell or panel, ink) < 3] == []

"""The report as a browser shows it: no error, no request, nothing wider than the page, readable in both schemes."""

from __future__ import annotations

import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dadiff.reporting import cli

pytestmark = pytest.mark.slow

STORE = Path(__file__).parent / "data" / "store"
PHONE, PAGE = (390, 800), (1100, 900)
AXE = "axe-core@4.14.1"


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Any]:
    """Headless Chromium."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    program, driver = (shutil.which(name) for name in ("chromium", "chromedriver"))
    if not (program and driver):
        pytest.skip("chromium and chromedriver are not installed (apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    quiet = ("no-first-run", "disable-background-networking", "disable-component-update", "disable-sync")
    for name in ("headless=new", "no-sandbox", "disable-gpu", "hide-scrollbars", *quiet):
        options.add_argument(f"--{name}")
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('chromium')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield chrome
    chrome.quit()


@pytest.fixture(scope="module", params=["lqr_made_up", "obstacles_made_up", "hankel_length_made_up", "fleet_made_up"])
def page(request, tmp_path_factory) -> str:
    """The address of a report."""
    out = tmp_path_factory.mktemp(request.param)
    assert cli.main([request.param, "--output-dir", str(STORE), "--out", str(out)]) == 0
    return (out / "index.html").as_uri()


def show(browser: Any, page: str, size: tuple[int, int], scheme: str) -> None:
    """Open a page on a screen of some size, in a colour scheme."""
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size == PHONE}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get_log("performance")
    browser.get(page)


def test_no_error_and_no_request_leaves_the_page(browser, page):
    show(browser, page, PAGE, "light")
    assert browser.get_log("browser") == []
    requests = [
        entry["message"] for entry in browser.get_log("performance") if "Network.requestWillBeSent" in entry["message"]
    ]
    assert not [message for message in requests if '"url":"http' in message]


@pytest.mark.parametrize("size", [PHONE, PAGE])
def test_nothing_is_wider_than_the_page(browser, page, size):
    show(browser, page, size, "light")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= size[0]
    drawn = "return [...document.querySelectorAll('main > figure svg')].filter(s => s.getClientRects().length).length"
    shown = "return document.querySelectorAll('main > figure').length"
    assert browser.execute_script(drawn) == browser.execute_script(shown) > 0
    height = browser.execute_script("return document.documentElement.scrollHeight")
    assert height <= (6 if size == PAGE else 10) * size[1]


def test_texts_of_figures_lie_inside_of_them(browser, page):
    show(browser, page, PAGE, "light")
    outside = browser.execute_script(
        """return [...document.querySelectorAll('svg')].filter(s => s.getClientRects().length).flatMap(svg => {
             const box = svg.getBoundingClientRect();
             return [...svg.querySelectorAll('text')].filter(t => t.textContent.trim()).filter(t => {
               const r = t.getBoundingClientRect();
               return r.left < box.left - 2 || r.right > box.right + 2
                 || r.bottom > box.bottom + 2 || r.top < box.top - 2;
             }).map(t => t.textContent)})"""
    )
    assert outside == []


def test_both_schemes_are_readable(browser, page):
    colours = {}
    for scheme in ("light", "dark"):
        show(browser, page, PAGE, scheme)
        colours[scheme] = browser.execute_script(
            """const text = document.querySelector('svg text'), body = getComputedStyle(document.body);
               return [body.backgroundColor, getComputedStyle(text).fill]"""
        )
    for page_colour, ink in colours.values():
        assert contrast(page_colour, ink) > 7
    assert colours["light"] != colours["dark"]


TEXTS = """
document.querySelectorAll('details').forEach(d => d.open = true);
const seen = e => e.getClientRects().length && !e.closest('.hidden');
const words = e => [...e.childNodes].filter(n => n.nodeType === 3).map(n => n.textContent).join('').trim();
return [...document.querySelectorAll('main *')].filter(e => seen(e) && words(e) && words(e) !== '\u25a0').map(e => {
  const look = getComputedStyle(e);
  let behind = e;
  while (behind && /, 0\\)$|transparent/.test(getComputedStyle(behind).backgroundColor)) behind = behind.parentElement;
  return [words(e), e instanceof SVGElement ? look.fill : look.color,
          getComputedStyle(behind || document.body).backgroundColor];
})"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_stands_out(browser, page, scheme):
    show(browser, page, PAGE, scheme)
    texts = browser.execute_script(TEXTS)
    assert len(texts) > 50
    assert [text for text in texts if contrast(text[1], text[2]) < 4.5] == []


@pytest.fixture(scope="module")
def axe(tmp_path_factory) -> str:
    """The accessibility checks of axe-core, from the npm registry."""
    folder = tmp_path_factory.mktemp("axe")
    npm = shutil.which("npm")
    fetched = npm and subprocess.run(
        [npm, "pack", "--silent", AXE], cwd=folder, capture_output=True, timeout=120, check=False
    )
    if not fetched or fetched.returncode:
        pytest.skip("npm does not give axe-core")
    with tarfile.open(next(folder.glob("*.tgz"))) as archive:
        return archive.extractfile("package/axe.min.js").read().decode()


@pytest.mark.parametrize("size", [PHONE, PAGE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(browser, page, axe, scheme, size):
    show(browser, page, size, scheme)
    browser.execute_script("document.querySelectorAll('details').forEach(d => d.open = true)")
    browser.execute_script(axe)
    found = browser.execute_async_script("axe.run().then(arguments[0])")
    assert [(rule["id"], rule["nodes"][0]["html"]) for rule in found["violations"]] == []


def test_a_legend_entry_hides_its_method_in_all_figures(browser, page):
    show(browser, page, PAGE, "light")
    hidden = "return document.querySelectorAll('[data-method].hidden').length"
    click = "document.querySelector('[data-choice]').dispatchEvent(new MouseEvent('click', {bubbles: true}))"
    assert browser.execute_script(hidden) == 0
    browser.execute_script(click)
    assert browser.execute_script(hidden) > 1
    assert (
        browser.execute_script("return document.querySelector('[data-choice]').getAttribute('aria-pressed')") == "false"
    )
    browser.execute_script(click)
    assert browser.execute_script(hidden) == 0


def test_tables_sort_and_filter_and_axes_change(browser, page):
    show(browser, page, PAGE, "light")
    sort = "document.querySelector('main > .scroll th:nth-child(2)').click()"
    column = """return [...document.querySelectorAll('main > .scroll tbody tr')].map(r => value(r.cells[1]))
                .filter(v => typeof v === 'number')"""
    for ascending in (True, False):
        browser.execute_script(sort)
        values = browser.execute_script(column)
        assert values == sorted(values, reverse=not ascending)
    browser.execute_script(
        """const box = document.querySelector('main > input'); box.value = 'vanilla';
           box.dispatchEvent(new Event('input'))"""
    )
    rows = "[...document.querySelectorAll('main > .scroll tbody tr')]"
    shown = f"return {rows}.filter(r => !r.hidden).map(r => r.textContent)"
    assert all("vanilla" in text for text in browser.execute_script(shown))
    if browser.execute_script("return document.querySelector('main > figure button') !== null"):
        browser.execute_script("document.querySelector('main > figure button').click()")
        assert (
            browser.execute_script("return document.querySelector('.show-linear .linear').getClientRects().length") == 1
        )


def test_hovering_says_the_method_and_its_values(browser, page):
    show(browser, page, PAGE, "light")
    browser.execute_script(
        """const svg = [...document.querySelectorAll('.drawing svg')].find(
             s => s.getClientRects().length && s.querySelector('[data-values]'));
           const group = svg.querySelector('[data-values]'), [[x, y]] = vertices(group)[0];
           svg.scrollIntoView();
           const at = new DOMPoint(x, y).matrixTransform(svg.getScreenCTM());
           svg.dispatchEvent(new PointerEvent('pointermove', {clientX: at.x, clientY: at.y, bubbles: true}))"""
    )
    tip = browser.execute_script("return document.querySelector('.tip:not([hidden])')?.textContent")
    assert tip
    assert ": " in tip


def contrast(first: str, second: str) -> float:
    """The contrast ratio of WCAG 2 of two colours `rgb(r, g, b)`."""
    light, dark = sorted((luminance(colour) for colour in (first, second)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    parts = [int(float(part)) / 255 for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]
    linear = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))

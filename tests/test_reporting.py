"""Reports from a small committed store: the same bytes, the expected numbers, no mean over what is lost."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
import yaml
from made_up import MadeUp, example_arrays
from matplotlib.figure import Figure
from matplotlib.markers import CARETDOWN

from dadiff.errors import ConfigError, StoreError
from dadiff.outside import without_passwords
from dadiff.reporting import cli, configurations, drawings, labels, latex, slim
from dadiff.reporting.aggregation import Evidence, grid, pair, varying
from dadiff.reporting.compare import compared
from dadiff.reporting.definitions import FOLDER, Item, for_sweep, load, names
from dadiff.reporting.figures import diffusion, paths
from dadiff.reporting.figures.style import COLOURS, INK, MARKERS, OTHER, RC, looks_of, render
from dadiff.reporting.report import build
from dadiff.reporting.selection import matches
from dadiff.reporting.sources import read_sweeps
from dadiff.reporting.statistics import ratio
from dadiff.store import Results

STORE = Path(__file__).parent / "data" / "store"
EXPECTED = Path(__file__).parent / "data" / "expected"
SWEEPS = ("lqr_made_up", "hankel_length_made_up", "obstacles_made_up", "fleet_made_up")


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """The LQR report, with everything that can go wrong in its sweep."""
    out = tmp_path_factory.mktemp("report")
    with contextlib.chdir(STORE.parent):
        assert cli.main(["lqr_made_up", "--output-dir", STORE.name, "--out", str(out)]) == 0
    return out


def evidence(name: str) -> Evidence:
    return Evidence(read_sweeps(STORE, [name]))


def flat(value, prefix="") -> dict[str, object]:
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {name: leaf for key, part in items for name, leaf in flat(part, f"{prefix}/{key}").items()}
    return {prefix: value}


def test_numbers_are_as_expected(report):
    """`python tests/data/make_expected.py` writes the expectation anew; look at what it changes."""
    stored = flat(json.loads((EXPECTED / "lqr_made_up.json").read_text()))
    found = flat(json.loads((report / "report.json").read_text()))
    assert found.keys() == stored.keys()
    for name, value in stored.items():
        assert found[name] == (pytest.approx(value, rel=1e-5) if isinstance(value, float) else value), name


def test_tables_hold_the_means_of_the_stored_plans(report):
    with (report / "tables" / "summary.csv").open() as stream:
        rows = {row["method"]: row for row in csv.DictReader(stream)}
    known = evidence("lqr_made_up").methods({"projector": "known", "enforcement": "post_hoc"})[0]
    errors = [cell.table("per_step")["planned_state_error"].mean() for cell in known.finished]
    row = rows[next(label for label in rows if label.startswith("known") and "once at the end" in label)]
    mean = np.exp(np.mean(np.log(errors)))  # of the runs' means, geometric
    assert float(row["planned_state_error_mean"]) == pytest.approx(mean, rel=1e-5)
    assert float(row["planned_state_error_mean_low"]) < mean < float(row["planned_state_error_mean_high"])
    assert float(row["planned_state_error_ratio"]) == pytest.approx(0.6, rel=0.1)
    assert row["runs"].split() == known.keys


def test_the_same_store_gives_the_same_bytes(tmp_path):
    folders = (tmp_path / "a", tmp_path / "b")
    for folder in folders:
        assert cli.main(["hankel_length_made_up", "--output-dir", str(STORE), "--out", str(folder)]) == 0
    first, second = (
        {p.relative_to(folder): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*") if p.is_file()}
        for folder in folders
    )
    assert first == second
    assert {path.suffix for path in first} == {".html", ".json", ".csv", ".tex", ".pdf", ".svg", ".png", ".yaml"}


def test_what_is_published_is_numbers_configurations_and_drawings(tmp_path):
    out, published = tmp_path / "out", tmp_path / "published"
    for folder in (out / "figures", published / "figures"):
        folder.mkdir(parents=True)
        (folder / "older.svg").write_text("of another definition")
        (folder / "mine.svg").write_text("a reader's own")
        older = {"tables": {}, "figures": {"older": {"runs": ["0123456789abcdef"]}}}
        (folder.parent / "report.json").write_text(json.dumps(older))
    command = ["lqr_made_up", "--output-dir", str(STORE), "--out", str(out), "--publish", str(published)]
    assert cli.main(command) == 0
    files = {path.relative_to(published).as_posix() for path in published.rglob("*") if path.is_file()}
    assert {"report.json", "configurations.yaml", "tables/summary.csv", "figures/errors.svg"} <= files
    assert {Path(file).suffix for file in files} == {".json", ".yaml", ".csv", ".svg", ".md"}
    assert not (out / "figures" / "older.svg").exists()
    assert not (published / "figures" / "older.svg").exists()
    assert (out / "figures" / "mine.svg").exists()
    assert (published / "figures" / "mine.svg").exists()
    stored = yaml.safe_load((published / "configurations.yaml").read_text())
    cells = evidence("lqr_made_up").sweep.cells
    assert stored["cells"].keys() == {cell.key for cell in cells if cell.record}
    for cell in cells:
        if cell.record:
            own = dict(stored["cells"][cell.key])
            assert own.pop("run")
            assert {**stored["shared"], **configurations.flat(own)} == configurations.flat(cell.config)


def test_a_password_in_an_address_is_not_shown():
    shown = without_passwords("http://user:secret@host:5000/x")
    assert shown == "http://user@host:5000/x"
    assert without_passwords("sqlite:////a/b@c.db") == "sqlite:////a/b@c.db"


def test_the_page_asks_for_nothing_and_knows_no_place(report):
    page = (report / "index.html").read_text()
    script = (FOLDER / "templates" / "report.js").read_text()
    assert page.count("<script") == 1
    assert script.strip() in page
    assert len(script.splitlines()) <= 150
    assert not any(text in script for text in ("fetch(", "XMLHttpRequest", "import ", "eval(", "innerHTML"))
    assert not any(text in page for text in ('src="http', "@import", "url(http", str(STORE), str(Path.home()) + "/"))
    assert page.count("<svg") > 5


def test_lost_and_double_cells_are_named_and_never_averaged(report):
    page = (report / "index.html").read_text()
    for text in ("lqr/known/literal/0: diverged at step 7", "lqr/identified/normalised/0: missing", "the same again"):
        assert text in page
    content = json.loads((report / "report.json").read_text())
    lost = {cell["key"] for cell in content["cells"] if cell["status"] != "finished"}
    assert len(lost) == 3
    for part in (*content["tables"].values(), *content["figures"].values()):
        assert not lost & set(part["runs"])
    assert {cell["outcome"] for cell in content["cells"] if cell["status"] == "finished"} == {"finished"}
    assert [len(group) for group in content["duplicates"]] == [2]


def test_every_part_says_how_to_make_it_again_and_from_how_much(report):
    content = json.loads((report / "report.json").read_text())
    assert content["commands"][0] == "dadiff +sweeps=lqr_made_up"
    facts = content["figures"]["errors"]["facts"]
    assert facts.startswith(
        "3 training seeds, 3 recordings, 6 cases, 3 plans a case. 95 % intervals from an analysis of variance over"
    )
    assert facts.endswith("seeds and cases, each run with cases of its own.")
    assert "interval" not in content["figures"]["theorem1"]["facts"]
    page = (report / "index.html").read_text()
    shown = [part for part in (*content["tables"].values(), *content["figures"].values()) if part["runs"]]
    assert len(shown) > 3
    assert page.count("dadiff-report lqr_made_up --definition lqr") == 1
    assert f'href="#run-{content["figures"]["errors"]["runs"][0]}"' in page


def test_one_training_seed_is_said(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0)
    store.sweep()
    content = build(load("default"), Evidence(read_sweeps(tmp_path, [store.name])), [], "")
    assert content.tables[0].facts.endswith("with one training seed: they cover cases only.")


def test_whatever_comes_from_a_store_is_escaped(tmp_path):
    store = MadeUp(tmp_path, "lqr<b>")
    hostile = r"<script>alert(1)</script> \input{x} $\alpha$ & 5 % _#"
    store.run(1.0)
    store.run(0.5, projector=hostile, enforcement=hostile)
    store.run(projector="known", enforcement=hostile, status="failed", reason=hostile)
    store.sweep()
    assert cli.main(["lqr<b>", "--output-dir", str(tmp_path), "--definition", "default", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "index.html").read_text()
    assert page.count("<script") == 1
    assert "&lt;script&gt;" in page
    assert not any(f"data-{name}={hostile}" in page for name in ("method", "choice"))
    tex = (tmp_path / "tables" / "summary.tex").read_text()
    assert r"\input" not in tex
    assert r"\textbackslash{}input\{x\} \$\textbackslash{}alpha\$ \& 5 \% \_\#" in tex
    assert b"<script" not in (tmp_path / "figures" / "errors.svg").read_bytes()


def test_latex_sets_numbers_and_signs():
    assert latex.escape("1.50·10⁻⁷ ‖x‖² †") == r"1.50$\cdot$10$^{-7}$ $\|$x$\|$$^2$ $^\dagger$"


@pytest.mark.parametrize("name", SWEEPS)
def test_figures_through_their_data(name):
    """What is drawn is what was collected: a line, marker or patch for each method, and its label."""
    content = build(for_sweep(name), evidence(name), [], "")
    drawn = [part for part in content.figures if not part.empty]
    assert len(drawn) >= 2
    for part in drawn:
        with matplotlib.rc_context(RC):
            figure = part.content.draw(2)
        assert all(ax.get_title() or ax.get_title("left") or ax.get_xlabel() for ax in figure.axes), part.item.id
        wanted = {item.label for item in _labelled(part.content)}
        legend = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
        legend |= {str(text.get_gid()).split(":", 1)[-1] for ax in figure.axes for text in ax.texts}
        ticks = {text.get_text() for ax in figure.axes for text in ax.get_yticklabels()}
        titles = {text.replace("\n", " ") for ax in figure.axes for text in (ax.get_title(), ax.get_title("left"))}
        assert wanted <= legend | ticks | {title.removeprefix(title[: title.find(") ") + 2]) for title in titles} | {
            label for label in wanted if any(label in title for title in titles)
        }, part.item.id


def test_paths_have_a_panel_a_condition_and_share_a_line_where_they_coincide(tmp_path):
    store = MadeUp(tmp_path, "obstacles_made_up", horizon=40)
    for last_step_noise, projector, level in (
        (True, "none", 1.0), (True, "known", 0.2), (True, "hankel", 0.2),
        (False, "none", 0.9), (False, "known", 0.1), (False, "hankel", 0.12),
    ):  # fmt: skip
        store.run(level, task="obstacles", projector=projector, sampler__last_step_noise=last_step_noise,
                  enforcement=None if projector == "none" else "normalised", denoiser="mlp",
                  arrays=example_arrays(40, level, obstacles=True))  # fmt: skip
    store.sweep()
    seen = Evidence(read_sweeps(tmp_path, [store.name]))
    drawn = paths.collect(seen, cells={}, sample_of_data=True, by="sampler.last_step_noise")
    assert {panel.title: [path.label for path in panel.paths] for panel in drawn.panels} == {
        "a sample of the data": [],
        "plans, with last-step noise": ["vanilla", "known FF† = Hankel HH†"],
        "plans, without last-step noise": ["vanilla", "known FF†", "Hankel HH†"],
    }


def test_systems_without_a_plane_have_no_paths(tmp_path):
    store = MadeUp(tmp_path, "lqr_made_up")
    arrays = {name: values[..., :1] for name, values in example_arrays(10, 1.0).items() if values.ndim > 1}
    store.run(1.0, projector="known", enforcement="normalised", denoiser="mlp", arrays=arrays)
    store.sweep()
    seen = Evidence(read_sweeps(tmp_path, [store.name]))
    assert paths.collect(seen, cells={}).panels == []
    assert diffusion.collect(seen, cells={}).stages == []


def _labelled(content) -> list:
    parts = [content, *getattr(content, "panels", [])]
    names = ("curves", "lines", "points", "traces")
    return [item for part in parts for name in names for item in getattr(part, name, [])]


def test_curves_are_the_means_and_lie_in_their_bands():
    content = build(load("lqr"), evidence("lqr_made_up"), [], "")
    errors = next(part.content for part in content.figures if part.item.id == "errors")
    vanilla = next(curve for curve in errors.panels[0].curves if curve.label == "vanilla")
    method = evidence("lqr_made_up").methods({"projector": "none", "denoiser": "mlp"})[0]
    runs = method.runs.curves("planned_state_error").values.mean(axis=1)
    np.testing.assert_allclose(vanilla.band.value, np.exp(np.log(runs).mean(axis=0)))
    assert (vanilla.band.low < vanilla.band.value).all()
    assert (vanilla.band.value < vanilla.band.high).all()
    inputs = next(curve for curve in errors.panels[1].curves if curve.label == "vanilla")
    assert np.isnan(inputs.band.value[-1])
    assert np.isfinite(inputs.band.value[:-1]).all()


def test_diverged_cells_are_shown_as_such():
    content = build(load("lqr"), evidence("lqr_made_up"), [], "")
    rows = next(part.content for part in content.figures if part.item.id == "initial_state").rows[0]
    (row,) = (row for row in rows if "as printed" in row.label)
    assert row.estimate is None
    assert row.outcome == "diverged at step 7"


def test_projectors_look_the_same_everywhere_and_differ():
    assert len({(COLOURS[name], MARKERS[name]) for name in COLOURS}) == len(COLOURS)
    alike = looks_of([{"projector": "known"}, {"projector": "known"}, {"projector": "none"}])
    assert alike[0].colour == alike[1].colour != alike[2].colour
    assert alike[0] != alike[1]


@pytest.mark.parametrize("lines", [True, False])
def test_no_two_methods_look_alike(lines):
    """Variants of one look never meet the plain look of another, however many there are."""
    choices = ((*COLOURS, "mine", "yours"), (None, "post_hoc", "convex", "clean_estimate"), ("free", "fixed"))
    axes = [
        dict(zip(("projector", "enforcement", "initial_state"), c, strict=True)) for c in itertools.product(*choices)
    ]
    looks = looks_of(axes, lines=lines)
    assert len({(look.colour, look.marker, str(look.line), look.fill) for look in looks}) == len(axes)


def linear(colour: str) -> np.ndarray:
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of linear sRGB, white D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    share = to_xyz @ np.clip(rgb, 0, 1) / to_xyz.sum(axis=1)
    f = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


SIGHT = {  # Machado, Oliveira & Fernandes (2009), at full severity
    "usual": np.eye(3),
    "deuteranopia": np.array([[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]]),
    "protanopia": np.array([[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]]),
}
PAGES = {"light": ("#ffffff", "#1e1f21"), "dark": ("#16181b", "#e6e7e9")}
"""Page and ink of the two schemes, as in the template."""


@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize("page", PAGES)
def test_colours_are_told_apart(sight, page):
    inks = [PAGES[page][1] if colour == INK else colour for colour in (*COLOURS.values(), OTHER[0])]
    seen = [lab(SIGHT[sight] @ linear(colour)) for colour in inks]
    apart = [np.linalg.norm(a - b) for k, a in enumerate(seen) for b in seen[:k]]
    assert min(apart) > 20


@pytest.mark.parametrize("page", PAGES)
def test_colours_stand_out_from_the_page(page):
    background = linear(PAGES[page][0]) @ [0.2126, 0.7152, 0.0722]
    for colour in (*COLOURS.values(), OTHER[0]):
        luminance = linear(PAGES[page][1] if colour == INK else colour) @ [0.2126, 0.7152, 0.0722]
        light, dark = max(background, luminance), min(background, luminance)
        assert (light + 0.05) / (dark + 0.05) >= 3, colour


def test_rounding_leaves_the_limits_alone_and_is_drawn_at_the_edge(tmp_path):
    store, shape = MadeUp(tmp_path), np.where(np.arange(11) == 0, 1e-30, 1.0)
    store.run(1.0)
    store.run(0.2, shape=shape, projector="known", enforcement="normalised")
    store.sweep()
    seen = Evidence(read_sweeps(tmp_path, [store.name]))
    errors = build(load("default"), seen, [], "").figures[0].content
    with matplotlib.rc_context(RC):
        ax = errors.draw(2).axes[0]
    assert ax.get_ylim()[0] > 1e-2
    assert any(line.get_marker() == CARETDOWN and len(line.get_xdata()) == 1 for line in ax.lines)


def test_curves_that_coincide_are_one_and_the_figure_says_what_it_found(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0, spread=0)
    for projector in ("known", "hankel"):
        store.run(0.2, spread=0, projector=projector, enforcement="normalised")
    store.sweep()
    errors = build(load("default"), Evidence(read_sweeps(tmp_path, [store.name])), [], "").figures[0].content
    assert [curve.label for curve in errors.panels[0].curves] == ["vanilla", "known FF† = Hankel HH†"]
    assert errors.found == "Lowest state error: known FF† = Hankel HH†, 0.20 × vanilla"


def test_axes_can_be_linear():
    content = build(load("lqr"), evidence("lqr_made_up"), [], "").figures[0].content
    assert render(content, 2, ("svg",), linear=True)["svg"] != render(content, 2, ("svg",))["svg"]


def test_published_drawings_hold_no_names_that_are_meant_for_the_page(report):
    for path in (report / "figures").glob("*.svg"):
        assert b"method:" not in path.read_bytes()
    assert 'data-method="vanilla"' in (report / "index.html").read_text()


@pytest.mark.parametrize(
    ("metric", "value", "words"),
    [("cost_ratio", 1.25, "0.250"), ("gap", 1e-29, "exact"), ("collision_rollout", 0.0, "0"), ("gap", 0.5, "0.500")],
)
def test_columns_show_what_lies_above_the_floor(metric, value, words):
    assert labels.column_value(metric, value, value, value) == words


def test_phones_get_one_column():
    content = build(load("lqr"), evidence("lqr_made_up"), [], "")
    with matplotlib.rc_context(RC):
        wide, narrow = (content.figures[0].content.draw(columns).get_size_inches() for columns in (2, 1))
    assert narrow[0] < 4.2 < wide[0]


def test_pictures_are_free_of_dates():
    content = build(load("lqr"), evidence("lqr_made_up"), [], "").figures[0].content
    for data in render(content, 2, ("pdf", "svg", "png")).values():
        assert b"Matplotlib" not in data
        assert b"CreationDate" not in data


def test_replicates_are_pooled_and_paired_by_seed():
    methods = {m.axes.get("enforcement"): m for m in evidence("lqr_made_up").methods({"projector": "known"})}
    assert len(methods["post_hoc"].finished) == 3
    partner = evidence("lqr_made_up").partner(methods["post_hoc"], {"projector": "none"})
    own, theirs = pair(methods["post_hoc"], partner)
    assert [cell.axes["seed"] for cell in own.cells] == [cell.axes["seed"] for cell in theirs.cells] == [0, 1, 2]
    assert own.levels == ("seed",)
    assert own.nested
    assert own.scalars("planned_state_error").values.shape == (3, 6)


@pytest.mark.parametrize(
    ("seeds", "levels", "places"),
    [
        ([{"seed": 0, "dataset.seed": 0}], ("seed",), [0]),
        ([{"seed": s, "training.seed": s} for s in (0, 1)], ("seed",), [0, 1]),
        ([{"seed": s, "recording.seed": r} for s in (0, 1) for r in (5, 6)], ("seed", "recording"), [[0, 1], [2, 3]]),
        ([{"training.seed": s, "recording.seed": r} for s, r in ((1, 5), (0, 5), (0, 6), (1, 6), (2, 6))],
         ("training seed", "recording"), [[1, 2], [0, 3]]),
        ([{"seed": s, "recording.seed": r} for s, r in enumerate((0, 1, 1, 2, 3))], ("run",), [*range(5)]),
    ],
)  # fmt: skip
def test_runs_stand_in_a_grid_by_what_was_drawn_anew(seeds, levels, places):
    found = grid(seeds)
    assert found[0] == levels
    assert sorted(found[1].ravel().tolist()) == sorted(np.ravel(places).tolist())
    assert found[1].shape == np.shape(places)


def test_recordings_are_a_factor_beside_the_trained_network(tmp_path):
    store = MadeUp(tmp_path)
    for seed in range(3):
        store.run(1.0, seed=seed)
        for recording, level in enumerate((0.3, 0.6, 1.2, 2.4)):
            store.run(level, projector="hankel", enforcement="normalised", seed=seed, recording__length=100,
                      recording__seed=recording)  # fmt: skip
    store.sweep()
    vanilla, hankel = Evidence(read_sweeps(tmp_path, [store.name])).all_methods
    own, theirs = pair(hankel, vanilla)
    assert (own.levels, own.cells.shape) == (("seed", "recording"), (3, 4))
    assert (theirs.levels, theirs.cells.shape) == (("seed",), (3,))
    estimate = ratio(own.scalars("gap"), theirs.scalars("gap"))
    assert estimate.value == pytest.approx(np.sqrt(0.3 * 2.4), rel=0.1)
    assert estimate.low < 0.4


def test_presets_go_by_the_projector_that_they_set(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0)
    store.run(0.1, projector="known_fixed", enforcement="normalised", initial_state="fixed")
    store.sweep()
    everything = Evidence(read_sweeps(tmp_path, [store.name]))
    (fixed,) = everything.methods({"projector": "known", "initial_state": "fixed"})
    assert everything.partner(fixed, {"projector": "none"}) is not None


def test_robots_by_group():
    method = evidence("fleet_made_up").methods({"projector": "none"})[0]
    everyone = method.runs.scalars("cost_ratio").values
    groups = [method.runs.scalars("cost_ratio", group).values for group in ("interpolation", "extrapolation")]
    assert everyone.shape == (1, 8, 4)
    np.testing.assert_array_equal(np.concatenate(groups, axis=1), everyone)


def test_cases_of_different_data_are_not_paired(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0)
    key = store.run(1.0, projector="known", enforcement="normalised")
    path = tmp_path / "runs" / key / "run.json"
    path.write_text(path.read_text().replace('"data0"', '"other"'))
    store.sweep()
    everything = Evidence(read_sweeps(tmp_path, [store.name]))
    with pytest.raises(StoreError, match="data sets differ"):
        pair(*everything.all_methods)


def test_labels_say_the_least_that_tells_methods_apart():
    methods = evidence("hankel_length_made_up").methods({"projector": ["hankel", "hankel_lowrank"]})
    assert varying(methods) == ["projector", "recording.length"]
    assert labels.method_name(methods[0].axes, varying(methods)) == "Hankel HH†, S = 100"


def test_rows_that_are_missing_from_a_table_are_an_error(tmp_path):
    store = MadeUp(tmp_path)
    key = store.run(1.0)
    store.sweep()
    (cell,) = read_sweeps(tmp_path, [store.name]).cells
    Results(tmp_path).write(Results(tmp_path).read(key).record, tables={"per_step": cell.table("per_step").iloc[:-1]})
    shutil.copytree(tmp_path, tmp_path.with_name("copy"))
    everything = Evidence(read_sweeps(tmp_path.with_name("copy"), [store.name]))
    with pytest.raises(StoreError, match="expected each once"):
        everything.all_methods[0].runs.curves("gap")


def test_an_unknown_sweep_names_those_that_exist(capsys):
    assert cli.main(["nonesuch", "--output-dir", str(STORE)]) == 1
    message = capsys.readouterr().err
    assert "holds no sweep 'nonesuch'; found fleet_made_up, hankel_length_made_up, lqr_made_up" in message


def test_an_empty_store(tmp_path, capsys):
    assert cli.main(["lqr_quick", "--output-dir", str(tmp_path)]) == 1
    assert "found none; run `dadiff +sweeps=lqr_quick`" in capsys.readouterr().err


def test_a_sweep_without_any_result_is_a_report_that_says_so(tmp_path):
    store = MadeUp(tmp_path)
    store.run(stored=False)
    store.sweep()
    assert cli.main([store.name, "--output-dir", str(tmp_path)]) == 0
    page = (tmp_path / "reports" / store.name / "index.html").read_text()
    assert "1 cells, 0 finished" in page
    assert "not tested here" in page


def test_a_store_of_a_newer_version(tmp_path, capsys):
    store = MadeUp(tmp_path)
    key = store.run(1.0)
    store.sweep()
    path = tmp_path / "runs" / key / "run.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    assert cli.main([store.name, "--output-dir", str(tmp_path)]) == 1
    assert "has format 2, this version reads up to 1; update dadiff" in capsys.readouterr().err


def test_several_sweeps_make_one_report():
    both = Evidence(read_sweeps(STORE, ["lqr_made_up", "obstacles_made_up"]))
    figures = {part.item.id: part for part in build(load("quick"), both, [], "").figures}
    assert figures["lqr_errors"].runs
    assert figures["obstacle_errors"].runs


def test_definitions_are_checked():
    assert "lqr" in names()
    for name in names():
        for item in (*load(name).figures, *load(name).tables):
            assert item.collect
    with pytest.raises(ConfigError, match=r"unknown kind 'pie'; expected against, boundary, chain, diffusion"):
        _ = Item("a", "b", kind="pie").collect
    with pytest.raises(
        ConfigError, match="report item a: missing a required argument: 'rows'; see the options of kind 'matrix'"
    ):
        _ = Item("a", "b", kind="matrix", options={"metrix": "gap"}).collect
    with pytest.raises(ConfigError, match="no report definition 'nonesuch'; found"):
        load("nonesuch")


@pytest.mark.parametrize(
    ("selector", "meets"),
    [
        ({"a": 1}, True),
        ({"a": [2, 1]}, True),
        ({"b": None}, True),
        ({"a": {"above": 0, "below": 2}}, True),
        ({"a": {"not": [1, 2]}}, False),
        ({"b": {"above": 0}}, False),
    ],
)
def test_selectors(selector, meets):
    assert matches({"a": 1}, selector) is meets


def test_a_misspelt_comparison_is_named():
    with pytest.raises(ConfigError, match="unknown comparison 'abvoe'"):
        matches({"a": 1}, {"a": {"abvoe": 0}})


def test_reports_need_no_torch(tmp_path):
    code = "import sys; from dadiff.reporting.cli import main; print(main(sys.argv[1:]), 'torch' in sys.modules)"
    arguments = ["hankel_length_made_up", "--output-dir", str(STORE), "--out", str(tmp_path)]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-2:] == ["0", "False"]


def test_the_json_keeps_its_words_and_has_a_list_of_numbers_on_a_line():
    content = {"lines": ["between [0.1, 0.2]"], "values": [1.23456789, 2, None], "none": []}
    text = slim.numbers(content)
    assert '"between [0.1, 0.2]"' in text
    assert json.loads(text) == {**content, "values": [1.23457, 2, None]}
    assert json.loads(slim.numbers({"cost": 1.000006412345, "low": 0.99123456}))["cost"] == 1.000006412
    deep = {"figures": {"errors": {"content": {"values": [1.0, 2.0], "labels": ["a", "FF†"]}}}}
    assert '"content": {"values":[1.0,2.0],"labels":["a","FF†"]}' in slim.numbers(deep)


def test_the_json_of_a_figure_has_the_digits_that_are_seen_and_leaves_axes_to_the_configurations():
    content = {"curve": [1.234567] * 9, "few": [1.234567], "value": 1.2345678, "axes": {"projector": "known"}}
    (found,) = json.loads(slim.numbers({"figures": {"errors": {"content": content}}}))["figures"].values()
    assert found["content"] == {"curve": [1.23] * 9, "few": [1.23457], "value": 1.23457}


def test_many_dots_are_strokes_at_their_places():
    figure = Figure()
    places = np.random.default_rng(0).random((2, 50))
    figure.subplots().plot(*places, ".", mew=0, alpha=0.6)
    stream = io.BytesIO()
    figure.savefig(stream, format="svg")
    small = drawings.smaller(stream.getvalue())
    pairs = re.findall(
        r'<use xlink:href="#m\w+" x="([\d.]+)" y="([\d.]+)" style="fill: #1f77b4', stream.getvalue().decode()
    )
    layers = [list(drawings.segments(data, 1))[::2] for data in re.findall(r'd="((?:m[^"a-z]+h0)+)"', small.decode())]
    assert len(pairs) == 50
    assert len(layers) == drawings.LAYERS
    (rounded,) = re.findall(r"\.(\w+)\{stroke-linecap:round\}", small.decode())
    assert len(re.findall(rf'h0" class="{rounded}"/>', small.decode())) == drawings.LAYERS
    for k, layer in enumerate(layers):
        asked = np.array(pairs[k :: drawings.LAYERS], float)
        drawn = np.array([place for _, place in layer]) / 10
        assert np.abs(asked[:, None] - drawn).max(axis=-1).min(axis=-1).max() < 0.26
    assert drawings.smaller(small) == small


@pytest.mark.parametrize(
    ("data", "small"),
    [
        ("M 1.04 2 L 3 2.06 L 3 2.06 L 3 5 z", "m1 2l2 .1v2.9z"),
        ("M1 1M2 2L3 3", "m1 1m1 1l1 1"),
        ("M0 0C1 1 2 2 3.333 3M1 1L1 1", "m0 0c1 1 2 2 3.3 3m-2.3-2h0"),
        ("m1 2-.5.5h1v-1", "m1 2l-.5 .5h1v-1"),
        ("M3 1L3 1M1 1L1 1M1.02 1L1.02 1", "m1 .8h0m2 0h0"),
    ],
)
def test_paths_go_from_place_to_place(data, small):
    svg = f'<svg xmlns="http://www.w3.org/2000/svg"><path d="{data}"/></svg>'.encode()
    found = re.search(r' d="([^"]*)"', drawings.smaller(svg).decode())
    assert found[1] == small


def test_a_drawing_in_fewer_bytes_is_the_same_drawing():
    figure = load("fleet").figures[0]
    drawn = render(figure.collect(evidence("fleet_made_up"), **figure.options), 2, ("svg",))["svg"]
    small = drawings.smaller(drawn)
    assert len(small) < 0.5 * len(drawn)
    assert drawings.smaller(small) == small
    text = b'<svg xmlns="http://www.w3.org/2000/svg"><text>0.00632 of 1.2345 </text></svg>'
    assert drawings.smaller(text) == text
    before, after = (ElementTree.fromstring(content) for content in (drawn, small))
    words = [
        [(text.text, float(text.get("x", 0))) for text in tree.iter("{http://www.w3.org/2000/svg}text")]
        for tree in (before, after)
    ]
    assert [word for word, _ in words[0]] == [word for word, _ in words[1]]
    np.testing.assert_allclose(*[[x for _, x in found] for found in words], atol=0.051)
    ends = [np.array([_end(line) for line in tree.iter(LINE) if "url" in line.get("clip-path", "")])
            for tree in (before, after)]  # fmt: skip
    np.testing.assert_allclose(*ends, atol=0.11)


LINE = "{http://www.w3.org/2000/svg}path"


def _end(line: ElementTree.Element) -> list[float]:
    """Where a path ends, in points."""
    return [number / 100 for number in [*drawings.segments(line.get("d"), 2)][-1][1][-2:]]


def test_the_boundary_lies_where_a_recording_stops_helping(tmp_path):
    store = MadeUp(tmp_path, "recordings_made_up")
    store.run(1.0)
    for noise in (0.001, 0.05):
        for length in (100, 300):
            level = 0.3 if noise * 100 < length / 300 else 3.0
            store.run(level, projector="hankel_lowrank", enforcement="normalised", recording__length=length,
                      recording__process_noise=noise)  # fmt: skip
    store.run(status="failed", reason="refused", projector="hankel", enforcement="normalised", recording__length=100,
              recording__process_noise=0.001)  # fmt: skip
    store.sweep()
    content = build(load("recordings"), Evidence(read_sweeps(tmp_path, [store.name])), [], "")
    drawn = content.figures[0].content
    assert (drawn.rows, drawn.columns) == ([0.001, 0.05], [100, 300])
    (panel,) = drawn.panels
    ratios = [[round(e.value, 1) for e in row] for row in panel.ratios]
    assert ratios == [[0.3, 0.3], [3.0, 3.0]]
    assert drawn.found == "Clearly better than vanilla: Hankel, truncated in 2 of 4"
    with matplotlib.rc_context(RC):
        figure = drawn.draw(2)
    assert [list(line.get_ydata()) for line in figure.axes[0].lines] == [[0.5, 0.5]] * 2
    assert drawn.notes == ["Hankel HH†: failed: refused"]


def test_a_definition_may_be_somebodys_own_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("title: Mine\ntables:\n  - {id: a, title: b, options: {metrics: [gap], cells: {}}}\n")
    out = ["--output-dir", str(STORE), "--out", str(tmp_path / "out")]
    assert cli.main(["lqr_made_up", "--definition", str(path), *out]) == 0
    assert "<h1>Mine</h1>" in (tmp_path / "out" / "index.html").read_text()
    with pytest.raises(ConfigError, match="there is no such file"):
        load(str(tmp_path / "other.yaml"))


def test_scores_of_own_tasks_stand_in_the_default_table(tmp_path):
    store = MadeUp(tmp_path)
    store.run(1.0, per_plan={"apples": 3.0})
    store.sweep()
    table = build(load("default"), Evidence(read_sweeps(tmp_path, [store.name])), [], "").tables[0].content
    assert table.metrics[-1] == "apples"
    assert table.rows[0].values["apples"].mean.value > 0


def test_where_a_log_lies_is_not_told(tmp_path):
    store = MadeUp(tmp_path)
    store.run(status="failed", reason="too short; log: /some/place/of/one/machine.log")
    store.sweep()
    (cell,) = read_sweeps(tmp_path, [store.name]).cells
    assert cell.outcome == "failed: too short"


def test_the_command_ends_with_what_was_found_and_compares(tmp_path, capsys):
    for name, level in (("one", 0.2), ("two", 0.5)):
        store, size = MadeUp(tmp_path, name, cases=20), {"dataset__train_size": int(100 * level)}
        store.run(1.0, **size)
        store.run(level, projector="known", enforcement="normalised", **size)
        store.sweep()
    assert cli.main(["one", "--output-dir", str(tmp_path), "--against", "two"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("Helps: 1 of 1 methods have a state error clearly below that of vanilla")
    assert any(line.startswith("Against two: ") for line in told)
    assert any(line.startswith("outside: known FF†, state error") for line in told)
    assert told[-1].startswith("report: ")
    folder = tmp_path / "reports" / "one"
    rows = list(csv.DictReader((folder / "against.csv").open()))
    assert {row["within"] for row in rows} == {"True", "False"}
    assert cli.main(["one", "--output-dir", str(tmp_path), "--against", str(folder)]) == 0
    again = capsys.readouterr().out
    assert f"Against one: {len(rows)} of {len(rows)} numbers lie within its intervals." in again


def test_reports_without_a_method_in_common_are_said_to_be_so(tmp_path):
    here, there = ({"sweep": "s", "tables": {"all": {"content": {"metrics": ["gap"], "rows": rows}}}} for rows in (
        [{"label": "known FF†", "values": {}}],
        [{"label": name, "values": {}} for name in ("vanilla", "Hankel HH†", "roll-out")],
    ))  # fmt: skip
    (told,) = compared(here, there, tmp_path / "against.csv")
    assert told == "Against s: no number in common; methods there are vanilla; Hankel HH†; …, here known FF†"

"""The table of `make bench`: ratios and exponents are what their names say; nothing here is timed."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import bench.__main__ as command
from bench.learning import CONDITION, LAYOUT, products, shapes
from bench.peers import ConvolutionNetwork, ancestral_chain
from bench.rows import Row, least
from bench.show import draw, markdown, slope, table
from dadiff.denoisers import MLP
from dadiff.diffusion.schedule import paper_linear
from dadiff.trajectory import TrajectoryLayout

ROWS = [
    Row("a step", 2.0, "ms", "a slower one", 6.0),
    Row("growing", 8.0, "s", points=[(1.0, 1.0), (2.0, 4.0), (4.0, 16.0)]),
]


def test_a_ratio_says_how_many_times_faster_ours_is():
    assert ROWS[0].ratio == 3.0
    assert ROWS[1].ratio is None


def test_the_slope_is_the_exponent():
    assert slope(ROWS[0]) is None
    np.testing.assert_allclose(slope(ROWS[1]), 2.0)


def test_table_figure_and_file_hold_every_row(tmp_path):
    shown = table(ROWS)
    assert "3.00" in shown
    assert "exponent 2.00" in shown
    assert Row(**json.loads(json.dumps(asdict(ROWS[0])))) == ROWS[0]
    shown = markdown(ROWS, "2 cores, load 0.0 before")
    assert "| a step | 2 ms | 6 ms | 3.00 | a slower one |" in shown
    assert "load 0.0 before" in shown
    draw(ROWS, tmp_path / "bench.svg")
    assert (tmp_path / "bench.svg").read_text().count("a slower one") >= 1


def test_the_published_table_is_that_of_the_published_numbers():
    docs = Path(__file__).parent.parent / "docs"
    told = json.loads((docs / "bench.json").read_text())
    rows = [Row(**{name: value for name, value in row.items() if name != "ratio"}) for row in told["rows"]]
    assert (docs / "bench.md").read_text() == markdown(rows, told["machine"])


def test_what_is_kept_in_the_documents_is_told_there(tmp_path, monkeypatch):
    docs, beside = tmp_path / "docs", replace(ROWS[0], name="one plan, mlp, processor time, 5 calls")
    (tmp_path / "reports" / "published").mkdir(parents=True)
    docs.mkdir()
    (docs / "speed.md").write_text("<!-- bench: alone -->\n<!-- end -->\n<!-- bench: beside -->\n<!-- end -->\n")
    monkeypatch.setattr(command, "DOCS", docs)
    monkeypatch.setattr(command, "measured", lambda part: [*ROWS, beside])
    command.measure(["learning"], docs)
    told = (docs / "speed.md").read_text()
    assert "| growing | 8 s |" in told
    assert "| one plan, mlp, 5 calls | 0.33 | a slower one |" in told


def test_a_steps_products_are_those_of_its_layers():
    layers = shapes(MLP(width=16, blocks=1), batch=3)
    assert layers[-3:] == [(3, 16, 16, True), (3, 16, 16, True), (3, 16, LAYOUT.size, True)]
    assert {(K, asked) for _, K, _, asked in layers[:-3]} == {
        (LAYOUT.size, False),
        (64, False),
        (CONDITION.size, False),
    }
    products(layers)()


def test_least_takes_actions_in_turn():
    seen = []
    assert len(least(lambda: seen.append("a"), lambda: seen.append("b"), repeats=2)) == 2
    assert seen == ["a", "b", "a", "b"]


def test_the_reference_chain_projects_as_the_papers_does():
    """At the last step beta_0 = 0, so what comes out of a whole chain lies in the image."""
    torch = pytest.importorskip("torch")
    layout, schedule = TrajectoryLayout(2, 1, 4), paper_linear(20, 1 / 20)
    basis = torch.linalg.qr(torch.randn(layout.size, 6, generator=torch.Generator().manual_seed(0)))[0]
    network = ConvolutionNetwork(layout, 3, channels=8, latent=4)
    tau = ancestral_chain(network, schedule, basis @ basis.T, torch.zeros(5, 3), 20)
    assert tau.shape == (5, layout.size)
    np.testing.assert_allclose(tau @ basis @ basis.T, tau, atol=1e-4)

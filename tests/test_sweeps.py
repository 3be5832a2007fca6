"""Laws of sweeps: each key once, what is shared built once, what is done left alone, what failed done again."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode

from dadiff.config.composed import plain
from dadiff.folders import shipped
from dadiff.launching import register
from dadiff.launching.composing import Composer
from dadiff.launching.outcome import Outcome, why
from dadiff.launching.plan import describe, make_plan
from dadiff.launching.sweep import SweepRun, summary
from dadiff.store import Cache, Results, Sweeps
from dadiff.sync import sync
from dadiff.tracking.client import open_client

TINY = [
    "dataset.train_size=60", "dataset.test_size=2", "evaluation.samples=2", "sampler=ddim", "sampler.num_steps=4",
    "denoiser.width=8", "denoiser.blocks=1", "training.steps=3", "training.warmup=1", "training.batch_size=8",
    "device=cpu", "progress=false",
]  # fmt: skip
CELLS = [
    ["projector=known"],
    ["projector=none", "enforcement=normalised"],
    ["projector=none", "enforcement=convex"],  # the same run: nothing is projected
    ["projector=identified", "recording=npz", "recording.path={root}/recordings"],  # a damaged file
    ["projector=hankel", "recording.length=20"],  # too short: refused, which is a result
]


@pytest.fixture(scope="module", autouse=True)
def _registered():
    register()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


def configs(root: Path, cells: Sequence[Sequence[str]] = CELLS) -> list[dict]:
    with initialize_config_dir(str(shipped("conf").absolute()), version_base="1.3"):
        (root / "recordings").mkdir(parents=True, exist_ok=True)
        (root / "recordings" / "damaged.npz").write_bytes(b"PK")
        told = [[part.format(root=root) for part in (*TINY, *cell, "output_dir={root}")] for cell in cells]
        composed = [compose("config", cell, return_hydra_config=True) for cell in told]
        return [plain(config, config.hydra.runtime.choices) for config in composed]


def run_here(run: SweepRun) -> dict[str, Outcome]:
    """Do the sweep's work in this process, as the launcher's pool does it in others."""
    cells = {cell.identity.key: cell for cell in run.plan.cells}
    run.begin()
    parent, outcomes = run.open(), {}
    for work in run.works():
        try:
            work.function(*work.arguments)
            outcomes[work.key] = Outcome("finished", None, 0.0)
        except Exception as error:
            outcomes[work.key] = Outcome(*why(error), 0.0)
        if work.key in cells:
            run.ended(cells[work.key], outcomes[work.key])
        run.mirror(work.key, parent)
    run.close(outcomes, interrupted=False)
    return outcomes


@pytest.fixture(scope="module")
def first(root):
    run = SweepRun.of(make_plan(configs(root)), "quick", "dadiff +sweeps=quick", {"projector": "known,none,hankel"})
    return run, run_here(run)


VALUES = [
    ["seed=0", "seed=3", "seed=true"],
    ["++recording.seed=0", "++recording.seed=5"],
    ["system.process_noise=0.1", "system.process_noise=0.2"],  # which the recording reads in an expression
    ["output_dir=here", "output_dir=there"],  # which the store's address reads
    ["evaluation.seed=1", "evaluation.seed=${dataset.seed}"],  # a value that reads another one
    ["task.state_cost=[1,2,3,4]", "task.state_cost=1.0", "task.state_cost=null"],
    ["training.steps=3", "training.steps=3.0"],
]


@pytest.mark.parametrize("projector", ["known", "hankel"])
def test_cells_are_composed_as_hydra_composes_each_anew(projector):
    with initialize_config_dir(str(shipped("conf").absolute()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        composer = Composer(loader, loader.load_configuration("config", [], RunMode.MULTIRUN))
        for k in range(3):
            for moved in range(len(VALUES)):
                chosen = [values[k % len(values) if row == moved else 0] for row, values in enumerate(VALUES)]
                cell = [f"projector={projector}", *chosen]
                config = compose("config", cell, return_hydra_config=True)
                assert composer.cell(cell) == plain(config, config.hydra.runtime.choices), cell


def test_a_plan_has_each_key_once_and_builds_what_is_shared_first(tmp_path):
    plan = make_plan(configs(tmp_path))
    assert [cell.copies for cell in plan.cells] == [1, 2, 1, 1]
    assert [p.artefact.kind for p in plan.preparations] == ["demonstrations", "denoiser", "cases"]
    demonstrations, denoiser, cases = (p.artefact.key for p in plan.preparations)
    assert plan.preparations[1].needs == {demonstrations}
    assert plan.needs(plan.cells[0]) == {demonstrations, denoiser, cases}
    text = describe(plan)
    assert "4 runs, 0 done, 4 to run" in text
    assert "(2 times in the sweep)" in text
    assert f"denoiser {denoiser} is shared by 4 runs" in text
    assert f"would train denoiser {denoiser}" in text


def test_what_succeeds_is_stored_and_what_fails_is_recorded_with_its_reason(first, root):
    run, outcomes = first
    sweep = Sweeps(root).read("quick")
    assert [cell.status for cell in sweep.cells] == ["finished", "finished", "failed", "refused"]
    assert "damaged.npz: is not a readable .npz file" in sweep.cells[2].reason
    failed = Results(root).read(sweep.cells[2].key)
    assert (failed.status, failed.record.reason) == ("failed", sweep.cells[2].reason)
    assert [entry.kind for entry in Cache(root).entries()] == ["cases", "demonstrations", "denoiser"]
    assert len(outcomes) == 7
    text = summary(sweep, 0, run.folder)
    assert "2 finished, 1 failed, 1 refused" in text
    assert "dadiff +sweeps=quick" in text


def test_mlflow_shows_the_sweep_its_runs_and_the_training(first, root):
    run, _ = first
    client, experiment = open_client(run.tracking.uri), run.tracking._experiment_id
    mirrors = {r.info.run_name: r for r in client.search_runs([experiment])}
    kinds = sorted(mirror.data.tags["kind"] for mirror in mirrors.values())
    assert kinds == ["run", "run", "run", "run", "sweep", "training"]
    assert {mirror.info.status for mirror in mirrors.values()} == {"FINISHED", "FAILED"}
    parent = mirrors["quick"].info.run_id
    children = [m for m in mirrors.values() if m.data.tags["kind"] == "run"]
    assert {child.data.tags["mlflow.parentRunId"] for child in children} == {parent}
    training = next(m for m in mirrors.values() if m.data.tags["kind"] == "training")
    finished = [child for child in children if child.data.tags["status"] == "finished"]
    assert {child.data.tags["link.denoiser"] for child in finished} == {training.data.tags["key"]}


def test_a_rerun_does_only_what_failed(first, root):
    run = SweepRun.of(make_plan(configs(root)), "quick", "dadiff", {})
    assert [cell.identity.name.split("/")[1] for cell in run.plan.waiting] == ["identified"]
    assert run.plan.preparations == []
    assert len(run.works()) == 1


def test_a_sweep_whose_cells_are_done_has_nothing_to_do(first, root):
    run = SweepRun.of(make_plan(configs(root, CELLS[:3])), "over", "dadiff", {})
    assert run_here(run) == {}
    assert [cell.status for cell in Sweeps(root).read("over").cells] == ["finished"] * 2
    assert run.is_told()  # so that the same command answers without MLflow
    assert not replace(run, command="dadiff another").is_told()
    forced = make_plan(configs(root, [[*CELLS[0], "force=true"]]))
    assert len(forced.waiting) == 1


def test_choices_that_exclude_one_another_are_refused_as_a_result(root):
    cells = [["projector=known_fixed", "enforcement=literal"]]
    run = SweepRun.of(make_plan(configs(root, cells)), "excluding", "dadiff", {})
    assert [outcome.status for outcome in run_here(run).values()] == ["refused"]
    assert make_plan(configs(root, cells)).waiting == []


def test_sync_finds_nothing_missing_after_a_sweep(first, root):
    assert sync(root) == 0


def test_plans_are_made_without_torch_and_mlflow():
    code = (
        "import sys, dadiff.launching.processes, dadiff.launching.plan; "
        "sys.exit('torch' in sys.modules or 'mlflow' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

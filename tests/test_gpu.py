"""On a GPU: what the processor gives, from the same network and the same noise."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from laws import composed, presets
from safetensors.torch import load_file
from test_training import CONDITION, LAYOUT, RECIPES, SCHEDULE, Interrupt
from test_training import run as begun

import dadiff
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.store import StoredRun

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]

SMALL = [
    "training.steps=60",
    "dataset.train_size=150",
    "dataset.test_size=2",
    "evaluation.samples=2",
    "sampler.num_steps=5",
    "progress=false",
    "tracking.enabled=false",
]
TASKS = {
    "lqr": ["task.horizon=10", "recording.length=100"],
    "fleet": ["task.robots=8", "task.interpolation=2", "task.extrapolation=1", "task.horizon=10"],
    "manoeuvre": ["task.robots=4", "task.interpolation=2", "task.extrapolation=1", "task.horizon=10"],
    "obstacles": ["dataset.train_size=40"],
}
BOUNDED = ["projector=known_bounded", "system.bounds={input_low: -2, input_high: 2}"]
QUADROTOR = [
    "recording=quadrotor",
    "recording.length=100",
    "projector.features=[identity,trigonometric,control_affine]",
    "projector.angles=[2]",
]
# What an enforcement or a projector asks for beside it; the others take LQR, known dynamics and a network.
ENFORCEMENTS = {
    "barrier": BOUNDED,
    "qp_filter": BOUNDED,
    "constricting_tube": BOUNDED,
    "post_hoc_repeated": ["task=manoeuvre"],
}
PROJECTORS = {
    **dict.fromkeys(["known_bounded", "known_tightened", "known_clipped", "known_clipped_replayed"], BOUNDED[1:]),
    "known_clear": ["task=obstacles"],
    "known_converged": ["task=manoeuvre"],
    "identified_family": ["task=fleet", "enforcement=conditional_soft"],
    **{
        learned: ["task=manoeuvre", *QUADROTOR]
        for learned in ("identified_control_affine", "identified_sparse", "identified_sparse_soft")
    },
    "koopman": ["task=manoeuvre", *QUADROTOR[:2], "projector.features=[trigonometric]", "projector.angles=[2]"],
    "koopman_trigonometric": ["task=manoeuvre", *QUADROTOR[:2], "projector.angles=[2]"],
    "nominal": ["task=fleet"],
    "hankel": ["recording.length=60"],
}
OTHERS = {
    "exact": ["denoiser=gaussian"],
    "moment matched": ["task=fleet", "denoiser=moment_matched", "projector=known_fixed"],
    "encoder_decoder": ["denoiser=encoder_decoder", "denoiser.channels=8"],
    "rounded training": ["training.precision=bfloat16"],
    "inputs alone": ["denoiser=mlp_inputs", "projector=rollout", "enforcement=clean_estimate"],
    "recording told": ["task=fleet", "task.condition_on=recording", "denoiser=mlp_recording", "projector=none"],
    "penalty": ["training=penalised", "projector=none"],
    "projected loss": ["training=projected", "enforcement=clean_estimate"],
    "regression": ["training=regression", "sampler=once", "projector=none"],
    "encoded": ["task=obstacles", "encoding=path_frame", "projector=known_fixed"],
    "whole chain": ["+preset=paper", "denoiser.channels=8", "schedule.num_steps=50"],
    "closed loop": ["evaluation=closed_loop", "evaluation.steps=6", "evaluation.replan_every=[3]"],
    "closed loop of nonlinear robots": [
        *("task=manoeuvre", "evaluation=closed_loop"),
        *("evaluation.steps=6", "evaluation.replan_every=[3]"),
    ],
}


def words(*chosen: str) -> list[str]:
    """The command, with a small task; a sampler that goes through the whole schedule has no number of steps."""
    task = next((word.partition("=")[2] for word in chosen if word.startswith("task=")), "lqr")
    own = any(word in ("sampler=once", "sampler=ddpm", "+preset=paper") for word in chosen)
    kept = [word for word in SMALL if not (own and word.startswith("sampler."))]
    given = {word.partition("=")[0] for word in chosen}
    return [*chosen, *(word for word in [*TASKS[task], *kept] if word.partition("=")[0] not in given)]


CASES = {
    **{f"enforcement={e}": [f"enforcement={e}", *ENFORCEMENTS.get(e, [])] for e in presets("enforcement")},
    **{f"projector={p}": [f"projector={p}", *PROJECTORS.get(p, [])] for p in presets("projector")},
    **{f"sampler={s}": [f"sampler={s}", "schedule.num_steps=50"] for s in presets("sampler")},
    **OTHERS,
}


def executed(config: dict[str, Any], folder: Path, device: str) -> StoredRun:
    return execute(Experiment.of(config | {"output_dir": str(folder), "device": device}))


@pytest.mark.parametrize("chosen", CASES.values(), ids=CASES)
def test_a_run_gives_what_the_processor_gives(chosen, tmp_path):
    """A network is trained on the processor; both plan with it."""
    config = composed(*words(*chosen))
    here = executed(config, tmp_path / "cpu", "cpu")
    shutil.copytree(tmp_path / "cpu" / "cache", tmp_path / "gpu" / "cache")
    there = executed(config, tmp_path / "gpu", "cuda")
    assert (there.status, there.record.reason) == (here.status, here.record.reason)
    assert here.metrics, "a run that gave no number shows nothing"
    assert there.record.provenance.device == "cuda"
    for name in ("planned_state_error", "planned_input_error", "rollout_state_error", "cost_ratio", "closed_cost"):
        if name in here.metrics:
            np.testing.assert_allclose(there.metrics[name], here.metrics[name], rtol=1e-3, err_msg=name)
    if here.metrics.get("gap", 1.0) < 1e-12:
        assert there.metrics["gap"] < 1e-12, "dynamics are obeyed to rounding in float64"


@pytest.mark.parametrize("recipe", ["mlp", "encoder_decoder"])
def test_a_training_sees_the_same_batches_and_ends_nearby(recipe, tmp_path):
    small = ["denoiser.channels=8"] if recipe == "encoder_decoder" else []
    config = composed(*words(f"denoiser={recipe}", *small))
    here, there = (executed(config, tmp_path / device, device) for device in ("cpu", "cuda"))
    assert here.key == there.key, "the device is not part of what is computed"
    np.testing.assert_allclose(there.metrics["planned_state_error"], here.metrics["planned_state_error"], rtol=2e-2)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: type(recipe).__name__)
def test_a_network_s_products_are_rounded_as_float32(recipe):
    """By default a GPU convolves in TF32, with ten bits."""
    generator = torch.Generator().manual_seed(0)
    network = recipe.build(LAYOUT, CONDITION, SCHEDULE, generator)
    tau, E = torch.randn(50, LAYOUT.size, dtype=torch.float64), torch.randn(50, CONDITION.size, dtype=torch.float64)
    here = network(tau, 5, E)
    there = network.to("cuda")(tau.cuda(), 5, E.cuda()).cpu()
    torch.testing.assert_close(there, here, rtol=1e-5, atol=2e-6)


def test_a_planner_plans_on_either_alike(tmp_path):
    run = executed(composed(*words("projector=known_fixed")), tmp_path, "cuda")
    plans = [
        dadiff.Planner.load(run.folder, device=device).plan(x_init=[0, 0, 0, 0], target=[1, 2, 0, 0], samples=3, seed=1)
        for device in ("cpu", "cuda")
    ]
    np.testing.assert_allclose(plans[1].states, plans[0].states, rtol=1e-4, atol=1e-5)


def test_a_training_that_was_begun_on_the_processor_goes_on_there(tmp_path):
    """Checkpoints are of no device."""
    with pytest.raises(KeyboardInterrupt):
        begun(tmp_path / "moved", augment=Interrupt(at=20))
    begun(tmp_path / "moved", device="cuda")
    begun(tmp_path / "stayed")
    moved, stayed = (load_file(tmp_path / folder / "model.safetensors") for folder in ("moved", "stayed"))
    for name, weights in stayed.items():
        torch.testing.assert_close(moved[name], weights, rtol=1e-3, atol=1e-4)

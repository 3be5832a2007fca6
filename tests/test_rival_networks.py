"""Rivals that are trained otherwise, or not at all: told of the dynamics, of the inputs alone, or cloned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dadiff.behaviours import RolloutProjector, Transitions, least_squares
from dadiff.control import Cloned, run
from dadiff.denoisers import MLP, InputsMLP
from dadiff.denoisers.learning import InformedObjective, Objective, train
from dadiff.denoisers.training import InformedTraining, Training
from dadiff.diffusion.enforcement import CleanEstimate
from dadiff.diffusion.samplers import DPMSolver
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import ConfigError
from dadiff.evaluation import ClosedLoop, replay
from dadiff.evaluation.closed_loop import Bench
from dadiff.planning import Planner
from dadiff.randomness import torch_generator
from dadiff.systems import double_integrator
from dadiff.tasks import LQR
from dadiff.trajectory.coordinates import physical

TASK, SYSTEM, SCHEDULE = LQR(horizon=6), double_integrator(process_noise=0.01), paper_linear(50, 0.02)
LAYOUT, CONDITION = SYSTEM.layout(6), TASK.condition(SYSTEM)
SHOWN = TASK.demonstrations(SYSTEM, 60, np.random.default_rng(0))
CASES = TASK.cases(SYSTEM, 3, np.random.default_rng(1))
DYNAMICS = least_squares(Transitions.of(*LAYOUT.split(SHOWN.trajectories))).stages(6).matrix(LAYOUT)
TRAINING = {"steps": 3, "batch_size": 16, "warmup": 0, "checkpoint_every": 10}


def network(recipe: MLP | None = None):
    generator = torch_generator(0, "initialisation")
    return (recipe or MLP(width=16, blocks=1)).build(LAYOUT, CONDITION, SCHEDULE, generator)


def batch():
    rng = np.random.default_rng(2)
    tau0, E = (torch.from_numpy(part[:8]).float() for part in (SHOWN.trajectories, SHOWN.environment))
    eps = torch.from_numpy(rng.standard_normal(tau0.shape)).float()
    return tau0, E, torch.from_numpy(rng.integers(1, 51, 8)), eps


def objective(**given: object) -> InformedObjective:
    return InformedObjective(MLP(), SCHEDULE, InformedTraining(**given), "cpu", *DYNAMICS)  # type: ignore[arg-type]


def test_told_nothing_it_is_the_plain_loss():
    plain = Objective(MLP(), SCHEDULE, Training(), "cpu")(network(), *batch())
    torch.testing.assert_close(objective()(network(), *batch()), plain)


def test_the_penalty_is_the_mean_square_of_the_residual():
    tau0, E, i, eps = batch()
    a = torch.from_numpy(SCHEDULE.alpha_bar).float()[i][:, None]
    tau0_hat = network().output(a.sqrt() * tau0 + (1 - a).sqrt() * eps, i, E).detach().numpy()
    found = least_squares(Transitions.of(*LAYOUT.split(SHOWN.trajectories)))
    x, u = LAYOUT.split(tau0_hat)
    missed = np.square(x[:, 1:] - x[:, :-1] @ found.A.T - u @ found.B.T).mean()
    plain, penalised = (objective(residual_weight=w)(network(), tau0, E, i, eps).item() for w in (0.0, 2.0))
    assert penalised - plain == pytest.approx(2 * missed, rel=1e-4)


def test_a_projected_loss_does_not_see_what_the_projection_takes_away():
    """It is the distance of P(tau0_hat) from tau_0, so that outputs may move freely across the dynamics."""
    made, data = network(), batch()
    loss = objective(projects=True)
    before = loss(made, *data).item()
    G, _ = DYNAMICS
    with torch.no_grad():
        made.network.output.bias += torch.from_numpy(G.T @ np.ones(len(G))).float()  # across G tau = g
    assert loss(made, *data).item() == pytest.approx(before, rel=1e-4)
    assert Objective(MLP(), SCHEDULE, Training(), "cpu")(made, *data).item() > 1.2 * before


@pytest.mark.parametrize("given", [{"residual_weight": 1.0}, {"projects": True}], ids=str)
def test_told_of_the_dynamics_a_network_trains(given, tmp_path: Path):
    training = InformedTraining(**TRAINING, **given)
    train(MLP(width=16, blocks=1), LAYOUT, CONDITION, SCHEDULE, training, SHOWN.trajectories, SHOWN.environment,
          tmp_path, dynamics=DYNAMICS, progress=False)  # fmt: skip
    assert (tmp_path / "model.safetensors").is_file()


def test_a_weight_without_meaning_is_refused():
    with pytest.raises(ConfigError, match="residual_weight is -1"):
        InformedTraining(residual_weight=-1.0)


def planner(denoiser) -> Planner:
    return Planner(
        TASK, SYSTEM, SCHEDULE, DPMSolver(5), denoiser, physical(LAYOUT), RolloutProjector().fit(LAYOUT, SYSTEM),
        CleanEstimate(), True,
    )  # fmt: skip


def test_a_diffusion_of_inputs_sees_no_states_and_keeps_the_dynamics():
    denoise = network(InputsMLP(width=16, blocks=1))
    tau, E = torch.from_numpy(SHOWN.trajectories[:4]), torch.from_numpy(SHOWN.environment[:4])
    other = tau.clone()
    other[:, LAYOUT.all_states] += 1.0
    torch.testing.assert_close(denoise(tau, 20, E), denoise(other, 20, E))
    other[:, LAYOUT.all_inputs] += 1.0
    assert not torch.allclose(denoise(tau, 20, E), denoise(other, 20, E))
    plans = planner(denoise).plan(CASES.environment, samples=2)
    np.testing.assert_allclose(plans.tau, replay(SYSTEM, LAYOUT, plans.tau, CASES.x_init), atol=1e-9)


def test_noise_of_states_that_are_not_seen_cannot_be_predicted():
    with pytest.raises(ConfigError, match="use clean"):
        InputsMLP(prediction="velocity")


def test_a_clone_of_the_expert_is_the_expert():
    """LQR's inputs are affine in state and goal at each time, so that regression finds them exactly."""
    calm = double_integrator(process_noise=0.0)
    goal = CONDITION.get(CASES.environment, "target")
    cloned = Cloned.of(LAYOUT, SHOWN.trajectories, CONDITION.get(SHOWN.environment, "target"), goal)
    episode = run(calm, cloned, CASES.x_init, 6)
    np.testing.assert_allclose(LAYOUT.flatten(episode.states, episode.inputs), CASES.reference, atol=1e-8)
    assert len(cloned.seconds) == 6


def test_it_is_run_in_closed_loop_beside_planners():
    evaluation = ClosedLoop(replan_every=(2,), controllers=("optimal", "cloned"), disturbance=0.0)
    bench = Bench(planner(network(InputsMLP(width=16, blocks=1))), CASES, evaluation, SHOWN)
    table = bench.table().groupby("controller")["cost_ratio"].mean()
    assert table["cloned"] == pytest.approx(1, abs=0.05)
    with pytest.raises(ConfigError, match="needs demonstrations"):
        replace(bench, demonstrations=None).table()

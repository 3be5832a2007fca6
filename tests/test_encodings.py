"""What a network is told of E: laws of every encoding in conf/, and of the denoiser that works with one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from laws import component, composed, presets, tolerance
from torch import Tensor

from dadiff.denoisers.encoded import EncodedDenoiser
from dadiff.diffusion.schedule import cosine
from dadiff.errors import ConfigError
from dadiff.evaluation.errors import dynamics_residual
from dadiff.planning import Planner
from dadiff.running.assembly import Experiment
from dadiff.running.experiment import execute
from dadiff.running.identity import identify
from dadiff.systems import double_integrator
from dadiff.tasks import LQR, Cases
from dadiff.tasks.encodings import Encoder, PathFrame
from dadiff.tasks.obstacles import Obstacles
from dadiff.trajectory.coordinates import standardised

SYSTEM, TASK = double_integrator(process_noise=0.0), Obstacles()
LAYOUT = SYSTEM.layout(TASK.horizon)
ENCODERS = {p: e for p in presets("encoding") if (e := component("encoding", p).encoder(TASK, SYSTEM))}

every_encoder = pytest.mark.parametrize("encoder", ENCODERS.values(), ids=ENCODERS)


@pytest.fixture(scope="module")
def cases() -> Cases:
    return TASK.cases(SYSTEM, 60, np.random.default_rng(0))


def with_obstacles(cases: Cases, change: Any) -> np.ndarray:
    """E with its obstacle slots (N, O, 4) changed."""
    E = cases.condition.unpack(cases.environment)
    return cases.condition.pack(**E | {"obstacles": change(E["obstacles"])})


def test_plain_tells_e_as_it_is() -> None:
    assert "plain" not in ENCODERS
    assert "path_frame" in ENCODERS


@every_encoder
def test_features_lie_in_their_layout_and_are_finite(encoder: Encoder, cases: Cases) -> None:
    features, reference = encoder.encode(cases.environment)
    assert features.shape == (60, encoder.layout.size)
    assert reference.shape == cases.reference.shape
    assert np.isfinite(features).all()


@every_encoder
def test_the_order_of_obstacles_does_not_count(encoder: Encoder, cases: Cases) -> None:
    features, reference = encoder.encode(cases.environment)
    again, same = encoder.encode(with_obstacles(cases, lambda slots: slots[:, ::-1]))
    np.testing.assert_allclose(again, features, atol=tolerance(size=4))
    np.testing.assert_array_equal(same, reference)


@every_encoder
def test_a_batch_gives_what_its_environments_give_alone(encoder: Encoder, cases: Cases) -> None:
    features, reference = encoder.encode(cases.environment)
    for i in (0, 7):
        alone, path = encoder.encode(cases.environment[[i]])
        np.testing.assert_allclose(alone[0], features[i], atol=tolerance(size=40))
        np.testing.assert_allclose(path[0], reference[i], atol=tolerance(size=40))


@every_encoder
def test_the_reference_is_a_trajectory_of_the_system_from_its_start(encoder: Encoder, cases: Cases) -> None:
    _, reference = encoder.encode(cases.environment)
    assert dynamics_residual(SYSTEM, LAYOUT, reference).max() < 1e-24
    np.testing.assert_allclose(LAYOUT.states(reference)[:, 0], cases.x_init, atol=1e-14)


def test_the_reference_is_the_optimum_where_nothing_is_in_the_way(cases: Cases) -> None:
    free = TASK.solve(SYSTEM, with_obstacles(cases, np.zeros_like))
    np.testing.assert_allclose(ENCODERS["path_frame"].encode(cases.environment)[1], free.reference, atol=1e-9)


def test_a_disc_far_away_is_as_good_as_none(cases: Cases) -> None:
    encoder = ENCODERS["path_frame"]
    nothing, _ = encoder.encode(with_obstacles(cases, np.zeros_like))
    far, _ = encoder.encode(with_obstacles(cases, lambda slots: np.full_like(slots, [40.0, 0.0, 0.5, 1.0])))
    np.testing.assert_allclose(far, nothing, atol=1e-12)
    assert np.abs(encoder.encode(cases.environment)[0] - nothing).max() > 0.1


def test_depth_is_how_far_the_path_enters_inflated_discs(cases: Cases) -> None:
    encoder = ENCODERS["path_frame"]
    features, reference = encoder.encode(cases.environment)
    problem = TASK.problem(TASK.decode(cases.environment), 0.1)
    depth = np.maximum(problem.penetration(LAYOUT.states(reference)[..., :2]), 0)
    np.testing.assert_allclose(encoder.layout.get(features, "depth")[..., 0], depth.sum(axis=2), atol=1e-12)


def test_one_disc_is_seen_in_the_direction_from_its_centre_to_the_path(cases: Cases) -> None:
    encoder = ENCODERS["path_frame"]
    disc = np.array([0.3, -0.2, 0.5, 1.0])
    features, reference = encoder.encode(
        with_obstacles(cases, lambda slots: np.where(np.arange(slots.shape[1])[:, None] == 0, disc, 0 * slots))
    )
    near, normal = (encoder.layout.get(features, name) for name in ("near", "near_normal"))
    away = LAYOUT.states(reference)[:, 2:, :2] - disc[:2]
    np.testing.assert_allclose(normal, near * away / np.linalg.norm(away, axis=-1, keepdims=True), atol=1e-12)


def test_what_path_frame_cannot_do_is_said() -> None:
    with pytest.raises(ConfigError, match="task LQR has no obstacle-free optimum; use task=obstacles"):
        PathFrame().encoder(LQR(), double_integrator())
    with pytest.raises(ConfigError, match="reach is 0"):
        PathFrame(reach=0.0)


# --- the denoiser ---------------------------------------------------------------------------------------------------


class Echo:
    """Stands for a network: gives back what it is asked with, and counts."""

    def __init__(self) -> None:
        self.made_from = None
        self.asked: list[tuple[Tensor, int, Tensor]] = []

    def __call__(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        self.asked.append((tau, i, environment))
        return tau

    estimate = __call__


def test_a_network_is_asked_with_differences_and_answers_with_one(cases: Cases) -> None:
    encoder, schedule, echo = ENCODERS["path_frame"], cosine(100), Echo()
    coordinates = standardised(LAYOUT, cases.reference)
    denoise = EncodedDenoiser(echo, encoder, coordinates, schedule)  # type: ignore[arg-type]
    E = torch.tensor(cases.environment)[:, None].repeat(1, 2, 1)
    features, reference = encoder.encode(cases.environment)
    r = torch.tensor(coordinates.to_scaled(reference))[:, None]
    tau, a = torch.randn(60, 2, LAYOUT.size, dtype=torch.float64), float(np.sqrt(schedule.alpha_bar[30]))
    torch.testing.assert_close(denoise(tau, 30, E), tau + (1 - a) * r)
    told = echo.asked[0][2]
    assert told.shape == (60, 2, encoder.layout.size)
    torch.testing.assert_close(told[:, 1], torch.tensor(features))
    denoise(tau, 29, E)
    assert echo.asked[1][2] is told, "encoded once for the same environments"
    at = tau.clone().requires_grad_()
    denoise.estimate(at, 30, E).sum().backward()
    torch.testing.assert_close(at.grad, torch.ones_like(tau))


SMALL = (
    "task=obstacles",
    "encoding=path_frame",
    "schedule=cosine",
    "denoiser.width=64",
    "denoiser.blocks=1",
    "training.steps=200",
    "training.learning_rate=3e-3",
    "training.warmup=20",
    "training.batch_size=128",
    "dataset.train_size=1000",
    "dataset.test_size=20",
    "evaluation.samples=2",
    "sampler=ddim",
    "sampler.num_steps=4",
    "projector=none",
    "device=cpu",
    "progress=false",
)


def test_a_short_training_already_beats_the_obstacle_free_optimum(tmp_path) -> None:
    """A real run; and the same model in a file, asked for new environments without its data set."""
    experiment = Experiment.of(composed(*SMALL, f"output_dir={tmp_path}"))
    stored = execute(experiment)
    _, free = experiment.encoder.encode(experiment.cases.environment)
    error = np.square(LAYOUT.states(free - experiment.cases.reference)).sum(axis=-1).mean()
    assert stored.metrics["planned_state_error"] < 0.8 * error
    fresh = TASK.cases(SYSTEM, 3, np.random.default_rng(9))
    plans = experiment.planner.plan(fresh.environment, seed=1)
    stored_planner = Planner.load(experiment.planner.save(tmp_path / "planner.zip"))
    np.testing.assert_array_equal(stored_planner.plan(fresh.environment, seed=1).tau, plans.tau)


def test_encoding_is_part_of_what_is_trained_and_not_of_the_data() -> None:
    plain, frame, other = (
        identify(composed("task=obstacles", *overrides))
        for overrides in (("encoding=plain",), ("encoding=path_frame",), ("encoding=path_frame", "encoding.reach=0.5"))
    )
    assert len({identity.denoiser.key for identity in (plain, frame, other)}) == 3
    assert len({identity.key for identity in (plain, frame, other)}) == 3
    assert plain.demonstrations.key == frame.demonstrations.key
    assert "encoding" not in plain.determined_by
    exact = [identify(composed("denoiser=gaussian", f"encoding={name}")).key for name in ("plain", "path_frame")]
    assert exact[0] == exact[1]

"""Laws of the denoisers: what is predicted, the exact posterior mean, networks as maps, files of weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from dadiff.denoisers import MLP, EncoderDecoder, Gaussian, InputsMLP, RecordingMLP
from dadiff.denoisers.checkpoints import load, save, write
from dadiff.denoisers.exact import ExactDenoiser, Smoother
from dadiff.denoisers.learned import CHUNK, NetworkDenoiser
from dadiff.denoisers.networks import step_features
from dadiff.denoisers.prediction import loss_weights, prediction
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.schedule import Schedule, cosine, ddpm_linear, paper_linear
from dadiff.errors import CheckpointError, ConfigError, ShapeError
from dadiff.experts.lqr import ClosedLoopLaw, optimal_feedback
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.systems import Linear, double_integrator
from dadiff.trajectory import Channel, Layout, TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates, physical

LAYOUT = TrajectoryLayout(state_dim=3, input_dim=2, horizon=5)
ENVIRONMENT_DIM = 4
CONDITION = Layout((Channel("x_init", 3), Channel("target", 1)))
OTHER = Layout((Channel("x_init", 4), Channel("target", 5)))
SCHEDULES = [paper_linear(), ddpm_linear(), cosine()]
RECIPES = [EncoderDecoder(channels=16, latent_dim=8), MLP(width=32, blocks=2)]


def build(
    recipe: Recipe, schedule: Schedule | None = None, seed: int = 0, layout: TrajectoryLayout = LAYOUT
) -> NetworkDenoiser:
    return recipe.build(layout, CONDITION, schedule or paper_linear(), torch_generator(seed, "initialisation"))


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch_generator(seed, "test"))


# --- what is predicted


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("choice", ["clean", "noise", "velocity"])
def test_a_perfect_prediction_gives_the_clean_trajectory(schedule, choice):
    if choice == "noise" and schedule.alpha_bar[-1] < 1e-12:
        pytest.skip("refused, see below")
    table = prediction(choice, schedule)
    rng = numpy_generator(0, "test")
    tau0, eps = rng.standard_normal((2, 7))
    a, s = np.sqrt(schedule.alpha_bar), np.sqrt(1 - schedule.alpha_bar)
    for i in (1, 2, schedule.num_steps // 3, schedule.num_steps - 1, schedule.num_steps):
        tau = a[i] * tau0 + s[i] * eps
        output = table.target_clean[i] * tau0 + table.target_noise[i] * eps
        estimate = table.estimate_tau[i] * tau + table.estimate_output[i] * output
        np.testing.assert_allclose(estimate, tau0, atol=1e-12 / a[i] if choice == "noise" else 1e-12)


@pytest.mark.parametrize("recipe", [EncoderDecoder(prediction="noise"), MLP(prediction="noise")])
def test_noise_prediction_is_refused_where_nothing_of_the_signal_is_left(recipe):
    with pytest.raises(ConfigError, match=r"alpha_bar_L = 0 \(needed"):
        build(recipe, paper_linear())
    with pytest.raises(ConfigError, match=r"alpha_bar_L = .*e-"):
        build(recipe, paper_linear(slope=0.00099))
    build(MLP(width=8, prediction="noise"), ddpm_linear())


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_posterior_mean_weights_are_the_error_of_the_reverse_mean(schedule):
    """They agree between predictions: a clean estimate off by delta moves mu_q by factor delta."""
    clean, velocity = (prediction(choice, schedule) for choice in ("clean", "velocity"))
    by_clean = loss_weights("posterior_mean", schedule, clean)
    by_velocity = loss_weights("posterior_mean", schedule, velocity)
    i = np.arange(1, schedule.num_steps + 1)
    a, b, beta = schedule.alpha_bar[i], schedule.alpha_bar[i - 1], schedule.beta[i]
    factor = np.sqrt(b) * beta / (1 - a)
    np.testing.assert_allclose(by_clean[i] / by_clean[1], factor**2 / factor[0] ** 2)
    np.testing.assert_allclose(by_velocity[i] / by_velocity[1], factor**2 * (1 - a) / (factor[0] ** 2 * (1 - a[0])))
    assert by_clean[1:].mean() == pytest.approx(1)
    assert (loss_weights("uniform", schedule, clean) == 1).all()


@pytest.mark.parametrize(
    ("recipe", "sizes"),
    [
        (MLP, {"width": 256, "blocks": 3}),
        (InputsMLP, {"width": 256, "blocks": 3}),
        (RecordingMLP, {"width": 1024, "blocks": 1, "context": 1024}),
        (EncoderDecoder, {"channels": 256, "latent_dim": 8}),
        (EncoderDecoder, {"channels": 16, "latent_dim": 4096, "kernel": 1}),
    ],
)
def test_what_a_network_is_said_to_take_is_near_what_its_weights_take(monkeypatch, recipe, sizes):
    """Four bytes each for a weight, its gradient, Adam's two moments and the running mean; of one step at least."""
    said: list[float] = []
    monkeypatch.setattr("dadiff.denoisers.recipes.check_fits", lambda size, what: said.append(size))
    condition = Layout((*CONDITION.channels, Channel("recording", 8, 0, 9))) if recipe is RecordingMLP else CONDITION
    network = recipe(**sizes).build(LAYOUT, condition, paper_linear(), torch_generator(0, "initialisation")).network
    weights = sum(w.numel() for w in network.parameters())
    share = 1 / (LAYOUT.horizon + 1) if recipe is EncoderDecoder else 1.0
    assert 0.7 * share * 5 * 4 * weights < said[0] <= 5 * 4 * weights


# --- the exact posterior mean


@dataclass
class Law:
    mean_map: np.ndarray
    offset: np.ndarray
    noise_map: np.ndarray


def random_law(*robots: int, d: int = LAYOUT.size, sources: int = 6) -> Law:
    rng = numpy_generator(3, "law")
    shapes = (d, ENVIRONMENT_DIM), (d,), (d, sources)
    return Law(*(rng.standard_normal((*robots, *shape)) for shape in shapes))


def random_coordinates() -> Coordinates:
    rng = numpy_generator(4, "coordinates")
    return Coordinates(rng.standard_normal(LAYOUT.size), rng.uniform(0.5, 2, LAYOUT.size))


def conditional_mean(law: Law, c: Coordinates, a: float, z: np.ndarray, E: np.ndarray) -> np.ndarray:
    """E[z_0 | z_i = sqrt(a) z_0 + sqrt(1 - a) eps], by conditioning the joint Gaussian with dense matrices."""
    mu = (law.mean_map @ E + law.offset - c.mean) / c.scale
    G = law.noise_map / c.scale[:, None]
    Sigma = G @ G.T
    return mu + np.sqrt(a) * Sigma @ np.linalg.solve(a * Sigma + (1 - a) * np.eye(len(z)), z - np.sqrt(a) * mu)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_exact_denoiser_is_the_conditional_mean(schedule):
    law, c = random_law(), random_coordinates()
    denoiser = Gaussian().exact(law, c, schedule)
    z, E = draw(5, LAYOUT.size), draw(5, ENVIRONMENT_DIM, seed=1)
    for i in (1, 30, schedule.num_steps):
        dense = [
            conditional_mean(law, c, schedule.alpha_bar[i], *pair) for pair in zip(z.numpy(), E.numpy(), strict=True)
        ]
        np.testing.assert_allclose(denoiser(z, i, E), np.stack(dense), rtol=1e-9, atol=1e-9)


def test_exact_denoiser_of_the_lqr_law():
    """Its covariance is singular: x(0) is given, u(0) deterministic and u(T-1) = 0."""
    system = double_integrator(process_noise=0.02)
    law = ClosedLoopLaw(system, optimal_feedback(system, np.eye(4), np.eye(2), 5))
    layout, schedule = system.layout(5), paper_linear()
    denoiser = Gaussian().exact(law, physical(layout), schedule)
    z, E = draw(layout.size), draw(8, seed=1)
    dense = conditional_mean(law, physical(layout), schedule.alpha_bar[7], z.numpy(), E.numpy())
    np.testing.assert_allclose(denoiser(z, 7, E), dense, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(denoiser(z, 7, E)[:4], E[:4], atol=1e-12)


def closed_loop(*robots: int) -> tuple[ClosedLoopLaw, TrajectoryLayout, Coordinates]:
    """An offset, noise of its own in each state but one, and any coordinates."""
    rng, n, m = numpy_generator(5, "closed loop"), 4, 2
    A, B, c = (rng.standard_normal((*robots, n, k)) for k in (n, m, 1))
    noise = np.array([0.1, 0.5, 0.0, 0.3])
    system = Linear(0.4 * A, B, c[..., 0], process_noise=noise, robots=robots[0] if robots else None)
    law, layout = ClosedLoopLaw(system, optimal_feedback(system, np.eye(n), np.eye(m), 7)), system.layout(7)
    return law, layout, Coordinates(rng.standard_normal(layout.size), rng.uniform(0.3, 3, layout.size))


@pytest.mark.parametrize("robots", [(), (3,)], ids=["one", "fleet"])
def test_the_smoother_is_the_exact_denoiser(monkeypatch, robots):
    law, layout, c = closed_loop(*robots)
    schedule = Schedule(np.array([0.0, 0.02, 0.3, 0.9, 1.0]))
    dense = Gaussian().exact(law, c, schedule)
    monkeypatch.setattr("dadiff.experts.lqr.DENSE_UP_TO", 10)
    smoother = Gaussian().exact(law, c, schedule)
    assert (type(dense), type(smoother)) == (ExactDenoiser, Smoother)
    z, E = draw(*robots, 2, 3, layout.size), draw(*robots, 2, 3, 8, seed=1)
    for i in range(1, 5):
        torch.testing.assert_close(smoother(z, i, E), dense(z, i, E), rtol=1e-10, atol=1e-10)


def test_the_smoother_has_the_gradient_of_the_exact_denoiser(monkeypatch):
    law, layout, c = closed_loop()
    dense, gradients = Gaussian().exact(law, c, paper_linear()), []
    monkeypatch.setattr("dadiff.experts.lqr.DENSE_UP_TO", 10)
    for denoiser in (dense, Gaussian().exact(law, c, paper_linear())):
        z = draw(layout.size).requires_grad_()
        denoiser.estimate(z, 20, draw(8, seed=1)).square().sum().backward()
        gradients.append(z.grad)
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9)


def test_exact_denoiser_in_the_limits():
    """alpha_bar = 0: the mean of the law. alpha_bar -> 1: the projection onto the support through the mean."""
    law, c = random_law(), random_coordinates()
    denoiser = ExactDenoiser(law, c, Schedule(np.array([0.0, 1e-14, 1.0])))
    z, E = draw(LAYOUT.size), draw(ENVIRONMENT_DIM, seed=1)
    mu = denoiser.mean(E)
    np.testing.assert_array_equal(denoiser(z, 2, E), mu)
    U = denoiser.basis
    np.testing.assert_allclose(denoiser(z, 1, E), mu + U @ (U.T @ (z - mu)), rtol=1e-9, atol=1e-9)


def test_exact_denoiser_without_noise_is_the_mean():
    law = random_law()
    denoiser = ExactDenoiser(replace(law, noise_map=0 * law.noise_map), physical(LAYOUT), paper_linear())
    E = draw(ENVIRONMENT_DIM)
    np.testing.assert_array_equal(denoiser(draw(LAYOUT.size), 1, E), denoiser.mean(E))


def test_exact_denoiser_of_many_robots_equals_one_after_another():
    law, c, schedule = random_law(3), random_coordinates(), paper_linear()
    z, E = draw(3, 4, 2, LAYOUT.size), draw(3, 4, 1, ENVIRONMENT_DIM, seed=1)
    together = Gaussian().exact(law, c, schedule)(z, 20, E)
    for r in range(3):
        alone = Gaussian().exact(Law(law.mean_map[r], law.offset[r], law.noise_map[r]), c, schedule)(z[r], 20, E[r])
        np.testing.assert_allclose(together[r], alone, atol=1e-12)


# --- networks as maps


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("choice", ["clean", "velocity"])
def test_batch_equals_loop(recipe, choice):
    denoiser = build(type(recipe)(**{**vars(recipe), "prediction": choice}))
    tau, E = draw(3, 2, LAYOUT.size), draw(3, 1, ENVIRONMENT_DIM, seed=1)
    together = denoiser(tau, 17, E)
    assert together.dtype == torch.float64
    assert together.shape == tau.shape
    assert not together.requires_grad
    for case in range(3):
        for sample in range(2):
            alone = denoiser(tau[case, sample], 17, E[case, 0])
            torch.testing.assert_close(together[case, sample], alone, rtol=1e-5, atol=1e-6)  # float32 inside


def test_more_plans_than_a_chunk():
    denoiser = build(RECIPES[1])
    tau, E = draw(CHUNK + 3, LAYOUT.size), draw(ENVIRONMENT_DIM, seed=1)
    torch.testing.assert_close(denoiser(tau, 5, E)[-3:], denoiser(tau[-3:], 5, E), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("recipe", RECIPES)
def test_everything_given_matters(recipe):
    denoiser = build(recipe)
    tau, E = draw(LAYOUT.size), draw(ENVIRONMENT_DIM, seed=1)
    estimate = denoiser(tau, 5, E)
    assert not torch.equal(estimate, denoiser(tau + 0.1, 5, E))
    assert not torch.equal(estimate, denoiser(tau, 50, E))
    assert not torch.equal(estimate, denoiser(tau, 5, E + 0.1))


@pytest.mark.parametrize("recipe", RECIPES)
def test_horizon_one_and_other_sizes(recipe):
    layout = TrajectoryLayout(state_dim=1, input_dim=3, horizon=1)
    assert build(recipe, layout=layout)(draw(2, layout.size), 3, draw(ENVIRONMENT_DIM)).shape == (2, layout.size)


@pytest.mark.parametrize("recipe", RECIPES)
def test_same_seed_same_weights_and_no_global_randomness(recipe):
    before = torch.get_rng_state()
    one, same, other = build(recipe, seed=1), build(recipe, seed=1), build(recipe, seed=2)
    one(draw(LAYOUT.size), 3, draw(ENVIRONMENT_DIM))
    assert torch.equal(before, torch.get_rng_state())
    for name, weight in one.state_dict().items():
        assert weight.isfinite().all(), name
        assert torch.equal(weight, same.state_dict()[name]), name
    assert any(not torch.equal(w, other.state_dict()[name]) for name, w in one.state_dict().items())


def test_the_sizes_stated():
    """The paper's sizes: T = 30, n = 4, m = 2."""
    layout = TrajectoryLayout(4, 2, 30)
    count = sum(p.numel() for p in build(MLP(), layout=layout).parameters())
    assert 1.7e6 < count < 1.9e6


def test_environment_is_standardised_and_constant_entries_stay_finite():
    denoiser = build(RECIPES[1])
    environment = np.column_stack(
        [numpy_generator(0, "E").normal(5, 3, (50, ENVIRONMENT_DIM - 1)), np.full(50, 33 / 40)]
    )
    assert environment.std(axis=0)[-1] > 0  # by rounding
    denoiser.standardise_by(environment)
    np.testing.assert_allclose(denoiser.environment_mean, environment.mean(0), rtol=1e-6)
    assert denoiser.environment_scale[-1] == 1


def test_wrong_shapes_are_named():
    denoiser = build(RECIPES[1])
    with pytest.raises(ShapeError, match=r"environment has 5 entries.*built for 4"):
        denoiser(draw(LAYOUT.size), 3, draw(5))
    with pytest.raises(ShapeError, match="trajectory has 7 entries"):
        denoiser(draw(7), 3, draw(ENVIRONMENT_DIM))
    with pytest.raises(ShapeError, match="environment has 3 entries"):
        Gaussian().exact(random_law(), random_coordinates(), paper_linear())(draw(LAYOUT.size), 3, draw(3))


@pytest.mark.parametrize(("recipe", "fields", "text"), [
    (MLP, {"width": 0}, "width is 0"),
    (MLP, {"blocks": 0}, "blocks is 0"),
    (EncoderDecoder, {"kernel": 4}, "kernel is 4; it must be odd"),
    (EncoderDecoder, {"latent_dim": 0}, "latent_dim is 0"),
])  # fmt: skip
def test_impossible_recipes(recipe, fields, text):
    with pytest.raises(ConfigError, match=text):
        recipe(**fields)


# --- files of weights


@pytest.mark.parametrize("recipe", RECIPES)
def test_saved_and_loaded_is_the_same(recipe, tmp_path):
    denoiser = build(recipe)
    denoiser.standardise_by(draw(20, ENVIRONMENT_DIM).numpy())
    save(denoiser, tmp_path / "model.safetensors")
    loaded = load(tmp_path / "model.safetensors", recipe, LAYOUT, CONDITION, paper_linear())
    tau, E = draw(3, LAYOUT.size), draw(ENVIRONMENT_DIM, seed=1)
    assert torch.equal(denoiser(tau, 9, E), loaded(tau, 9, E))
    assert [path.name for path in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "model.safetensors"
    save(build(RECIPES[1]), path)
    return path


@pytest.mark.parametrize(("recipe", "layout", "condition", "schedule", "text"), [
    (RECIPES[1], TrajectoryLayout(3, 2, 6), CONDITION, paper_linear(), r"T = 5 \(expected 6\)"),
    (RECIPES[1], TrajectoryLayout(4, 1, 5), OTHER, paper_linear(), r"n = 3 \(expected 4\), m = .*c = 4 \(expected 9\)"),
    (RECIPES[1], LAYOUT, CONDITION, paper_linear(num_steps=500), r"L = 1000 \(expected 500\)"),
    (RECIPES[1], LAYOUT, CONDITION, cosine(), "beta = "),
    (MLP(width=16, blocks=2), LAYOUT, CONDITION, paper_linear(), r"width = 32 \(expected 16\)"),
    (RECIPES[0], LAYOUT, CONDITION, paper_linear(), r"recipe = MLP \(expected EncoderDecoder\)"),
])  # fmt: skip
def test_a_model_of_other_sizes_is_refused(stored, recipe, layout, condition, schedule, text):
    with pytest.raises(CheckpointError, match=text) as caught:
        load(stored, recipe, layout, condition, schedule)
    assert "\n" not in str(caught.value)
    assert str(stored) in str(caught.value)


def load_small(path: Path) -> NetworkDenoiser:
    return load(path, RECIPES[1], LAYOUT, CONDITION, paper_linear())


@pytest.mark.parametrize("kept", [0, 4, 100, 0.5, 0.99])
def test_a_truncated_model_is_one_clear_line(stored, tmp_path, kept):
    whole = stored.read_bytes()
    damaged = tmp_path / "model.safetensors"
    damaged.write_bytes(whole[: kept if isinstance(kept, int) else int(kept * len(whole))])
    with pytest.raises(CheckpointError, match=r"model\.safetensors.*truncated or damaged.*train again") as caught:
        load_small(damaged)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_models(tmp_path):
    path = tmp_path / "model.safetensors"
    with pytest.raises(CheckpointError, match="no such file"):
        load_small(path)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(CheckpointError, match="holds no description"):
        load_small(path)
    save_file({"a": torch.zeros(1)}, path, metadata={"dadiff": "[1]"})
    with pytest.raises(CheckpointError, match="description is a list"):
        load_small(path)
    write(path, {"a": torch.zeros(1)}, build(RECIPES[1]).description)
    with pytest.raises(CheckpointError, match="tensor environment_mean is missing"):
        load_small(path)


def test_a_system_of_another_size():
    """Nothing assumes four states and two inputs."""
    rng = numpy_generator(0, "system")
    system = Linear(0.5 * rng.standard_normal((3, 3)), rng.standard_normal((3, 2)), process_noise=0.1)
    law = ClosedLoopLaw(system, optimal_feedback(system, np.eye(3), np.eye(2), 5))
    denoiser = Gaussian().exact(law, random_coordinates(), paper_linear())
    assert denoiser(draw(4, LAYOUT.size), 10, draw(6)).shape == (4, LAYOUT.size)


def test_features_of_a_step_are_waves_of_lengths_from_2_pi_to_2_pi_10_000():
    step = torch.tensor([1.0, 57.0, 1000.0])
    wave = step[:, None] / np.geomspace(1, 1e4, 32)
    expected = np.concatenate([np.sin(wave), np.cos(wave)], axis=-1)
    np.testing.assert_allclose(step_features(step), expected, atol=1e-3)

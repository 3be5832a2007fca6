"""Laws of training: it learns, the seed decides everything, and an interruption changes nothing."""

from __future__ import annotations

import csv
import signal
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dadiff.denoisers import MLP, EncoderDecoder, learning
from dadiff.denoisers.checkpoints import load
from dadiff.denoisers.learning import Data, Objective, State, train
from dadiff.denoisers.recipes import Recipe
from dadiff.denoisers.training import Training
from dadiff.diffusion.schedule import paper_linear
from dadiff.errors import CheckpointError, ConfigError, DataError, ShapeError
from dadiff.randomness import numpy_generator
from dadiff.trajectory import Channel, Layout, TrajectoryLayout

LAYOUT = TrajectoryLayout(state_dim=2, input_dim=1, horizon=4)
CONDITION = Layout((Channel("x_init", 2), Channel("target", 1)))
SCHEDULE = paper_linear(num_steps=100, slope=0.01)
RECIPES = [MLP(width=16, blocks=1), EncoderDecoder(channels=8, latent_dim=4)]
SHORT = Training(steps=24, batch_size=8, learning_rate=1e-2, warmup=3, ema_decay=0.9, checkpoint_every=7)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def demonstrations(count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """tau is a linear map of E = (3 numbers), with a little noise."""
    rng = numpy_generator(1, "demonstrations")
    E = rng.uniform(-1, 1, (count, 3))
    return E @ rng.standard_normal((3, LAYOUT.size)) + 0.01 * rng.standard_normal((count, LAYOUT.size)), E


def run(folder: Path, recipe: Recipe = RECIPES[0], training: Training = SHORT, **options: object):
    folder.mkdir(exist_ok=True)
    return train(recipe, LAYOUT, CONDITION, SCHEDULE, training, *demonstrations(), folder, progress=False, **options)


def same_weights(one: Path, other: Path) -> bool:
    a, b = (load_file(folder / "model.safetensors") for folder in (one, other))
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


class Interrupt:
    """An augmentation that changes nothing, and presses Ctrl-C in the midst of one gradient step."""

    def __init__(self, at: int) -> None:
        self.calls, self.at = 0, at

    def __call__(self, E: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        self.calls += 1
        if self.calls == self.at:
            signal.raise_signal(signal.SIGINT)
        return E


class Killed(Exception):
    """Stands for a death without notice."""


def kill_at(step: int):
    calls = iter(range(1, step + 1))

    def augment(E: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        if next(calls) == step:
            raise Killed
        return E

    return augment


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("at", [1, 5, 7, 20])
def test_an_interrupted_training_resumes_bit_for_bit(recipe, at, tmp_path):
    run(tmp_path / "whole", recipe)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", recipe, augment=Interrupt(at))
    assert int(load_file(tmp_path / "parts/checkpoint.safetensors")["step"]) == at
    run(tmp_path / "parts", recipe)
    assert same_weights(tmp_path / "whole", tmp_path / "parts")


@pytest.mark.parametrize("loss_weight", ["uniform", "posterior_mean"])
def test_a_killed_training_resumes_from_its_last_checkpoint(loss_weight, tmp_path):
    training = replace(SHORT, loss_weight=loss_weight)
    run(tmp_path / "whole", training=training)
    with pytest.raises(Killed):
        run(tmp_path / "parts", training=training, augment=kill_at(18))
    assert int(load_file(tmp_path / "parts/checkpoint.safetensors")["step"]) == 14
    run(tmp_path / "parts", training=training)
    assert same_weights(tmp_path / "whole", tmp_path / "parts")
    losses = [[row["loss"] for row in read_curve(tmp_path / name)] for name in ("whole", "parts")]
    assert losses[0] == losses[1]


def test_the_clock_of_a_resumed_training_goes_on_where_it_stopped(monkeypatch, tmp_path):
    monkeypatch.setattr("dadiff.denoisers.learning.time", SimpleNamespace(perf_counter=count().__next__))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, augment=Interrupt(5))
    run(tmp_path)
    assert [float(row["seconds"]) for row in read_curve(tmp_path)] == list(range(1, SHORT.steps + 1))


def test_augmentation_resumes_too(tmp_path):
    def shuffle(E: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return E[:, torch.randperm(E.shape[1], generator=generator)]

    def shuffle_then(stop):
        return lambda E, generator: stop(shuffle(E, generator), generator)

    run(tmp_path / "plain")
    run(tmp_path / "whole", augment=shuffle)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", augment=shuffle_then(Interrupt(11)))
    run(tmp_path / "parts", augment=shuffle)
    assert same_weights(tmp_path / "whole", tmp_path / "parts")
    assert not same_weights(tmp_path / "whole", tmp_path / "plain")


def test_the_signal_handler_is_given_back(tmp_path):
    before = signal.getsignal(signal.SIGINT)
    run(tmp_path / "a")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "b", augment=Interrupt(2))
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_seed_decides_and_the_global_state_does_not(recipe, tmp_path):
    before = torch.get_rng_state()
    run(tmp_path / "one", recipe)
    assert torch.equal(before, torch.get_rng_state())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(77)
        run(tmp_path / "same", recipe)
    run(tmp_path / "other", recipe, replace(SHORT, seed=1))
    assert same_weights(tmp_path / "one", tmp_path / "same")
    assert not same_weights(tmp_path / "one", tmp_path / "other")


def read_curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "training.csv").open() as file:
        return list(csv.DictReader(file))


def test_what_is_left_in_the_folder(tmp_path):
    denoiser = run(tmp_path / "a")
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["model.safetensors", "training.csv"]
    loaded = load(tmp_path / "a/model.safetensors", RECIPES[0], LAYOUT, CONDITION, SCHEDULE)
    tau, E = torch.ones(LAYOUT.size, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    assert torch.equal(loaded(tau, 5, E), denoiser(tau, 5, E))
    rows = read_curve(tmp_path / "a")
    assert len(rows) == SHORT.steps
    assert int(rows[-1]["step"]) == SHORT.steps
    assert float(rows[-1]["seconds"]) > 0


@pytest.mark.parametrize("recipe", [MLP(width=64, blocks=1), EncoderDecoder(channels=16, latent_dim=16)])
@pytest.mark.parametrize("choice", ["clean", "velocity"])
def test_training_learns(recipe, choice, tmp_path):
    """At a step that holds no signal the clean estimate becomes the mean given E."""
    recipe = replace(recipe, prediction=choice)
    denoiser = run(tmp_path / "a", recipe, Training(steps=500, batch_size=64, learning_rate=3e-3, warmup=20))
    trajectories, E = (torch.from_numpy(array) for array in demonstrations())
    error = denoiser(torch.zeros_like(trajectories), 90, E) - trajectories
    assert error.square().mean() < 0.05 * trajectories.var()


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "a", augment=Interrupt(3))
    with pytest.raises(CheckpointError, match=r"learning_rate = 0\.01 \(expected 0\.02\)"):
        run(tmp_path / "a", training=replace(SHORT, learning_rate=0.02))
    trajectories, E = demonstrations()
    with pytest.raises(CheckpointError, match=r"data = "):
        train(RECIPES[0], LAYOUT, CONDITION, SCHEDULE, SHORT, trajectories + 1, E, tmp_path / "a", progress=False)


def test_a_truncated_checkpoint_is_refused(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "a", augment=Interrupt(3))
    path = tmp_path / "a/checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(CheckpointError, match=r"checkpoint\.safetensors.*truncated"):
        run(tmp_path / "a")


@pytest.mark.parametrize("share", [0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.99])
def test_a_bit_that_flips_in_a_checkpoint_is_found(share, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "a", augment=Interrupt(3))
    path = tmp_path / "a/checkpoint.safetensors"
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 8
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"checkpoint\.safetensors"):
        run(tmp_path / "a")


def test_bad_data_is_named(tmp_path):
    trajectories, E = demonstrations()
    arguments = (RECIPES[0], LAYOUT, CONDITION, SCHEDULE, SHORT)
    with pytest.raises(ShapeError, match="trajectory has 13 entries"):
        train(*arguments, trajectories[:, :-1], E, tmp_path, progress=False)
    with pytest.raises(ShapeError, match=r"environments \(59, 3\)"):
        train(*arguments, trajectories, E[1:], tmp_path, progress=False)
    with pytest.raises(DataError, match="environments hold values that are not finite"):
        train(*arguments, trajectories, np.where(E > 0.9, np.nan, E), tmp_path, progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("fields", "text"), [
    ({"steps": 0}, "steps is 0"),
    ({"learning_rate": 0.0}, "learning_rate is 0"),
    ({"ema_decay": 1.0}, "ema_decay is 1"),
    ({"warmup": -1}, "warmup is -1"),
])  # fmt: skip
def test_impossible_training(fields, text):
    with pytest.raises(ConfigError, match=text):
        Training(**fields)


def test_learning_rate_schedules():
    training = Training(steps=1000, learning_rate=1.0, warmup=99)
    rates = [training.learning_rate_at(step) for step in range(1000)]
    assert np.argmax(rates) == 99
    assert 0 < rates[0] <= 0.01
    assert rates[-1] < 1e-5
    constant = replace(training, learning_rate_schedule="constant")
    assert constant.learning_rate_at(99) == constant.learning_rate_at(999) == 1


def test_a_regression_is_trained_at_the_last_step_alone(tmp_path):
    """It predicts the mean of tau given E there, where tau_i is noise."""
    training = replace(SHORT, steps=1500, batch_size=32, regression=True)
    denoiser = run(tmp_path, training=training)
    tau, E = (torch.from_numpy(values) for values in demonstrations())
    noise = torch.randn(tau.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    error = (denoiser(noise, SCHEDULE.num_steps, E) - tau).square().mean()
    assert float(error) < 0.05 * float(tau.square().mean())
    data = Data(*demonstrations(), SCHEDULE.num_steps, training, "cpu", None)
    assert (data.draw()[2] == SCHEDULE.num_steps).all()


def test_rounded_products_in_training_resume_bit_for_bit_and_leave_float32(tmp_path):
    training = replace(SHORT, precision="bfloat16")
    run(tmp_path / "whole", training=training)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", training=training, augment=Interrupt(9))
    run(tmp_path / "parts", training=training)
    assert same_weights(tmp_path / "whole", tmp_path / "parts")
    assert {weight.dtype for weight in load_file(tmp_path / "whole/model.safetensors").values()} == {torch.float32}
    run(tmp_path / "float32")
    assert not same_weights(tmp_path / "whole", tmp_path / "float32")


def test_sampling_is_never_rounded(tmp_path):
    """Estimates of a denoiser trained so are those of its stored weights, in float32."""
    denoiser = run(tmp_path, training=replace(SHORT, precision="bfloat16"))
    loaded = load(tmp_path / "model.safetensors", RECIPES[0], LAYOUT, CONDITION, SCHEDULE)
    tau, E = (torch.from_numpy(values) for values in demonstrations(5))
    assert torch.equal(loaded(tau, 3, E), denoiser(tau, 3, E))
    assert denoiser.output(tau.float(), torch.tensor([3]), E.float()).dtype == torch.float32


@pytest.mark.parametrize("recipe", RECIPES)
def test_rounded_products_learn_as_well(recipe, tmp_path):
    training = replace(SHORT, steps=300, batch_size=32)
    tau, E = (torch.from_numpy(values) for values in demonstrations())
    noise = torch.randn(tau.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    errors = {}
    for precision in ("float32", "bfloat16"):
        denoiser = run(tmp_path / precision, recipe, replace(training, precision=precision))
        errors[precision] = float((denoiser(noise, SCHEDULE.num_steps, E) - tau).square().mean())
    assert errors["bfloat16"] < 1.25 * errors["float32"]


def test_the_loss_is_that_of_the_forward_process():
    """|tau_0 - f(sqrt(alpha_bar_i) tau_0 + sqrt(1 - alpha_bar_i) eps)|^2 of a prediction of the clean trajectory."""
    rng = np.random.default_rng(0)
    tau0, eps, i = rng.standard_normal((7, 4)), rng.standard_normal((7, 4)), np.array([1, 2, 30, 50, 80, 99, 100])
    objective = Objective(MLP(prediction="clean"), SCHEDULE, replace(SHORT, loss_weight="uniform"), "cpu")
    a = SCHEDULE.alpha_bar[i][:, None]
    seen = np.sqrt(a) * tau0 + np.sqrt(1 - a) * eps

    class Halved:
        def output(self, tau, step, environment):
            return tau / 2

    found = objective(Halved(), *(torch.tensor(v) for v in (tau0, np.zeros((7, 1)), i, eps)))
    assert float(found) == pytest.approx(np.square(seen / 2 - tau0).mean(), rel=1e-5)


def test_the_running_mean_forgets_the_first_weights_soon():
    decays = [Training(ema_decay=0.9).ema_decay_at(step) for step in (0, 5, 10, 1000)]
    assert decays == pytest.approx([1 / 10, 6 / 15, 11 / 20, 0.9])


def test_a_training_may_begin_at_full_rate():
    assert Training(warmup=0).warmup == 0


def test_every_step_is_drawn_and_none_beyond():
    """i is uniform on 1..L, both ends included: the chain begins at L."""
    training = replace(SHORT, batch_size=4000)
    data = Data(*demonstrations(), 5, training, "cpu", None)
    counts = np.bincount(data.draw()[2], minlength=6)
    assert counts[0] == 0
    assert len(counts) == 6
    assert (np.abs(counts[1:] / 4000 - 1 / 5) < 0.03).all()


def test_what_a_training_gives_is_the_running_mean_of_its_weights(tmp_path, monkeypatch):
    """m <- d m + (1 - d) w after each step, from the initial weights on."""
    seen = []

    class Watched(learning.State):
        def advance(self, objective, data):
            before = [m.clone() for m in self.running_mean]
            super().advance(objective, data)
            keep = SHORT.ema_decay_at(self.step - 1)
            for m, old, w in zip(self.running_mean, before, self.weights, strict=True):
                np.testing.assert_allclose(m, keep * old + (1 - keep) * w.detach(), atol=1e-6)
            seen.append([w.detach().clone() for w in self.weights])
            seen.append([m.clone() for m in self.running_mean])

    monkeypatch.setattr(learning, "State", Watched)
    given = list(run(tmp_path).parameters())
    *_, last, mean = seen
    assert all(torch.equal(a, b) for a, b in zip(given, mean, strict=True))
    assert not all(torch.allclose(a, b, atol=1e-4) for a, b in zip(given, last, strict=True))


@pytest.mark.parametrize(("step", "expected"), [(1, 0.0), (40, 19.5), (100, 49.5), (250, 199.5)])
def test_the_recent_loss_is_the_mean_of_the_last_hundred(step, expected):
    losses = torch.full((300,), torch.nan).index_copy(0, torch.arange(step), torch.arange(step, dtype=torch.float32))
    assert State.recent_loss(SimpleNamespace(losses=losses, step=step)) == pytest.approx(expected)


@pytest.mark.parametrize("steps", [7, 500, 1203])
def test_a_row_of_the_curve_is_the_mean_since_the_last(steps, tmp_path):
    losses, seconds = torch.arange(steps, dtype=torch.float64) ** 2, torch.arange(steps)
    State.write_curve(SimpleNamespace(training=Training(steps=steps), losses=losses, seconds=seconds), tmp_path / "c")
    rows = list(csv.DictReader((tmp_path / "c").open()))
    ends = np.array([int(row["step"]) for row in rows])
    assert len(rows) <= 500
    assert ends[-1] == steps
    sums = np.array([float(row["loss"]) for row in rows]) * np.diff(ends, prepend=0)
    np.testing.assert_allclose(sums.cumsum(), np.cumsum(losses.numpy())[ends - 1])
    assert [int(row["seconds"].split(".")[0]) for row in rows] == (ends - 1).tolist()


def test_a_training_may_be_of_one_step_of_one_trajectory():
    assert Training(steps=1, batch_size=1, checkpoint_every=1).steps == 1

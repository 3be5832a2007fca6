"""A training step of the paper's network: against its multiply-adds alone, and against a trainer that reads files."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from bench.peers import ConvolutionNetwork, FileTrainer
from bench.rows import Row, least
from dadiff.denoisers import MLP, EncoderDecoder
from dadiff.denoisers.learning import Data, Objective, State
from dadiff.denoisers.recipes import Recipe
from dadiff.denoisers.training import Training
from dadiff.diffusion.schedule import paper_linear
from dadiff.randomness import torch_generator
from dadiff.systems import double_integrator
from dadiff.tasks import LQR

LAYOUT = double_integrator().layout(30)
CONDITION = LQR().condition(double_integrator())
SCHEDULE = paper_linear()
MATRIX, COUNT = 2048, 2000


def multiply_adds(recipe: EncoderDecoder) -> int:
    """Of one sample and call of the paper's network: six convolutions, two linear maps."""
    length, features, C = LAYOUT.horizon + 1, LAYOUT.state_dim + LAYOUT.input_dim, recipe.channels
    return length * recipe.kernel * (2 * features * C + 4 * C * C) + 2 * length * C * recipe.latent_dim


def training_step(recipe: Recipe, training: Training) -> Callable[[], None]:
    """Ours, as `train` takes it: data in memory, Adam, the running mean of the weights."""
    rng = np.random.default_rng(0)
    tau, E = rng.standard_normal((COUNT, LAYOUT.size)), rng.standard_normal((COUNT, CONDITION.size))
    denoiser = recipe.build(LAYOUT, CONDITION, SCHEDULE, torch_generator(0, "bench"))
    objective = Objective(recipe, SCHEDULE, training, "cpu")
    data, state = Data(tau, E, SCHEDULE.num_steps, training, "cpu", None), State(denoiser, training)
    return lambda: state.advance(objective, data)


def measure(repeats: int = 20) -> list[Row]:
    """The rows."""
    recipe, training = EncoderDecoder(), Training(steps=1000, batch_size=64)
    a, b = torch.randn(2, MATRIX, MATRIX)
    with tempfile.TemporaryDirectory() as folder:
        peer = FileTrainer(ConvolutionNetwork(LAYOUT, CONDITION.size), SCHEDULE, Path(folder), COUNT, 64)
        step = training_step(recipe, training)
        ours, files, matmul = least(step, peer.step, lambda: a @ b, repeats=repeats)
    floor = 3 * 64 * multiply_adds(recipe) * matmul / MATRIX**3
    exact, rounded = least(
        *(training_step(MLP(), Training(steps=1000, batch_size=256, precision=p)) for p in ("float32", "bfloat16")),
        repeats=repeats,
    )
    return [
        Row("training step, paper's network, batch 64", 1e3 * ours, "ms", "its multiply-adds alone", 1e3 * floor),
        Row("training step, paper's network, batch 64", 1e3 * ours, "ms", "a trainer that reads files", 1e3 * files),
        Row("training step, mlp, batch 256, bfloat16", 1e3 * rounded, "ms", "float32", 1e3 * exact),
    ]

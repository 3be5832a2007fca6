"""A training step: against the products of matrices in it, alone, and against a trainer that reads files.

Products of tall and of small matrices are slower than one of large square ones with as many multiply-adds.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

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


def shapes(recipe: Recipe, batch: int) -> list[tuple[int, int, int, bool]]:
    """Of each layer's product (M, K) x (K, N) in one call: M, K, N, and whether its input asks for a gradient."""
    denoiser, found = recipe.build(LAYOUT, CONDITION, SCHEDULE, torch_generator(0, "bench")), []

    def note(layer: nn.Module, given: tuple[Tensor, ...], output: Tensor) -> None:
        N, *rest = layer.weight.shape
        found.append((output.numel() // N, math.prod(rest), N, given[0].requires_grad))

    for layer in denoiser.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            layer.register_forward_hook(note)
    denoiser.output(torch.zeros(batch, LAYOUT.size), torch.ones(batch), torch.zeros(batch, CONDITION.size))
    return found


def products(layers: list[tuple[int, int, int, bool]]) -> Callable[[], None]:
    """The products of a step: of each layer the output, the gradient of weights, and of inputs where it is asked."""
    parts = [(torch.randn(M, K), torch.randn(N, K), torch.randn(M, N), asked) for M, K, N, asked in layers]
    outputs = [(torch.empty(len(x), len(w)), torch.empty_like(w), torch.empty_like(x)) for x, w, *_ in parts]

    def all_of_them() -> None:
        for (x, w, gradient, asked), (y, of_w, of_x) in zip(parts, outputs, strict=True):
            torch.mm(x, w.T, out=y)
            torch.mm(gradient.T, x, out=of_w)
            if asked:
                torch.mm(gradient, w, out=of_x)

    return all_of_them


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
    paper, small = (EncoderDecoder(), 64), (MLP(), 256)
    a, b = torch.randn(2, MATRIX, MATRIX)
    with tempfile.TemporaryDirectory() as folder:
        peer = FileTrainer(ConvolutionNetwork(LAYOUT, CONDITION.size), SCHEDULE, Path(folder), COUNT, 64)
        step, alone = training_step(paper[0], Training(steps=1000, batch_size=paper[1])), products(shapes(*paper))
        ours, files, parts, square = least(step, peer.step, alone, lambda: a @ b, repeats=repeats)
    multiply_adds = sum(M * K * N * (2 + asked) for M, K, N, asked in shapes(*paper))
    trainings = [Training(steps=1000, batch_size=small[1], precision=p) for p in ("float32", "bfloat16")]
    steps = [training_step(small[0], training) for training in trainings]
    exact, rounded, small_parts = least(*steps, products(shapes(*small)), repeats=repeats)
    floor, name = multiply_adds * square / MATRIX**3, "training step, paper's network, batch 64"
    return [
        Row(name, 1e3 * ours, "ms", "its products alone", 1e3 * parts),
        Row(name, 1e3 * ours, "ms", "its multiply-adds as one square product", 1e3 * floor),
        Row(name, 1e3 * ours, "ms", "a trainer that reads files", 1e3 * files),
        Row("training step, mlp, batch 256", 1e3 * exact, "ms", "its products alone", 1e3 * small_parts),
        Row("training step, mlp, batch 256, bfloat16", 1e3 * rounded, "ms", "float32", 1e3 * exact),
    ]

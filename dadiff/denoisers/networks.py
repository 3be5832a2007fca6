"""The networks: float32, (B, d) in and out, conditioned on the diffusion step and the scaled environment.

All take `forward(tau, step, environment)` with tau (B, d), the step's features (B, 64) or (1, 64) and E (B, c), and
return (B, d).
What the output means (clean trajectory, noise, velocity) is not their concern.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from dadiff.trajectory import Layout, TrajectoryLayout

STEP_FEATURES = 64
EMBEDDING = 128
"""Hidden units in the embedding of one transition of a recording."""


def step_features(step: Tensor) -> Tensor:
    """Sines and cosines of the step at wavelengths from 2 pi to 2 pi 10^4 (Vaswani et al. 2017), (B, 64)."""
    half = STEP_FEATURES // 2
    frequency = torch.exp(torch.arange(half, device=step.device) * (-math.log(1e4) / (half - 1)))
    phase = step[:, None] * frequency
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


@lru_cache(maxsize=1024)
def features_at(i: int, device: torch.device) -> Tensor:
    """Those of one step that all plans share, (1, 64); made once."""
    with torch.inference_mode(False):  # where gradients are recorded they are needed, too
        return step_features(torch.full((1,), i, device=device))


class Condition(nn.Module):
    """An embedding of diffusion step and environment, (B, width): further conditions join the sum here."""

    def __init__(self, environment_dim: int, width: int) -> None:
        super().__init__()
        self.step = nn.Linear(STEP_FEATURES, width)
        self.environment = nn.Linear(environment_dim, width)
        self.mix = nn.Linear(width, width)

    def forward(self, step: Tensor, environment: Tensor) -> Tensor:
        hidden = self.step(step) + self.environment(environment)
        return functional.silu(self.mix(functional.silu(hidden)))


class ResidualBlock(nn.Module):
    """h + W_2 silu(W_1 h). Without a norm: it learns the linear part of the expert's law sooner, and in less time."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner = nn.Linear(width, width)
        self.outer = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + self.outer(functional.silu(self.inner(hidden)))


class ResidualNetwork(nn.Module):
    """Residual blocks on [tau, step features, E]; a first layer that adds three maps is one map of the three joined."""

    def __init__(self, size: int, environment_dim: int, width: int, blocks: int, seen: int | None = None) -> None:
        super().__init__()
        self.trajectory = nn.Linear(size if seen is None else seen, width)
        self.step = nn.Linear(STEP_FEATURES, width)
        self.environment = nn.Linear(environment_dim, width)
        self.blocks = nn.Sequential(*(ResidualBlock(width) for _ in range(blocks)))
        self.output = nn.Linear(width, size)

    def forward(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        hidden = self.trajectory(tau) + self.step(step) + self.environment(environment)
        return self.output(self.blocks(hidden))


class InputsNetwork(nn.Module):
    """`ResidualNetwork` that sees the inputs of tau alone, whatever its states."""

    def __init__(self, layout: TrajectoryLayout, environment_dim: int, width: int, blocks: int) -> None:
        super().__init__()
        self.layout, seen = layout, layout.horizon * layout.input_dim
        self.plan = ResidualNetwork(layout.size, environment_dim, width, blocks, seen)

    def forward(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        return self.plan(self.layout.inputs(tau).flatten(-2), step, environment)


class RecordingNetwork(nn.Module):
    """`ResidualNetwork` that is told of a recording by the mean of its transitions' embeddings (deep sets).

    Of E it reads the channel `recording`, (x(t), u(t), x(t+1) - x(t)) for each t, and all others as they are.
    """

    def __init__(self, size: int, condition: Layout, width: int, blocks: int, context: int) -> None:
        super().__init__()
        self.condition, recording = condition, condition.channel("recording")
        self.embed = nn.Sequential(nn.Linear(recording.dim, EMBEDDING), nn.SiLU(), nn.Linear(EMBEDDING, EMBEDDING))
        self.summarise = nn.Sequential(nn.SiLU(), nn.Linear(EMBEDDING, context))
        self.plan = ResidualNetwork(size, condition.size - recording.size + context, width, blocks)

    def forward(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        E = self.condition.unpack(environment)
        context = self.summarise(self.embed(E.pop("recording")).mean(dim=-2))
        return self.plan(tau, step, torch.cat([*(part.flatten(1) for part in E.values()), context], dim=-1))

    def tied(self, scale: np.ndarray) -> np.ndarray:
        """Numbers an entry of E (c,), made the same for all transitions, which one map embeds: their mean over t."""
        E = self.condition.unpack(scale)
        E["recording"] = np.tile(E["recording"].mean(axis=0), (len(E["recording"]), 1))
        return self.condition.pack(**E)


def convolution(channels_in: int, channels_out: int, kernel: int) -> nn.Conv2d:
    """A convolution over time, (B, C, 1, T+1) to (B, C', 1, T+1).

    One-dimensional, but written as a (1, kernel) Conv2d: on a CPU in channels-last memory it runs at the speed of
    a plain matrix product, where Conv1d does not.
    """
    return nn.Conv2d(channels_in, channels_out, (1, kernel), padding=(0, kernel // 2))


class EncoderDecoderNetwork(nn.Module):
    """tau and its condition -> three convolutions -> latent vector -> three convolutions -> trajectory.

    Time steps are the n + m channels [x(t); u(t)] for t = 0..T, where u(T), which does not exist, is 0.
    """

    def __init__(
        self, layout: TrajectoryLayout, environment_dim: int, channels: int, kernel: int, latent_dim: int
    ) -> None:
        super().__init__()
        self.layout, self.channels, self.length = layout, channels, layout.horizon + 1
        features = layout.state_dim + layout.input_dim
        self.condition = Condition(environment_dim, channels)
        hidden = (channels, channels)
        self.encoder = nn.ModuleList(convolution(*c, kernel) for c in ((features, channels), hidden, hidden))
        self.to_latent = nn.Linear(channels * self.length, latent_dim)
        self.latent_condition = nn.Linear(channels, latent_dim)
        self.from_latent = nn.Linear(latent_dim, channels * self.length)
        self.decoder = nn.ModuleList(convolution(*c, kernel) for c in (hidden, hidden, (channels, features)))

    def forward(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        condition = self.condition(step, environment)
        return self.decode(self.encode(tau, condition))

    def encode(self, tau: Tensor, condition: Tensor) -> Tensor:
        """The latent vector, (B, latent_dim)."""
        signal = self._to_signal(tau)
        first, second, third = self.encoder
        signal = functional.silu(first(signal) + condition[:, :, None, None])
        signal = functional.silu(second(signal))
        signal = functional.silu(third(signal))
        flat = signal.permute(0, 2, 3, 1).reshape(len(signal), -1)
        return functional.silu(self.to_latent(flat) + self.latent_condition(condition))

    def decode(self, latent: Tensor) -> Tensor:
        """The trajectory of a latent vector, (B, d)."""
        first, second, third = self.decoder
        flat = functional.silu(self.from_latent(latent))
        signal = flat.reshape(len(flat), 1, self.length, self.channels).permute(0, 3, 1, 2)
        signal = functional.silu(first(signal))
        signal = functional.silu(second(signal))
        return self._to_trajectory(third(signal))

    def _to_signal(self, tau: Tensor) -> Tensor:
        """(B, n + m, 1, T+1), channels last in memory."""
        states, inputs = self.layout.split(tau)
        steps = torch.cat([states, functional.pad(inputs, (0, 0, 0, 1))], dim=-1)
        return steps[:, None].permute(0, 3, 1, 2)

    def _to_trajectory(self, signal: Tensor) -> Tensor:
        steps = signal[:, :, 0].transpose(1, 2)
        n = self.layout.state_dim
        return self.layout.flatten(steps[..., :n], steps[..., :-1, n:])

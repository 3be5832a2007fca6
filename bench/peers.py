"""Reference loops of our own, written the way that public code of this method is: correct, and with its costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from dadiff.diffusion.schedule import Schedule
from dadiff.trajectory import TrajectoryLayout


class ConvolutionNetwork(nn.Module):
    """The paper's network in `Conv1d`: three convolutions, a latent vector, three convolutions."""

    def __init__(self, layout: TrajectoryLayout, condition: int, channels: int = 256, latent: int = 128) -> None:
        super().__init__()
        self.layout, self.length, self.channels = layout, layout.horizon + 1, channels
        features = layout.state_dim + layout.input_dim
        self.condition = nn.Linear(condition + 1, channels)
        self.encoder = nn.ModuleList(nn.Conv1d(c, channels, 3, padding=1) for c in (features, channels, channels))
        self.down = nn.Linear(channels * self.length, latent)
        self.up = nn.Linear(latent, channels * self.length)
        self.decoder = nn.ModuleList(nn.Conv1d(channels, c, 3, padding=1) for c in (channels, channels, features))

    def forward(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        states, inputs = self.layout.split(tau)
        signal = torch.cat([states, functional.pad(inputs, (0, 0, 0, 1))], dim=-1).transpose(1, 2)
        signal = self.encoder[0](signal) + self.condition(torch.cat([environment, step], dim=-1))[..., None]
        for convolution in self.encoder[1:]:
            signal = convolution(functional.silu(signal))
        latent = functional.silu(self.down(functional.silu(signal).flatten(1)))
        signal = functional.silu(self.up(latent)).reshape(-1, self.channels, self.length)
        for convolution in self.decoder[:-1]:
            signal = functional.silu(convolution(signal))
        steps = self.decoder[-1](signal).transpose(1, 2)
        n = self.layout.state_dim
        return self.layout.flatten(steps[..., :n], steps[..., :-1, n:])


class FileTrainer:
    """A training step that opens one file for each trajectory of its batch, as a data set of files does."""

    def __init__(self, network: ConvolutionNetwork, schedule: Schedule, folder: Path, count: int, batch: int) -> None:
        self.network, self.schedule, self.folder, self.count, self.batch = network, schedule, folder, count, batch
        self.optimiser, self.rng = torch.optim.Adam(network.parameters(), 3e-4), np.random.default_rng(0)
        for k in range(count):
            tau = self.rng.standard_normal(network.layout.size).astype(np.float32)
            np.savez(folder / f"{k}.npz", tau=tau, environment=self.rng.standard_normal(8).astype(np.float32))

    def step(self) -> None:
        """One gradient step."""
        files = [np.load(self.folder / f"{k}.npz") for k in self.rng.integers(self.count, size=self.batch)]
        tau0 = torch.from_numpy(np.stack([file["tau"] for file in files]))
        environment = torch.from_numpy(np.stack([file["environment"] for file in files]))
        i = torch.randint(1, self.schedule.num_steps + 1, (self.batch, 1))
        a = torch.from_numpy(self.schedule.alpha_bar)[i].float()
        tau = a.sqrt() * tau0 + (1 - a).sqrt() * torch.randn_like(tau0)
        self.optimiser.zero_grad()
        functional.mse_loss(self.network(tau, i / self.schedule.num_steps, environment), tau0).backward()
        self.optimiser.step()


@torch.no_grad()
def ancestral_chain(
    network: ConvolutionNetwork, schedule: Schedule, P: Tensor, environment: Tensor, steps: int
) -> Tensor:
    """The first `steps` steps of the paper's chain with a call in each, and P applied as a dense matrix."""
    tau = torch.randn(len(environment), len(P))
    for i in range(schedule.num_steps, schedule.num_steps - steps, -1):
        beta, before, now = schedule.beta[i], schedule.alpha_bar[i - 1], schedule.alpha_bar[i]
        tau0_hat = network(tau, torch.full((len(tau), 1), i / schedule.num_steps), environment)
        mean = before**0.5 * beta / (1 - now) * tau0_hat + (1 - beta) ** 0.5 * (1 - before) / (1 - now) * tau
        tau = mean + beta**0.5 * torch.randn_like(tau)
        projected = tau @ P.T
        tau = projected + schedule.beta[i - 1] ** 0.5 * (tau - projected)
    return tau

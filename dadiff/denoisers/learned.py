"""`NetworkDenoiser`: a network, what it predicts, and the scaling of its condition.

This is the one place where the sampler's float64 meets the network's float32.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from dadiff.denoisers.description import describe
from dadiff.denoisers.networks import RecordingNetwork, features_at, step_features
from dadiff.denoisers.prediction import prediction
from dadiff.denoisers.recipes import Recipe
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ShapeError
from dadiff.trajectory import Layout, TrajectoryLayout

torch.backends.cudnn.allow_tf32 = False  # or a GPU rounds what it convolves to ten bits, without a word

CHUNK = 1024  # trajectories a network call holds activations for


class NetworkDenoiser(nn.Module):
    """tau0_hat from tau_i, i and E through a trained network.

    Args:
        network: built `on_meta`; its weights are drawn here.
        recipe: says what the network predicts.
        condition: the layout of E.
        generator: the source of the initial weights, on the CPU.

    Attributes:
        description: what a stored copy of it says of itself.
    """

    environment_mean: Tensor
    environment_scale: Tensor

    def __init__(
        self,
        network: nn.Module,
        recipe: Recipe,
        layout: TrajectoryLayout,
        condition: Layout,
        schedule: Schedule,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        table = prediction(recipe.prediction, schedule)
        self.layout, self.condition = layout, condition
        self.made_from = NetworkParts(recipe, layout, condition, schedule)
        self.description = describe(recipe, layout, condition, schedule)
        self.estimate_tau, self.estimate_output = table.estimate_tau, table.estimate_output
        self.network = network._apply(_unfilled)  # where `to_empty` would first load sympy
        initialise(self.network, generator)
        self.network.to(memory_format=torch.channels_last)  # as its signals, else each call would copy its weights
        self.register_buffer("environment_mean", torch.zeros(condition.size))
        self.register_buffer("environment_scale", torch.ones(condition.size))

    def standardise_by(self, environment: np.ndarray) -> None:
        """Scale E by the mean and deviation of a training set's (N, c); what never varies keeps its unit."""
        varies = np.ptp(environment, axis=0) > 0  # rounding gives a constant a deviation, too
        mean, deviation = environment.mean(axis=0), np.where(varies, environment.std(axis=0), 0.0)
        if isinstance(self.network, RecordingNetwork):
            mean, deviation = self.network.tied(mean), self.network.tied(deviation)
        self.environment_mean.copy_(torch.from_numpy(mean))
        self.environment_scale.copy_(torch.from_numpy(np.where(deviation > 0, deviation, 1.0)))

    def output(self, tau: Tensor, step: Tensor, environment: Tensor) -> Tensor:
        """The network's prediction, float32: tau (B, d), step (B,) or (1,), E (B, c) in physical units."""
        return self._asked(tau, step_features(step), environment)

    def _asked(self, tau: Tensor, features: Tensor, environment: Tensor) -> Tensor:
        return self.network(tau, features, (environment - self.environment_mean) / self.environment_scale)

    @torch.inference_mode()
    def forward(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """tau0_hat (..., d) from tau (..., d), i in 1..L and E broadcast against tau's leading dimensions.

        Raises:
            ShapeError: if tau or E has another last dimension than the network was built for.
        """
        return self.estimate(tau, i, environment)

    def estimate(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """The same, recorded by autograd."""
        self._check(tau, environment)
        E = environment.expand(*tau.shape[:-1], self.condition.size).reshape(-1, self.condition.size)
        flat = tau.reshape(-1, tau.shape[-1])
        step, pieces = features_at(i, tau.device), zip(flat.split(CHUNK), E.split(CHUNK), strict=True)
        outputs = [self._asked(x.float(), step, e.float()) for x, e in pieces]
        output = (torch.cat(outputs) if outputs[1:] else outputs[0]).to(tau.dtype).reshape(tau.shape)
        return float(self.estimate_tau[i]) * tau + float(self.estimate_output[i]) * output

    def _check(self, tau: Tensor, environment: Tensor) -> None:
        self.layout.check(tau)
        if environment.shape[-1] != self.condition.size:
            raise ShapeError(
                f"denoiser: the environment has {environment.shape[-1]} entries; the network was built for "
                f"{self.condition.size}; use the task that it was trained on"
            )


@dataclass(frozen=True)
class NetworkParts:
    """What a network denoiser is built from; see `Recipe.build`."""

    recipe: Recipe
    layout: TrajectoryLayout
    condition: Layout
    schedule: Schedule

    @property
    def sizes(self) -> tuple[int, int]:
        """d, and entries of E."""
        return self.layout.size, self.condition.size

    def build(self, device: str) -> NetworkDenoiser:
        """The denoiser, before its weights are filled in."""
        generator = torch.Generator()
        return self.recipe.build(self.layout, self.condition, self.schedule, generator).to(device)


def on_meta() -> AbstractContextManager[object]:
    """Modules built inside draw no initial weights: torch's own drawing would move its global random state."""
    return torch.device("meta")


def _unfilled(meta: Tensor) -> Tensor:
    return torch.empty(meta.shape, dtype=meta.dtype)


@torch.no_grad()
def initialise(network: nn.Module, generator: torch.Generator) -> None:
    """Weights ~ U(-1, 1) / sqrt(fan in), biases 0, module by module."""
    for module in network.modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)):
            bound = 1 / math.sqrt(module.weight[0].numel())
            module.weight.uniform_(-bound, bound, generator=generator)
            if module.bias is not None:
                module.bias.zero_()

"""How a denoiser is trained: the component behind `conf/training/*.yaml`. Light: no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from dadiff.denoisers.prediction import LossWeight
from dadiff.errors import ConfigError
from dadiff.memory import check_fits


@dataclass(frozen=True)
class Training:
    """Adam on |prediction - target|^2 over uniformly drawn diffusion steps; the result is the weights' running mean.

    Args:
        steps: gradient steps.
        batch_size: trajectories a step.
        learning_rate: its highest value.
        learning_rate_schedule: `constant`, or `cosine` from the highest value to 0.
        warmup: steps over which the learning rate rises linearly from 0.
        ema_decay: of the exponential running mean of the weights; 0 keeps the last weights.
        loss_weight: of the diffusion steps; `posterior_mean` is the paper's loss.
        regression: train at the diffusion step L alone, where tau_i says next to nothing: plain regression of tau on E,
            for `sampler=once`.
        precision: of the network's products in training: `bfloat16` rounds them there (autocast), on processors with
            such instructions 1.6 times faster. Weights, their running mean, the loss and all sampling stay float32.
        checkpoint_every: steps between two checkpoints.
        seed: of the initial weights, batches and noise.
    """

    steps: int = 30_000
    batch_size: int = 64
    learning_rate: float = 3e-4
    learning_rate_schedule: Literal["constant", "cosine"] = "cosine"
    warmup: int = 200
    ema_decay: float = 0.999
    loss_weight: LossWeight = "uniform"
    regression: bool = False
    precision: Literal["float32", "bfloat16"] = "float32"
    checkpoint_every: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "checkpoint_every"):
            if (value := getattr(self, name)) < 1:
                raise ConfigError(f"training: {name} is {value}; it must be at least 1")
        check_fits(16 * self.steps + 4 * self.batch_size, f"training: steps={self.steps}, batch_size={self.batch_size}")
        if not (self.learning_rate > 0 and math.isfinite(self.learning_rate)):
            raise ConfigError(f"training: learning_rate is {self.learning_rate}; it must be positive")
        if self.warmup < 0 or self.seed < 0:
            raise ConfigError(f"training: warmup is {self.warmup} and seed {self.seed}; neither may be negative")
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(f"training: ema_decay is {self.ema_decay}; it must lie in [0, 1)")

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of gradient step 0..steps-1."""
        rate = self.learning_rate * min(1.0, (step + 1) / (self.warmup + 1))
        if self.learning_rate_schedule == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * step / self.steps))
        return rate

    def ema_decay_at(self, step: int) -> float:
        """The decay of the running mean, smaller at first so that the initial weights are soon forgotten."""
        return min(self.ema_decay, (1 + step) / (10 + step))


@dataclass(frozen=True)
class InformedTraining(Training):
    """As `Training`, told of the dynamics x(t+1) = A x(t) + B u(t) + c that demonstrations obey on the whole.

    They are found by least squares, so that of many robots they are those of an average one.

    Args:
        residual_weight: of the mean square of G tau0_hat - g, added to the loss: physics-informed diffusion models
            (Bastek, Sun & Kochmann 2025).
        projects: the loss is that of P(tau0_hat), with P the orthogonal projection onto the trajectories of those
            dynamics: projection within training, as of DDAT (Bouvier et al. 2025).
    """

    residual_weight: float = 0.0
    projects: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.residual_weight < math.inf:
            raise ConfigError(f"training: residual_weight is {self.residual_weight}; it must be finite and at least 0")

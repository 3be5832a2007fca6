"""What a network predicts, and the clean estimate that follows from it.

With tau_i = a tau_0 + s eps, a = sqrt(alpha_bar_i), s = sqrt(1 - alpha_bar_i) (eq. 3 of Ho, Jain & Abbeel 2020),

    clean       target tau_0              tau0_hat = output
    noise       target eps                tau0_hat = tau_i / a - (s / a) output
    velocity    target a eps - s tau_0    tau0_hat = a tau_i - s output     (Salimans & Ho 2022)

Everything is linear, so four numbers a step say it all. numpy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError

PredictionChoice = Literal["clean", "noise", "velocity"]
LossWeight = Literal["uniform", "posterior_mean"]

LEAST_ALPHA_BAR = 1e-12  # below, 1/sqrt(alpha_bar) multiplies float32 rounding beyond the size of the data


@dataclass(frozen=True)
class Prediction:
    """target = target_clean tau_0 + target_noise eps;  tau0_hat = estimate_tau tau_i + estimate_output output.

    Each array is (L+1,), one entry a step. Step 0 is clean data and never predicted.
    """

    target_clean: np.ndarray
    target_noise: np.ndarray
    estimate_tau: np.ndarray
    estimate_output: np.ndarray


def prediction(choice: PredictionChoice, schedule: Schedule) -> Prediction:
    """The coefficients of one choice under a schedule.

    Raises:
        ConfigError: for noise prediction where alpha_bar_L vanishes: tau_L holds no signal, so the noise
            says nothing of tau_0 and the clean estimate would divide by zero.
    """
    a, s = np.sqrt(schedule.alpha_bar), np.sqrt(1 - schedule.alpha_bar)
    zero, one = np.zeros_like(a), np.ones_like(a)
    if choice == "clean":
        return Prediction(one, zero, zero, one)
    if choice == "velocity":
        return Prediction(-s, a, a, -s)
    if schedule.alpha_bar[-1] < LEAST_ALPHA_BAR:
        raise ConfigError(
            f"denoiser: prediction=noise divides by sqrt(alpha_bar_L), and this schedule has alpha_bar_L = "
            f"{schedule.alpha_bar[-1]:.3g} (needed: at least {LEAST_ALPHA_BAR:g}); choose prediction=clean or "
            "velocity, or another schedule"
        )
    return Prediction(zero, one, 1 / a, -s / a)


def loss_weights(choice: LossWeight, schedule: Schedule, table: Prediction) -> np.ndarray:
    """The weight of a step's squared error in the predicted quantity, (L+1,), with mean 1 over i = 1..L.

    `uniform` weighs all steps alike. `posterior_mean` is the paper's loss, |mu_q - mu_theta|^2: the clean estimate
    enters mu_q with the factor sqrt(alpha_bar_{i-1}) beta_i / (1 - alpha_bar_i), and the error of the clean
    estimate is `estimate_output` times that of the prediction. A common factor is absorbed by the learning rate,
    and is chosen so that losses of both kinds are of like size.
    """
    if choice == "uniform":
        return np.ones(schedule.num_steps + 1)
    alpha_bar, factor = schedule.alpha_bar, np.zeros(schedule.num_steps + 1)
    factor[1:] = np.sqrt(alpha_bar[:-1]) * schedule.beta[1:] / (1 - alpha_bar[1:])
    weight = (factor * table.estimate_output) ** 2
    return weight / weight[1:].mean()

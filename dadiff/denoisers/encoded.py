"""`EncodedDenoiser`: a network that is told features of E and predicts the difference to a reference that E determines.

The chain, its coordinates and its projections see an ordinary denoiser of tau.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from dadiff.denoisers.learned import NetworkDenoiser, NetworkParts
from dadiff.diffusion.schedule import Schedule
from dadiff.trajectory.coordinates import Coordinates


class Encoder(Protocol):
    """What is asked of `dadiff.tasks.encodings.Encoder`."""

    def encode(self, environment: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True)
class EncodedParts:
    """What an encoded denoiser is made of, besides weights: enough to build one that they fit into."""

    network: NetworkParts
    encoder: Encoder
    coordinates: Coordinates
    schedule: Schedule

    @property
    def sizes(self) -> tuple[int, None]:
        """d; the network is told features of E."""
        return self.network.layout.size, None

    def build(self, device: str = "cpu") -> EncodedDenoiser:
        """The denoiser, its weights yet to be filled in."""
        return EncodedDenoiser(self.network.build(device), self.encoder, self.coordinates, self.schedule)


class _Seen(NamedTuple):
    environment: Tensor
    features: Tensor
    reference: Tensor


class EncodedDenoiser:
    """With r = reference(E) in the sampler's coordinates, tau_i - sqrt(alpha_bar_i) r is tau_0 - r noised alike, so

        tau0_hat = r + network(tau_i - sqrt(alpha_bar_i) r, i, features(E))

    whatever the network predicts.

    Args:
        network: trained on tau_0 - r and features.
    """

    def __init__(
        self, network: NetworkDenoiser, encoder: Encoder, coordinates: Coordinates, schedule: Schedule
    ) -> None:
        self.network, self.encoder, self.coordinates = network, encoder, coordinates
        self.made_from = EncodedParts(network.made_from, encoder, coordinates, schedule)
        self.signal = np.sqrt(schedule.alpha_bar)
        self._last: _Seen | None = None

    @torch.inference_mode()
    def __call__(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """tau0_hat (..., d) from tau (..., d), i in 1..L and E (..., c) in physical units."""
        if self._last is None or self._last.environment is not environment:  # a chain asks for the same one each step
            self._last = self._look(environment)
        return self._asked(self.network, tau, i, self._last)

    def estimate(self, tau: Tensor, i: int, environment: Tensor) -> Tensor:
        """The same, recorded by autograd."""
        return self._asked(self.network.estimate, tau, i, self._look(environment))

    def _asked(self, network: Callable[[Tensor, int, Tensor], Tensor], tau: Tensor, i: int, seen: _Seen) -> Tensor:
        return seen.reference + network(tau - float(self.signal[i]) * seen.reference, i, seen.features)

    def _look(self, environment: Tensor) -> _Seen:
        features, reference = self.encoder.encode(environment.flatten(0, -2).cpu().numpy().astype(float))
        parts = (features, self.coordinates.to_scaled(reference))
        return _Seen(environment, *(environment.new_tensor(a).unflatten(0, environment.shape[:-1]) for a in parts))

    def state_dict(self) -> dict[str, Tensor]:
        """The network's."""
        return self.network.state_dict()

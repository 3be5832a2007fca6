"""Denoisers: what estimates the clean trajectory tau_0 from a noised tau_i and the environment E.

    recipes.py      the components: `EncoderDecoder`, `MLP`, `RecordingMLP`, `Gaussian`, ...; light, without torch
    prediction.py   what a network predicts (clean, noise, velocity) and how the clean estimate follows
    networks.py     the networks
    learned.py      `NetworkDenoiser`: network, prediction, scaling of E; the casts between float64 and float32
    encoded.py      `EncodedDenoiser`: a network that is told features of E and predicts the difference to a reference
    exact.py        `ExactDenoiser`: the posterior mean of a Gaussian law; `Smoother`: of a closed loop's, in O(T)
    training.py     `Training`: the component; light, without torch
    learning.py     `train`: the loop, its interruption and resumption
    checkpoints.py  files of weights: safetensors with a typed description

A denoiser is called as `tau0_hat = denoiser(tau, i, environment)` with float64 tensors tau (..., d) in the
sampler's coordinates, the diffusion step i in 1..L, and E (..., c) in physical units.
"""

from dadiff.denoisers.recipes import MLP, EncoderDecoder, Gaussian, InputsMLP, MomentMatched, RecordingMLP

__all__ = ["MLP", "EncoderDecoder", "Gaussian", "InputsMLP", "MomentMatched", "RecordingMLP"]

"""How fast data are drawn and plans sampled, and what projecting adds to it.

python -m bench.sampling
"""

from __future__ import annotations

import time

import torch

from bench.training import LQR_LAYOUT, SCHEDULE, seconds
from dadiff.behaviours import Known
from dadiff.denoisers import EncoderDecoder
from dadiff.diffusion.chain import sample
from dadiff.diffusion.enforcement import Normalised
from dadiff.diffusion.samplers import DDPM, skipped_weight
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.systems import double_integrator
from dadiff.tasks import LQR

PLANS = 1000


def bench_data(count: int = 10_000) -> None:
    """Demonstrations of the LQR task."""
    system, task = double_integrator(), LQR()
    least = min(seconds(lambda: task.demonstrations(system, count, numpy_generator(0, "bench"))) for _ in range(5))
    print(f"{count} LQR trajectories in {least:.2f} s (at most 1)")


def bench_projection(plans: int = PLANS) -> None:
    """The full DDPM chain of the paper's network (untrained, which takes as long), and the projections within it."""
    system = double_integrator()
    denoiser = EncoderDecoder().build(LQR_LAYOUT, LQR().condition(system), SCHEDULE, torch_generator(0, "bench"))
    projection = Known().fit(LQR_LAYOUT, system).bind()
    spent = [0.0]

    def project(tau: torch.Tensor) -> torch.Tensor:
        begun = time.perf_counter()
        projected = projection(tau)
        spent[0] += time.perf_counter() - begun
        return projected

    sampler, environment = DDPM(), torch.zeros(plans, 8, dtype=torch.float64)
    begun = time.perf_counter()
    drawn = sample(
        sampler, SCHEDULE, denoiser, environment, (plans, LQR_LAYOUT.size), torch_generator(0, "noise"), project,
        Normalised(), progress=True,
    )  # fmt: skip
    elapsed = time.perf_counter() - begun
    steps = sampler.steps(SCHEDULE)
    print(f"encoder_decoder, ddpm, L = {len(steps)}, {plans} plans, {torch.get_num_threads()} threads: {elapsed:.0f} s")
    print(f"  network calls {drawn.network_calls} (at most 200); skipped weight {skipped_weight(steps):.1e}")
    print(f"  {len(steps)} projections take {spent[0]:.2f} s: {spent[0] / elapsed:.2%} of the sampling (at most 2 %)")


def main() -> None:
    """Print the figures."""
    bench_data()
    bench_projection()


if __name__ == "__main__":
    main()

"""Whether many robots, each with its own projector, are sampled as fast as one.

    python bench/fleet.py            # about a minute on two cores

20 robots x 100 cases x 1 sample against the same 2,000 plans for one robot, with denoiser=mlp, ddim and x(0) held:
the heaviest projection. The two are interleaved and the least time of each is taken: other work only adds.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from dadiff.behaviours import Known, Pin
from dadiff.denoisers import MLP
from dadiff.diffusion.chain import sample
from dadiff.diffusion.enforcement import Normalised
from dadiff.diffusion.samplers import DDIM
from dadiff.diffusion.schedule import paper_linear
from dadiff.randomness import torch_generator
from dadiff.systems import DampedIntegrators
from dadiff.tasks import LQR

HORIZON, PLANS = 30, 2000
SCHEDULE = paper_linear()


class Fleet:
    """`robots` test robots that share 2,000 plans."""

    def __init__(self, robots: int) -> None:
        rng = np.random.default_rng(0)
        system = DampedIntegrators().inside(robots, rng)
        self.layout = system.layout(HORIZON)
        self.shape = (robots, PLANS // robots, self.layout.size)
        x_init = rng.uniform(-1, 1, (*self.shape[:2], system.state_dim))
        begun = time.perf_counter()
        self.projection = (
            Known("fixed").fit(self.layout, system).bind(pins=[Pin.initial_state(self.layout, x_init)], device="cpu")
        )
        self.setup = time.perf_counter() - begun
        self.environment = torch.as_tensor(rng.uniform(-4, 4, (*self.shape[:2], 8)))
        condition = LQR().condition(system)
        self.denoiser = MLP().build(self.layout, condition, SCHEDULE, torch_generator(0, "initialisation"))

    def sampling(self) -> float:
        """Seconds to draw all plans."""
        begun = time.perf_counter()
        sample(
            DDIM(), SCHEDULE, self.denoiser, self.environment, self.shape, torch_generator(0, "noise"),
            self.projection, Normalised(),
        )  # fmt: skip
        return time.perf_counter() - begun

    def projecting(self) -> float:
        """Seconds of one projection of all plans."""
        tau = torch.zeros(self.shape, dtype=torch.float64)
        begun = time.perf_counter()
        self.projection(tau)
        return time.perf_counter() - begun


def main(repeats: int = 5) -> None:
    one, many = Fleet(1), Fleet(20)
    seconds = np.array([(one.sampling(), many.sampling()) for _ in range(repeats)]).min(axis=0)
    call = np.array([(one.projecting(), many.projecting()) for _ in range(20)]).min(axis=0)
    print(f"{PLANS} plans of one robot {seconds[0]:.2f} s, of 20 robots {seconds[1]:.2f} s")
    print(f"  ratio {seconds[1] / seconds[0]:.2f} (at most 1.3), {torch.get_num_threads()} threads")
    print(f"  one projection {1e3 * call[0]:.1f} and {1e3 * call[1]:.1f} ms")
    print(f"  setup {one.setup:.2f} and {many.setup:.2f} s")


if __name__ == "__main__":
    main()

"""How fast denoisers train, and what the quick training reaches.

    python bench/training.py            # both parts, about three minutes on two cores
    python bench/training.py step       # the training step of the paper's network alone
    python bench/training.py quick      # denoiser=mlp training=quick alone

What is compared is interleaved, and the least time of each is taken: other work on the machine only adds.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import yaml

from dadiff.denoisers import MLP, EncoderDecoder
from dadiff.denoisers.learned import NetworkDenoiser
from dadiff.denoisers.learning import Objective, train
from dadiff.denoisers.recipes import Recipe
from dadiff.denoisers.training import Training
from dadiff.diffusion.chain import sample
from dadiff.diffusion.samplers import DDIM, DDPM, Sampler
from dadiff.diffusion.schedule import paper_linear
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.systems import double_integrator
from dadiff.tasks import LQR
from dadiff.trajectory import TrajectoryLayout
from dadiff.trajectory.coordinates import Coordinates, physical, standardised

BATCH = 64
MATRIX = 2048
CONF = Path(__file__).parents[1] / "conf"
LQR_LAYOUT = TrajectoryLayout(state_dim=4, input_dim=2, horizon=30)
CONDITION = LQR().condition(double_integrator())
SCHEDULE = paper_linear()


def seconds(action: Callable[[], object]) -> float:
    begun = time.perf_counter()
    action()
    return time.perf_counter() - begun


def multiply_adds(recipe: EncoderDecoder, layout: TrajectoryLayout) -> int:
    """Of one sample and call of the paper's network: six convolutions, two linear maps."""
    length, features, C = layout.horizon + 1, layout.state_dim + layout.input_dim, recipe.channels
    convolutions = length * recipe.kernel * (2 * features * C + 4 * C * C)
    return convolutions + 2 * length * C * recipe.latent_dim


def training_step(recipe: Recipe) -> Callable[[], None]:
    generator = torch_generator(0, "bench")
    denoiser = recipe.build(LQR_LAYOUT, CONDITION, SCHEDULE, generator)
    optimiser = torch.optim.Adam(denoiser.parameters(), fused=True)
    objective = Objective(recipe, SCHEDULE, Training(), "cpu")
    tau0, eps = torch.randn(2, BATCH, LQR_LAYOUT.size, generator=generator)
    E, i = torch.randn(BATCH, 8, generator=generator), torch.randint(1, 1001, (BATCH,), generator=generator)

    def step() -> None:
        optimiser.zero_grad()
        objective(denoiser, tau0, E, i, eps).backward()
        optimiser.step()

    return step


def bench_step(repeats: int = 30) -> None:
    """A training step against its multiply-adds alone (forward once, backward twice) at the rate of one matmul."""
    recipe = EncoderDecoder()
    step = training_step(recipe)
    a, b = torch.randn(2, MATRIX, MATRIX)
    times = np.array([(seconds(step), seconds(lambda: a @ b)) for _ in range(repeats)])
    least_step, least_matmul = times[2:].min(axis=0)
    work = 3 * BATCH * multiply_adds(recipe, LQR_LAYOUT)
    arithmetic = work * least_matmul / MATRIX**3
    print(f"encoder_decoder, {torch.get_num_threads()} threads: {work / 3 / BATCH / 1e6:.1f} M multiply-adds a sample")
    print(
        f"  training step at batch {BATCH} {1e3 * least_step:.1f} ms, its multiply-adds alone {1e3 * arithmetic:.1f} ms"
    )
    print(f"  ratio {least_step / arithmetic:.2f} (at most 1.5)")


def state_error(denoiser: NetworkDenoiser, coordinates: Coordinates, sampler: Sampler) -> tuple[float, float, float]:
    """Means of |x(t) - x_ref(t)|^2 and |u(t) - u_ref(t)|^2 of 100 cases x 10 plans, and seconds."""
    system = double_integrator(process_noise=0.02)
    cases = LQR().cases(system, 100, numpy_generator(0, "cases"))
    E = torch.from_numpy(cases.environment)[:, None]
    begun = time.perf_counter()
    plans = sample(sampler, SCHEDULE, denoiser, E, (100, 10, LQR_LAYOUT.size), torch_generator(0, "sampling")).tau
    elapsed = time.perf_counter() - begun
    error = coordinates.to_physical(plans).numpy() - cases.reference[:, None]
    states, inputs = LQR_LAYOUT.split(error)
    return float((states**2).sum(-1).mean()), float((inputs**2).sum(-1).mean()), elapsed


def bench_quick(choice: str = "physical") -> None:
    """denoiser=mlp training=quick on 10,000 LQR trajectories, process noise 0.02, against the noise-free optimum."""
    system = double_integrator(process_noise=0.02)
    data = LQR().demonstrations(system, 10_000, numpy_generator(0, "demonstrations"))
    coordinates = physical(LQR_LAYOUT) if choice == "physical" else standardised(LQR_LAYOUT, data.trajectories)
    fields = yaml.safe_load((CONF / "training/quick.yaml").read_text()) | {"seed": 0}
    training = Training(**{name: value for name, value in fields.items() if name != "_target_"})
    scaled = coordinates.to_scaled(data.trajectories)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        denoiser = train(
            MLP(), LQR_LAYOUT, CONDITION, SCHEDULE, training, scaled, data.environment, Path(folder), progress=False
        )
        elapsed = time.perf_counter() - begun
    print(
        f"mlp, training=quick, coordinates={choice}, {torch.get_num_threads()} threads: {elapsed:.0f} s (at most 120)"
    )
    for name, sampler in (("ddim, 50 steps", DDIM()), ("ddpm, no last-step noise", DDPM(last_step_noise=False))):
        states, inputs, sampling = state_error(denoiser, coordinates, sampler)
        print(f"  {name}: state error {states:.2e}, input error {inputs:.2e}, 1,000 plans in {sampling:.1f} s")


def main() -> None:
    parts = {"step": bench_step, "quick": bench_quick}
    for name in sys.argv[1:] or parts:
        parts[name]()


if __name__ == "__main__":
    main()

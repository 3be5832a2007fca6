"""Training: Adam on noised demonstrations, with checkpoints from which it resumes bit for bit (on a CPU).

Everything that the rest of a training depends on is in the checkpoint: weights, their running mean, Adam's moments,
the states of the generators and the number of steps done. Data lie in memory; batches are gathered by index.
"""

from __future__ import annotations

import csv
import logging
import signal
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from dadiff.denoisers.checkpoints import fill, read, save, write
from dadiff.denoisers.description import Description
from dadiff.denoisers.learned import NetworkDenoiser
from dadiff.denoisers.prediction import loss_weights, prediction
from dadiff.denoisers.recipes import Recipe
from dadiff.denoisers.training import InformedTraining, Training
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import DataError, ShapeError
from dadiff.randomness import torch_generator
from dadiff.trajectory import Layout, TrajectoryLayout

Augment = Callable[[Tensor, torch.Generator], Tensor]

CURVE_ROWS = 500
ROLES = ("training batches", "training noise", "training augmentation")

log = logging.getLogger(__name__)


def train(
    recipe: Recipe,
    layout: TrajectoryLayout,
    condition: Layout,
    schedule: Schedule,
    training: Training,
    trajectories: np.ndarray,
    environment: np.ndarray,
    folder: Path,
    device: str = "cpu",
    augment: Augment | None = None,
    *,
    dynamics: tuple[np.ndarray, np.ndarray] | None = None,
    progress: bool = True,
) -> NetworkDenoiser:
    """The denoiser trained on demonstrations; continues from `folder/checkpoint.safetensors` where there is one.

    Writes `model.safetensors` (the running mean of the weights) and `training.csv` (the loss curve), and removes the
    checkpoint. An interruption (SIGINT) takes effect between two steps, after a checkpoint.

    Args:
        condition: the layout of E.
        trajectories: (N, d), in the sampler's coordinates.
        environment: (N, c), in physical units.
        augment: maps a batch of E (B, c) to an equivalent one, drawing from the given generator.
        dynamics: G (q, d) and g (q,) in the sampler's coordinates, of an `InformedTraining`.

    Raises:
        ShapeError, DataError: if the arrays disagree with the layout or hold values that are not finite.
        CheckpointError: if the folder's checkpoint is damaged or belongs to another training.
    """
    _check_data(layout, condition, trajectories, environment)
    objective = Objective(recipe, schedule, training, device)
    if isinstance(training, InformedTraining) and dynamics is not None:
        objective = InformedObjective(recipe, schedule, training, device, *dynamics)
    data = Data(trajectories, environment, schedule.num_steps, training, device, augment)
    state = State(_untrained(recipe, layout, condition, schedule, training, environment).to(device), training)
    checkpoint = folder / "checkpoint.safetensors"
    description = {**state.denoiser.description, **_training_description(training, trajectories, environment)}
    if checkpoint.exists():
        state.resume(checkpoint, data, description)
        log.info("training resumes at step %d of %d from %s", state.step, training.steps, checkpoint)
    with deferred_interrupt() as interrupted, _progress_bar(training, state, shown=progress) as bar:
        while state.step < training.steps:
            state.advance(objective, data)
            bar.update()
            if interrupted or state.step % training.checkpoint_every == 0:
                state.store(checkpoint, data, description)
                bar.set_postfix(loss=f"{state.recent_loss():.2e}")
            if interrupted:
                raise KeyboardInterrupt(f"training stopped at step {state.step}; the same command resumes it")
    return _finish(state, folder)


def _finish(state: State, folder: Path) -> NetworkDenoiser:
    with torch.no_grad():
        for weight, mean in zip(state.weights, state.running_mean, strict=True):
            weight.copy_(mean)
    state.write_curve(folder / "training.csv")
    save(state.denoiser, folder / "model.safetensors")
    (folder / "checkpoint.safetensors").unlink(missing_ok=True)
    return state.denoiser


class Objective:
    """The weighted squared error of a prediction, all its numbers gathered from one table by step."""

    def __init__(self, recipe: Recipe, schedule: Schedule, training: Training, device: str) -> None:
        alpha_bar, table = schedule.alpha_bar, prediction(recipe.prediction, schedule)
        weight = loss_weights(training.loss_weight, schedule, table)
        columns = [np.sqrt(alpha_bar), np.sqrt(1 - alpha_bar), table.target_clean, table.target_noise, weight]
        columns += [table.estimate_tau, table.estimate_output]
        self._columns = torch.from_numpy(np.stack(columns, axis=-1)).float().to(device)
        self._device, self._rounded = torch.device(device).type, training.precision == "bfloat16"

    def __call__(self, denoiser: NetworkDenoiser, tau0: Tensor, E: Tensor, i: Tensor, eps: Tensor) -> Tensor:
        """Mean over a batch: tau0 and eps (B, d), E (B, c), i (B,)."""
        a, s, clean, noise, weight, *_ = self._columns[i, :, None].unbind(1)
        target = clean * tau0 + noise * eps
        return (weight * (self._output(denoiser, a * tau0 + s * eps, i, E) - target) ** 2).mean()

    def _output(self, denoiser: NetworkDenoiser, tau: Tensor, i: Tensor, E: Tensor) -> Tensor:
        with torch.autocast(self._device, torch.bfloat16, enabled=self._rounded):
            output = denoiser.output(tau, i, E)
        return output.float()


class InformedObjective(Objective):
    """The squared error of the clean estimate, which is projected onto G tau = g or pays for its distance from it."""

    def __init__(
        self,
        recipe: Recipe,
        schedule: Schedule,
        training: InformedTraining,
        device: str,
        G: np.ndarray,
        g: np.ndarray,
    ) -> None:
        super().__init__(recipe, schedule, training, device)
        inverse = np.linalg.pinv(G)
        matrices = (G, g, np.eye(G.shape[-1]) - inverse @ G, inverse @ g)
        self._G, self._g, self._P, self._origin = (torch.from_numpy(M).float().to(device) for M in matrices)
        self._residual_weight, self._projects = training.residual_weight, training.projects

    def __call__(self, denoiser: NetworkDenoiser, tau0: Tensor, E: Tensor, i: Tensor, eps: Tensor) -> Tensor:
        """As of `Objective`."""
        a, s, *_, from_tau, from_output = self._columns[i, :, None].unbind(1)
        tau = a * tau0 + s * eps
        tau0_hat = from_tau * tau + from_output * self._output(denoiser, tau, i, E)
        estimate = tau0_hat @ self._P.T + self._origin if self._projects else tau0_hat
        residual = tau0_hat @ self._G.T - self._g
        return (estimate - tau0).square().mean() + self._residual_weight * residual.square().mean()


class Data:
    """Demonstrations in memory as float32, and the generators that draw batches of them.

    Generators live on the CPU, so that every device sees the same batches and noise.
    """

    def __init__(
        self,
        trajectories: np.ndarray,
        environment: np.ndarray,
        num_steps: int,
        training: Training,
        device: str,
        augment: Augment | None,
    ) -> None:
        self.trajectories = torch.from_numpy(trajectories).float()
        self.environment = torch.from_numpy(environment).float()
        self.num_steps, self.batch_size, self.device, self.augment = num_steps, training.batch_size, device, augment
        self.first = num_steps if training.regression else 1
        self.generators = {role: torch_generator(training.seed, role) for role in ROLES}

    def draw(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(tau0, E, i, eps) of one batch, i uniform on 1..L; of a regression L."""
        batches, noise, augmentation = self.generators.values()
        chosen = torch.randint(len(self.trajectories), (self.batch_size,), generator=batches)
        tau0, E = self.trajectories[chosen], self.environment[chosen]
        i = torch.randint(self.first, self.num_steps + 1, (self.batch_size,), generator=noise)
        eps = torch.randn(tau0.shape, generator=noise)
        if self.augment is not None:
            E = self.augment(E, augmentation)
        return tau0.to(self.device), E.to(self.device), i.to(self.device), eps.to(self.device)


@dataclass
class State:
    """A training under way.

    Attributes:
        step: gradient steps done.
        adam: of Adam's state its parts, as torch calls them; like `running_mean` of `weights`, in their order.
        losses, seconds: per step, (steps,).
    """

    denoiser: NetworkDenoiser
    training: Training
    step: int = 0
    adam: dict[str, list[Tensor]] = field(init=False)
    running_mean: list[Tensor] = field(init=False)

    def __post_init__(self) -> None:
        self.weights: list[Tensor] = list(self.denoiser.parameters())
        self.adam = {name: [torch.zeros_like(w) for w in self.weights] for name in ("exp_avg", "exp_avg_sq")}
        self.adam["step"] = [torch.zeros((), device=w.device) for w in self.weights]
        self.running_mean = [w.detach().clone() for w in self.weights]
        self.losses = torch.zeros(self.training.steps, device=self.weights[0].device)
        self.seconds = torch.zeros(self.training.steps, dtype=torch.float64)
        self._begun = time.perf_counter()

    def advance(self, objective: Objective, data: Data) -> None:
        """One gradient step."""
        loss = objective(self.denoiser, *data.draw())
        loss.backward()
        self._descend()
        self._average()
        self.losses[self.step] = loss.detach()
        self.seconds[self.step] = time.perf_counter() - self._begun
        self.step += 1

    @torch.no_grad()
    def _descend(self) -> None:
        """A step of Adam (Kingma & Ba 2015), as `torch.optim.Adam(fused=True)`, which takes a second to be made."""
        m, v, steps = self.adam["exp_avg"], self.adam["exp_avg_sq"], self.adam["step"]
        gradients = [w.grad for w in self.weights if w.grad is not None]
        torch._foreach_add_(steps, 1)
        torch._fused_adam_(
            self.weights, gradients, m, v, [], steps, lr=self.training.learning_rate_at(self.step),
            beta1=0.9, beta2=0.999, eps=1e-8, weight_decay=0.0, amsgrad=False, maximize=False,
        )  # fmt: skip
        for w in self.weights:
            w.grad = None

    @torch.no_grad()
    def _average(self) -> None:
        torch._foreach_lerp_(self.running_mean, self.weights, 1 - self.training.ema_decay_at(self.step))

    def recent_loss(self) -> float:
        """Mean over the last 100 steps."""
        return float(self.losses[max(0, self.step - 100) : self.step].mean())

    def _tensors(self, data: Data) -> dict[str, Tensor]:
        """Everything to store, by name; the tensors are the live ones."""
        tensors = {f"denoiser.{name}": tensor for name, tensor in self.denoiser.state_dict().items()}
        for k, mean in enumerate(self.running_mean):
            tensors[f"running_mean.{k}"] = mean
        tensors |= {"losses": self.losses, "seconds": self.seconds, "step": torch.tensor(self.step)}
        tensors |= {f"generator.{role}": g.get_state() for role, g in data.generators.items()}
        tensors |= {f"adam.{k}.{name}": part for name, parts in self.adam.items() for k, part in enumerate(parts)}
        return tensors

    def store(self, path: Path, data: Data, description: Description) -> None:
        """Write a checkpoint."""
        write(path, self._tensors(data), description)

    def resume(self, path: Path, data: Data, description: Description) -> None:
        """Continue from a checkpoint: the next steps are those that an uninterrupted training would take."""
        tensors = read(path, description)
        fill(self._tensors(data), tensors, path)
        for role, generator in data.generators.items():
            generator.set_state(tensors[f"generator.{role}"])
        self.step = int(tensors["step"])
        self._begun = time.perf_counter() - float(self.seconds[self.step - 1])

    def write_curve(self, path: Path) -> None:
        """The loss curve: step, loss (mean since the last row), learning_rate, seconds."""
        stride = -(-self.training.steps // CURVE_ROWS)
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["step", "loss", "learning_rate", "seconds"])
            for first in range(0, self.training.steps, stride):
                last = min(first + stride, self.training.steps) - 1
                loss = float(self.losses[first : last + 1].mean())
                writer.writerow([last + 1, loss, self.training.learning_rate_at(last), float(self.seconds[last])])


@contextmanager
def deferred_interrupt() -> Iterator[list[bool]]:
    """Yields a list that is no longer empty once SIGINT has come; a second SIGINT acts at once.

    A step that is broken off half way cannot be resumed bit for bit. Outside the main thread, and where
    SIGINT is ignored, nothing is changed.
    """
    received: list[bool] = []
    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(previous):
        yield received
        return

    def note(number: int, frame: FrameType | None) -> None:
        received.append(True)
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, note)
    try:
        yield received
    finally:
        signal.signal(signal.SIGINT, previous)


def _untrained(
    recipe: Recipe,
    layout: TrajectoryLayout,
    condition: Layout,
    schedule: Schedule,
    training: Training,
    environment: np.ndarray,
) -> NetworkDenoiser:
    generator = torch_generator(training.seed, "initialisation")
    denoiser = recipe.build(layout, condition, schedule, generator)
    denoiser.standardise_by(environment)
    return denoiser


def _training_description(training: Training, trajectories: np.ndarray, environment: np.ndarray) -> Description:
    """What a checkpoint must share with the training that resumes it; how often it is written may differ."""
    fields = {name: value for name, value in asdict(training).items() if name != "checkpoint_every"}
    digest = zlib.crc32(environment.tobytes(), zlib.crc32(trajectories.tobytes()))
    return {**fields, "data": digest}


def _progress_bar(training: Training, state: State, *, shown: bool) -> tqdm:
    return tqdm(total=training.steps, initial=state.step, desc="training", unit="step", disable=not shown)


def _check_data(layout: TrajectoryLayout, condition: Layout, trajectories: np.ndarray, environment: np.ndarray) -> None:
    layout.check(trajectories)
    condition.check(environment)
    if trajectories.ndim != 2 or environment.ndim != 2 or len(trajectories) != len(environment):
        raise ShapeError(
            f"training: trajectories have shape {trajectories.shape} and environments {environment.shape}; "
            "expected (N, d) and (N, c)"
        )
    if not len(trajectories):
        raise DataError("training: there are no demonstrations; raise dataset.train_size, or see why none was solved")
    for name, array in (("trajectories", trajectories), ("environments", environment)):
        if not np.isfinite(array).all():
            raise DataError(f"training: the {name} hold values that are not finite; check where they come from")

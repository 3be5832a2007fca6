"""The denoisers as components: what `conf/denoiser/*.yaml` names. Light: torch is imported when a network is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from dadiff.denoisers.prediction import PredictionChoice
from dadiff.diffusion.schedule import Schedule
from dadiff.errors import ConfigError
from dadiff.memory import check_fits
from dadiff.trajectory import Layout, TrajectoryLayout

if TYPE_CHECKING:
    import torch

    from dadiff.denoisers.exact import Law, PosteriorMean
    from dadiff.denoisers.learned import NetworkDenoiser
    from dadiff.trajectory.coordinates import Coordinates


class Recipe(Protocol):
    """A trainable denoiser: a dataclass that builds its network for given sizes."""

    trainable: ClassVar[bool]

    @property
    def prediction(self) -> PredictionChoice:
        """What the network predicts."""
        ...

    def build(
        self, layout: TrajectoryLayout, condition: Layout, schedule: Schedule, generator: torch.Generator
    ) -> NetworkDenoiser:
        """The untrained denoiser; all its weights are drawn from the generator.

        Args:
            layout: of tau.
            condition: the layout of E.
        """
        ...


@runtime_checkable
class ExactRecipe(Protocol):
    """A denoiser that is known and not trained; `matched` tells whether its law is that of the demonstrations' moments.

    Else it is the task's.
    """

    trainable: ClassVar[bool]
    matched: ClassVar[bool]

    def exact(self, law: Law, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> PosteriorMean:
        """The denoiser for the law of the clean trajectories."""
        ...


def _check_positive(component: str, **sizes: int) -> None:
    for name, value in sizes.items():
        if value < 1:
            raise ConfigError(f"denoiser {component}: {name} is {value}; it must be at least 1")


def _check_trainable(weights: int, **sizes: int) -> None:
    """Whether so many weights fit, with their gradients, Adam's two moments and the running mean."""
    check_fits(5 * 4 * weights, "denoiser: " + ", ".join(f"{name}={value}" for name, value in sizes.items()))


@dataclass(frozen=True)
class EncoderDecoder:
    """The paper's network (Section IV-A): three convolutions to a latent vector, three back.

    Args:
        channels: hidden channels of every convolution.
        kernel: width of the convolutions in time steps, odd.
        latent_dim: size of the bottleneck; the paper does not state it.
        prediction: what the network predicts.
    """

    trainable: ClassVar[bool] = True

    channels: int = 256
    kernel: int = 3
    latent_dim: int = 128
    prediction: PredictionChoice = "clean"

    def __post_init__(self) -> None:
        _check_positive("encoder_decoder", channels=self.channels, kernel=self.kernel, latent_dim=self.latent_dim)
        weights = self.channels * (4 * self.channels * self.kernel + 2 * self.latent_dim)
        _check_trainable(weights, channels=self.channels, kernel=self.kernel, latent_dim=self.latent_dim)
        if self.kernel % 2 == 0:
            raise ConfigError(f"denoiser encoder_decoder: kernel is {self.kernel}; it must be odd to keep the horizon")

    def build(
        self, layout: TrajectoryLayout, condition: Layout, schedule: Schedule, generator: torch.Generator
    ) -> NetworkDenoiser:
        """See `Recipe.build`."""
        from dadiff.denoisers.learned import NetworkDenoiser, on_meta
        from dadiff.denoisers.networks import EncoderDecoderNetwork

        with on_meta():
            network = EncoderDecoderNetwork(layout, condition.size, self.channels, self.kernel, self.latent_dim)
        return NetworkDenoiser(network, self, layout, condition, schedule, generator)


@dataclass(frozen=True)
class MLP:
    """Residual blocks on the flat trajectory: fewer operations than the paper's network at like error.

    Args:
        width: hidden units.
        blocks: residual blocks of two layers each.
        prediction: what the network predicts.
    """

    trainable: ClassVar[bool] = True

    width: int = 512
    blocks: int = 3
    prediction: PredictionChoice = "clean"

    def __post_init__(self) -> None:
        _check_positive("mlp", width=self.width, blocks=self.blocks)
        _check_trainable(2 * self.blocks * self.width**2, width=self.width, blocks=self.blocks)

    def build(
        self, layout: TrajectoryLayout, condition: Layout, schedule: Schedule, generator: torch.Generator
    ) -> NetworkDenoiser:
        """See `Recipe.build`."""
        from dadiff.denoisers.learned import NetworkDenoiser, on_meta
        from dadiff.denoisers.networks import ResidualNetwork

        with on_meta():
            network = ResidualNetwork(layout.size, condition.size, self.width, self.blocks)
        return NetworkDenoiser(network, self, layout, condition, schedule, generator)


@dataclass(frozen=True)
class InputsMLP(MLP):
    """`MLP` that sees the inputs alone: a diffusion over u given E. It predicts clean trajectories.

    With `projector=rollout enforcement=clean_estimate` states follow from x_init and the inputs at every step, so that
    dynamics hold exactly without a projection: diffusion in the subspace of the behaviour.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.prediction != "clean":
            raise ConfigError(
                f"denoiser mlp_inputs: prediction is {self.prediction}; noise of states that it does not see cannot "
                "be predicted: use clean"
            )

    def build(
        self, layout: TrajectoryLayout, condition: Layout, schedule: Schedule, generator: torch.Generator
    ) -> NetworkDenoiser:
        """See `Recipe.build`."""
        from dadiff.denoisers.learned import NetworkDenoiser, on_meta
        from dadiff.denoisers.networks import InputsNetwork

        with on_meta():
            network = InputsNetwork(layout, condition.size, self.width, self.blocks)
        return NetworkDenoiser(network, self, layout, condition, schedule, generator)


@dataclass(frozen=True)
class RecordingMLP:
    """`MLP` for an E that holds a `recording`, the transitions of a short one: learns to identify the robot.

    Args:
        width: hidden units.
        blocks: residual blocks of two layers each.
        context: numbers that the recording is summarised by.
        prediction: what the network predicts.
    """

    trainable: ClassVar[bool] = True

    width: int = 512
    blocks: int = 3
    context: int = 64
    prediction: PredictionChoice = "clean"

    def __post_init__(self) -> None:
        _check_positive("mlp_recording", width=self.width, blocks=self.blocks, context=self.context)
        weights = self.width * (2 * self.blocks * self.width + self.context)
        _check_trainable(weights, width=self.width, context=self.context)

    def build(
        self, layout: TrajectoryLayout, condition: Layout, schedule: Schedule, generator: torch.Generator
    ) -> NetworkDenoiser:
        """See `Recipe.build`."""
        from dadiff.denoisers.learned import NetworkDenoiser, on_meta
        from dadiff.denoisers.networks import RecordingNetwork

        if "recording" not in condition:
            raise ConfigError(
                f"denoiser mlp_recording: E has {', '.join(condition.names)} and holds no recording; "
                "use task=fleet task.condition_on=recording, or denoiser=mlp"
            )
        with on_meta():
            network = RecordingNetwork(layout.size, condition, self.width, self.blocks, self.context)
        return NetworkDenoiser(network, self, layout, condition, schedule, generator)


@dataclass(frozen=True)
class Gaussian:
    """The exact posterior mean where the law of demonstrations is Gaussian given E. Nothing is trained."""

    trainable: ClassVar[bool] = False
    matched: ClassVar[bool] = False

    def exact(self, law: Law, coordinates: Coordinates, schedule: Schedule, device: str = "cpu") -> PosteriorMean:
        """The denoiser of one law, in the coordinates in which the sampler works."""
        from dadiff.denoisers.exact import ExactParts

        return ExactParts(law, coordinates, schedule).build(device)


@dataclass(frozen=True)
class MomentMatched(Gaussian):
    """The posterior mean of the Gaussian law with the demonstrations' first two moments given E.

    It knows of many robots what a Gaussian can know, without a network's error: the prior of the exact bench.
    """

    matched: ClassVar[bool] = True

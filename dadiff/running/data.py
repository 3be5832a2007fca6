"""What is to be known of a run's data: do they obey the system, are tests among what was learned, or far from it?"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from dadiff.datasets import NpzTrajectories
from dadiff.datasets.own import OwnEnvironments
from dadiff.datasets.physics import Plant, judge
from dadiff.systems import Recording, Unknown
from dadiff.trajectory import Layout

if TYPE_CHECKING:
    from dadiff.running.assembly import Experiment

FAR = 0.5
"""Of the width of what was learned from: a condition that lies further outside is far."""

log = logging.getLogger(__name__)


def told_of_data(experiment: Experiment) -> dict[str, float]:
    """`recording_residual`, `demonstrations_residual` and `cases_residual` over the noise, `also_in_train` and
    `outside_training`, both in cases, as far as data come from files.

    Raises:
        DataError: if data of an unknown system do not obey what its recording says.
    """  # fmt: skip
    dataset, told = experiment.parts.dataset, dict[str, float]()
    if isinstance(dataset, NpzTrajectories):
        told["demonstrations_residual"] = experiment.demonstrations.notes["residual"]
        told["cases_residual"] = experiment.cases.notes["residual"]
        told["also_in_train"] = experiment.cases.notes["also_in_train"]
        if isinstance(experiment.target, Unknown) and "recording" in experiment.sources:
            told["demonstrations_residual"] = agreement(experiment, dataset)
    if isinstance(dataset, NpzTrajectories | OwnEnvironments) and experiment.parts.denoiser.trainable:
        told["outside_training"] = outside(
            experiment.condition, experiment.demonstrations.environment, experiment.cases.environment
        )
    return told


def agreement(experiment: Experiment, dataset: NpzTrajectories) -> float:
    """The residual of demonstrations under the dynamics that a recording of an unknown system shows, over its noise."""
    recording: Recording = experiment.sources["recording"]
    plant = Plant.identified(recording.runs, "the dynamics that the recording shows")
    states, inputs = experiment.layout.split(experiment.demonstrations.trajectories)
    return judge(plant, states, inputs, f"{dataset.path}/train", dataset.allow_mismatch)


def outside(condition: Layout, learned: np.ndarray, asked: np.ndarray) -> int:
    """How many conditions E (..., c) lie far outside of the range of those (N, c) that were learned from; says which.

    Values that never varied have no width: any other one is far.
    """
    low, high = learned.min(axis=0), learned.max(axis=0)
    margin = FAR * (high - low) + np.finfo(np.float64).eps * np.abs(high)
    asked = asked.reshape(-1, asked.shape[-1])
    beyond = np.maximum(low - margin - asked, asked - high - margin)
    far = (beyond > 0).any(axis=-1)
    if far.any():
        size = np.maximum(high - low, np.maximum(np.abs(low), np.abs(high)))
        case, entry = np.unravel_index(int((beyond / np.maximum(size, 1e-12)).argmax()), beyond.shape)
        log.warning(
            "dataset: %d of %d test conditions lie far outside of what was learned from; of %s, case %d has %.4g where "
            "training had %.4g to %.4g: other units? what is planned there is a guess",
            far.sum(),
            len(far),
            _channel(condition, int(entry)),
            case,
            asked[case, entry],
            low[entry],
            high[entry],
        )
    return int(far.sum())


def _channel(condition: Layout, entry: int) -> str:
    """The channel of E that an entry lies in."""
    places = np.arange(condition.size)
    return next(name for name in condition.names if entry in places[condition.where(name)])

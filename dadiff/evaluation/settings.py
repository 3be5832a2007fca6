"""How plans are drawn for evaluation."""

from __future__ import annotations

from dataclasses import dataclass

from dadiff.errors import ConfigError


@dataclass(frozen=True)
class Evaluation:
    """How many plans are drawn, from which noise, and when a chain counts as diverged.

    Args:
        samples: plans for each test case.
        divergence_bound: a chain is stopped as diverged once a value exceeds it, in the sampler's coordinates.
        examples: number of cases whose plans are stored for figures.
        seed: of the initial and step noise, which is the same for every projector.
    """

    samples: int = 10
    divergence_bound: float = 1e6
    examples: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 1 or self.examples < 0 or not self.divergence_bound > 0:
            raise ConfigError(
                f"evaluation: samples is {self.samples}, examples {self.examples}, divergence_bound "
                f"{self.divergence_bound}; need at least 1, at least 0 and a positive number"
            )

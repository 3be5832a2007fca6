"""What the law suites run on: systems of several sizes, every component in conf/, and the one rule for tolerances."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dadiff.config import build
from dadiff.config.build import TARGET, resolve
from dadiff.systems import GaussianExcitation, LinearSystem, double_integrator

CONF = Path(__file__).parent.parent / "conf"


def tolerance(dtype: Any = np.float64, size: int = 1, conditioning: float = 1.0) -> float:
    """How far two ways of computing the same number may lie apart, relative to its size.

    Args:
        dtype: of the arithmetic.
        size: number of operations behind an entry; their rounding is taken to add up fully.
        conditioning: by how much the problem itself magnifies relative errors of its data.
    """
    return float(10 * np.finfo(dtype).eps * size * conditioning)


def random_system(state_dim: int, input_dim: int, process_noise: float, seed: int) -> LinearSystem:
    """A stable random system: spectral radius 0.9."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((state_dim, state_dim))
    return LinearSystem(
        0.9 * A / np.abs(np.linalg.eigvals(A)).max(), rng.standard_normal((state_dim, input_dim)), process_noise
    )


SYSTEMS = {
    "paper": double_integrator(),
    "n=3,m=1": random_system(3, 1, 0.02, seed=1),
    "n=5,m=2": random_system(5, 2, 0.05, seed=2),
}


def fleet(robots: int = 3, process_noise: float = 0.02) -> LinearSystem:
    """Stable random robots with n = 3, m = 2 along a leading dimension."""
    members = [random_system(3, 2, process_noise, seed) for seed in range(robots)]
    return LinearSystem(np.stack([s.A for s in members]), np.stack([s.B for s in members]), process_noise)


def members(robots: LinearSystem) -> list[LinearSystem]:
    """A fleet's robots one by one."""
    return [LinearSystem(A, B, robots.process_noise) for A, B in zip(robots.A, robots.B, strict=True)]


def presets(group: str) -> list[str]:
    """The names of a group's presets, as found in conf/."""
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


def component(group: str, preset: str, **overrides: Any) -> Any:
    """The component of a preset that stands for itself: no interpolation, no defaults list."""
    node = yaml.safe_load((CONF / group / f"{preset}.yaml").read_text())
    return build({**node, **overrides}, group)


def variants(group: str, options: dict[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Every preset of a group, as it is and with each of the given values of the parameters that it has."""
    found = {}
    for preset in presets(group):
        node = yaml.safe_load((CONF / group / f"{preset}.yaml").read_text())
        found[preset] = component(group, preset)
        parameters = inspect.signature(resolve({TARGET: node[TARGET]}, group)).parameters
        for name, values in options.items():
            if name in parameters:
                changed = {f"{preset},{name}={value}": component(group, preset, **{name: value}) for value in values}
                found |= {key: value for key, value in changed.items() if value != found[preset]}
    return found


def trajectories(system: LinearSystem, horizon: int, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(tau, x_init) of noise-free roll-outs under random inputs: (*robots, count, d) and (*robots, count, n)."""
    rng = np.random.default_rng(seed)
    x_init = rng.standard_normal((*system.robots, count, system.state_dim))
    inputs = rng.standard_normal((*system.robots, count, horizon, system.input_dim))
    return system.layout(horizon).flatten(system.simulate(x_init, inputs), inputs), x_init


def exciting(length: int = 200, process_noise: float | None = 0.0, count: int = 1, seed: int = 0) -> GaussianExcitation:
    """A recording under white inputs; noise-free unless told otherwise."""
    return GaussianExcitation(length=length, process_noise=process_noise, count=count, seed=seed)

"""What the law suites run on: systems of several sizes, every component in conf/, and the one rule for tolerances."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir

from dadiff.config import build
from dadiff.config.build import resolve
from dadiff.config.composed import plain
from dadiff.launching import register
from dadiff.systems import (
    AffineSystem,
    Family,
    GaussianExcitation,
    Linear,
    MujocoFamily,
    System,
    TimeVarying,
    double_integrator,
)

CONF = Path(__file__).parent.parent / "conf"


def tolerance(dtype: Any = np.float64, size: int = 1, conditioning: float = 1.0) -> float:
    """How far two ways of computing the same number may lie apart, relative to its size.

    Args:
        dtype: of the arithmetic.
        size: number of operations behind an entry; their rounding is taken to add up fully.
        conditioning: by how much the problem itself magnifies relative errors of its data.
    """
    return float(10 * np.finfo(dtype).eps * size * conditioning)


def random_system(state_dim: int, input_dim: int, process_noise: float, seed: int) -> Linear:
    """A stable random system: spectral radius 0.9."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((state_dim, state_dim))
    return Linear(
        0.9 * A / np.abs(np.linalg.eigvals(A)).max(),
        rng.standard_normal((state_dim, input_dim)),
        process_noise=process_noise,
    )


SYSTEMS = {
    "paper": double_integrator(),
    "n=3,m=1": random_system(3, 1, 0.02, seed=1),
    "n=5,m=2": random_system(5, 2, 0.05, seed=2),
}


def varying_system(state_dim: int, input_dim: int, steps: int, seed: int, *robots: int) -> TimeVarying:
    """Random A_t, B_t and c_t, contracting."""
    rng = np.random.default_rng(seed)
    lead, n = (*robots, steps), state_dim
    A = 0.9 * np.linalg.qr(rng.standard_normal((*lead, n, n)))[0]
    B, c = rng.standard_normal((*lead, n, input_dim)), rng.standard_normal((*lead, n))
    return TimeVarying(A, B, c, process_noise=np.linspace(0.0, 0.05, n), robots=robots)


AFFINE = {
    **SYSTEMS,
    "with an offset": replace(SYSTEMS["n=3,m=1"], c=[0.3, -1.0, 0.5], process_noise=[0.1, 0.0, 0.02]),
    "time-varying": varying_system(3, 2, 12, seed=5),
}


def fleet(robots: int = 3, process_noise: float = 0.02) -> Linear:
    """Stable random robots with n = 3, m = 2 along a leading dimension."""
    members = [random_system(3, 2, process_noise, seed) for seed in range(robots)]
    return Linear(
        np.stack([s.A for s in members]), np.stack([s.B for s in members]), process_noise=process_noise, robots=robots
    )


def members(robots: AffineSystem) -> list[AffineSystem]:
    """A fleet's robots one by one."""
    return [
        type(robots)(A, B, c, process_noise=robots.process_noise)
        for A, B, c in zip(robots.A, robots.B, robots.c, strict=True)
    ]


def presets(group: str) -> list[str]:
    """The names of a group's presets, as found in conf/."""
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


def composed(*overrides: str, conf: Path = CONF) -> dict[str, Any]:
    """The real configuration with overrides, resolved, as a run gets it."""
    register()
    with initialize_config_dir(str(conf), version_base="1.3"):
        config = compose("config", overrides=list(overrides), return_hydra_config=True)
    return plain(config, config.hydra.runtime.choices)


def node(group: str, preset: str) -> dict[str, Any]:
    """A preset as written, over the presets of its own group that it starts from."""
    content = yaml.safe_load((CONF / group / f"{preset}.yaml").read_text())
    parents = [name for name in content.pop("defaults", []) if name != "_self_"]
    return {key: value for name in parents for key, value in node(group, name).items()} | content


def component(group: str, preset: str, **overrides: Any) -> Any:
    """The component of a preset that refers to no other group."""
    return build({**node(group, preset), **overrides}, group)


def variants(group: str, options: dict[str, tuple[Any, ...]]) -> dict[str, Any]:
    """Every preset of a group, and each with the given values of the parameters that it has; equal ones once."""
    found: dict[str, Any] = {}
    for preset in presets(group):
        parameters = inspect.signature(resolve(node(group, preset), group)).parameters
        changes = [{name: value} for name, values in options.items() if name in parameters for value in values]
        for change in ({}, *changes):
            made = component(group, preset, **change)
            if made not in found.values():
                found[",".join([preset, *(f"{name}={value}" for name, value in change.items())])] = made
    return found


OWN = {"A": [[0.9, 0.1], [-0.2, 0.8]], "B": [[0.0], [0.5]], "c": [0.1, -0.2], "bounds": {"input_high": 2}}
"""What `system=inline` leaves for the user to say."""


def shipped_system(preset: str) -> System:
    """The system of a preset; of a family three robots."""
    made = component("system", preset, **(OWN if preset == "inline" else {}))
    if isinstance(made, MujocoFamily):
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    return made.inside(3, np.random.default_rng(0)) if isinstance(made, Family) else made


def trajectories(system: Linear, horizon: int, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(tau, x_init) of noise-free roll-outs under random inputs: (*robots, count, d) and (*robots, count, n)."""
    rng = np.random.default_rng(seed)
    x_init = rng.standard_normal((*system.robots, count, system.state_dim))
    inputs = rng.standard_normal((*system.robots, count, horizon, system.input_dim))
    return system.layout(horizon).flatten(system.simulate(x_init, inputs), inputs), x_init


def exciting(length: int = 200, process_noise: float | None = 0.0, count: int = 1, seed: int = 0) -> GaussianExcitation:
    """A recording under white inputs; noise-free unless told otherwise."""
    return GaussianExcitation(length=length, process_noise=process_noise, count=count, seed=seed)

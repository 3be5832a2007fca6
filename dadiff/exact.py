"""How wrong a planner's plans are, computed without sampling.

Where the law of demonstrations is Gaussian, so is what a planner should draw from: p(tau | E, G tau = g). And where
sampler, denoiser, enforcement and set are affine, each step of the chain maps a Gaussian to a Gaussian, so that the law
of its plans is known, too. `exactness` holds one against the other:

    2-Wasserstein distance  W^2 = |m - m*|^2 + tr(S + S* - 2 (S*^1/2 S S*^1/2)^1/2)       (Givens & Shortt 1984)
    its mean part           |m - m*|
    spread                  tr S / tr S*

    from dadiff.exact import exactness
    exactness(planner, E)

A step is read off by applying it to a basis of its sample and of its noise, so nothing here knows any enforcement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from dadiff.denoisers.exact import ExactParts
from dadiff.diffusion.chain import predict
from dadiff.diffusion.context import Context, Counted, unprojected
from dadiff.diffusion.enforcement import Enforcement, Never
from dadiff.diffusion.samplers import Step
from dadiff.errors import NotApplicableError
from dadiff.planning import Planner
from dadiff.trajectory.covariance import Covariance

Tensor = torch.Tensor
Operator = Callable[[Tensor, Tensor, Callable[[], Tensor]], tuple[Tensor, Tensor]]
TOLERANCE = 1e-4  # relative; what a step may miss of being affine, where C is nearly singular


@dataclass(frozen=True)
class Gaussian:
    """N(mean, covariance) in the sampler's coordinates.

    Args:
        mean: (d,).
        covariance: (d, d).
    """

    mean: np.ndarray = field(repr=False)
    covariance: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Exactness:
    """A planner's law of plans against the one that is right, in the sampler's coordinates.

    Args:
        distance: 2-Wasserstein.
        mean_distance: |m - m*|.
        spread: tr S / tr S*; 1 is right, 0 a planner that always draws the same.
        network_calls: of one plan.
        exact: False where the plans' law was estimated from draws.
        plans: the law of the planner's plans.
        right: p(tau | E, G tau = g).
    """

    distance: float
    mean_distance: float
    spread: float
    network_calls: int
    plans: Gaussian = field(repr=False)
    right: Gaussian = field(repr=False)
    exact: bool = True


def exactness(planner: Planner, environment: np.ndarray, truth: Planner | None = None) -> Exactness:
    """How far the law of a planner's plans for one E is from the conditional law.

    Args:
        planner: with an exact denoiser, for one robot.
        environment: E, (*robots, 1, c).
        truth: the planner whose set is the true one, where the planner's own was estimated; with x(0) pinned or free
            alike.

    Raises:
        NotApplicableError: if the denoiser is trained, or a step of the chain is not affine.
    """
    right = conditional_law(truth or planner, environment)
    plans, calls = law_of_plans(planner, environment)
    mean = float(np.linalg.norm(plans.mean - right.mean))
    return Exactness(wasserstein(plans, right), mean, _spread(plans, right), calls, plans, right)


def sampled_exactness(
    planner: Planner, environment: np.ndarray, truth: Planner | None = None, draws: int = 2000, seed: int = 0
) -> Exactness:
    """As `exactness`, with the Gaussian of the moments of draws as the plans' law: for chains that are not affine.

    Few draws look far from any law, the one that they are from included. What that adds to the squares of both
    distances is taken off: the distance of as many draws of the estimated Gaussian from it, and tr S / draws.

    Raises:
        NotApplicableError: if the chain diverges.
    """
    drawn = planner.plan(environment, samples=draws, seed=seed)
    if drawn.diverged_at is not None:
        raise NotApplicableError(f"exact: the chain diverges at step {drawn.diverged_at}, so its plans have no law")
    plans = _moments(planner.coordinates.to_scaled(drawn.tau.reshape(draws, -1)))
    right = conditional_law(truth or planner, environment)
    again = np.random.default_rng(seed).standard_normal((draws, len(plans.mean))) @ _root(plans.covariance) + plans.mean
    distance = wasserstein(plans, right) ** 2 - wasserstein(_moments(again), plans) ** 2
    mean = float(np.square(plans.mean - right.mean).sum() - np.trace(plans.covariance) / draws)
    distance, mean = (float(np.sqrt(max(square, 0.0))) for square in (distance, mean))
    return Exactness(distance, mean, _spread(plans, right), drawn.network_calls, plans, right, exact=False)


def _moments(z: np.ndarray) -> Gaussian:
    """Of rows (N, d)."""
    return Gaussian(z.mean(axis=0), np.cov(z.T))


def _spread(plans: Gaussian, right: Gaussian) -> float:
    return float(np.trace(plans.covariance) / np.trace(right.covariance))


def wasserstein(a: Gaussian, b: Gaussian) -> float:
    """The 2-Wasserstein distance of two Gaussians."""
    root = _root(b.covariance)
    cross = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ a.covariance @ root), 0)).sum()
    apart = np.trace(a.covariance) + np.trace(b.covariance) - 2 * cross
    return float(np.sqrt(np.square(a.mean - b.mean).sum() + max(apart, 0.0)))


def conditional_law(planner: Planner, environment: np.ndarray) -> Gaussian:
    """p(tau | E, G tau = g) of the denoiser's Gaussian law and the planner's set; without a set, the law itself.

    Args:
        environment: E, (*robots, 1, c).
    """
    prior = _prior(planner, environment)
    if planner.behaviour is None:
        return prior
    root, d, robots = _root(prior.covariance), len(prior.mean), planner.system.robots
    E = np.broadcast_to(environment, (*robots, d + 1, environment.shape[-1]))
    project, metric = planner.projection(E), Covariance(np.zeros(d), root)
    rows = prior.mean + np.concatenate([np.zeros((1, d)), root])  # within the law's support, where the metric is one
    image = project(rows.reshape(*robots, d + 1, d), metric).reshape(d + 1, d)  # type: ignore[misc]
    moved = image[1:] - image[0]
    return Gaussian(image[0], moved.T @ moved)


def law_of_plans(planner: Planner, environment: np.ndarray) -> tuple[Gaussian, int]:
    """The law of a planner's plans for one E (*robots, 1, c), and how often it asks its denoiser.

    Raises:
        NotApplicableError: if a step of the chain is not affine.
    """
    d = planner.layout.size
    mean, covariance = np.zeros(2 * d), np.zeros((2 * d, 2 * d))  # of tau, and of the last clean estimate
    covariance[:d, :d] = np.eye(d)
    calls = 0
    for operator, asked in _operators(planner, environment):
        A, b, N = _affine(operator, d)
        mean, covariance = A @ mean + b, A @ covariance @ A.T + N @ N.T
        calls += asked
    return Gaussian(mean[:d], covariance[:d, :d]), calls


def _prior(planner: Planner, environment: np.ndarray) -> Gaussian:
    """The law that the exact denoiser is made from, given E, in the sampler's coordinates."""
    parts = planner.denoiser.made_from
    if not isinstance(parts, ExactParts):
        raise NotApplicableError("exact: the denoiser is trained, and its law not known; use denoiser=gaussian")
    law, where = parts.law, planner.coordinates
    mean = where.to_scaled(law.mean(environment)).reshape(-1)
    noise_map = law.noise_map.reshape(-1, law.noise_map.shape[-1]) / where.scale[:, None]
    return Gaussian(mean, noise_map @ noise_map.T)


def _operators(planner: Planner, environment: np.ndarray) -> Iterator[tuple[Operator, int]]:
    """The steps of a chain, and its end, as maps (tau, last estimate, noise) -> (tau, estimate) of rows (B, d)."""
    enforced = planner.behaviour is not None and planner.enforcement is not None
    by: Enforcement = planner.enforcement if enforced and planner.enforcement else Never()
    steps = [by.weights(step, planner.schedule) for step in planner.sampler.steps(planner.schedule)]
    for step in steps:
        yield _step(planner, environment, by, step), int(step.call)
    yield _step(planner, environment, by, steps[-1], end=True), 0


def _step(planner: Planner, environment: np.ndarray, by: Enforcement, step: Step, *, end: bool = False) -> Operator:
    def operator(tau: Tensor, before: Tensor, noise: Callable[[], Tensor]) -> tuple[Tensor, Tensor]:
        """Of rows (B, d) each; a draw of noise is asked for as often as the step takes one."""
        shape = (*planner.system.robots, *tau.shape)
        E = np.broadcast_to(environment, (*shape[:-1], environment.shape[-1]))
        at = Context(
            step, planner.schedule, tau.reshape(shape), torch.as_tensor(E.copy()), planner.projection(E) or unprojected,
            Counted(planner.denoiser), lambda: noise().reshape(shape), planner.estimate, dict[str, Any](),
        )  # fmt: skip
        if end:
            return by.end(at.tau, at).reshape(tau.shape), before
        predicted, tau0_hat = predict(at, by, before.reshape(shape))
        return by.sample(predicted, at).reshape(tau.shape), tau0_hat.reshape(tau.shape)

    return operator


def _affine(operator: Operator, d: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (2d, 2d), b (2d,) and N (2d, k d) of z -> A z + b + N eps, z = [tau; last estimate], eps of k draws.

    Raises:
        NotApplicableError: if the map is none, tried at a random point.
    """
    draws = _count(operator, d)
    basis = torch.cat([torch.zeros(1, (2 + draws) * d), torch.eye((2 + draws) * d)]).double()
    generator = torch.Generator().manual_seed(0)
    point = torch.randn(1, (2 + draws) * d, generator=generator, dtype=torch.float64)
    out = _apply(operator, torch.cat([basis, point]), d)
    b, linear, found = out[0], (out[1:-1] - out[0]).T, out[-1]
    missed = np.abs(linear @ point[0].numpy() + b - found).max()
    if not missed <= TOLERANCE * max(1.0, float(np.abs(found).max())):
        raise NotApplicableError(
            "exact: a step of the chain is not affine, so its law has no closed form; judge this enforcement by samples"
        )
    return linear[:, : 2 * d], b, linear[:, 2 * d :]


def _apply(operator: Operator, rows: Tensor, d: int) -> np.ndarray:
    """The map on rows [tau; last estimate; draws] (B, (2 + k) d): (B, 2d)."""
    tau, before, *noises = rows.split(d, dim=-1)
    draws = iter(noises)
    with torch.inference_mode():
        return torch.cat(operator(tau, before, lambda: next(draws)), dim=-1).numpy()


def _count(operator: Operator, d: int) -> int:
    """How many draws of noise a step takes."""
    taken = []

    def noise() -> Tensor:
        taken.append(1)
        return torch.zeros(1, d, dtype=torch.float64)

    zero = torch.zeros(1, d, dtype=torch.float64)
    with torch.inference_mode():
        operator(zero, zero, noise)
    return len(taken)


def _root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T

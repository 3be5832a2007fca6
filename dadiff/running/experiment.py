"""One run, from configuration to stored result: the place where all rooms meet.

Samples plans for every test case, evaluates them, and stores the result whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import pandas as pd
import torch
import yaml

from dadiff.behaviours import Known, Nominal, Projection, compared, model_of, pins, prediction_error
from dadiff.diffusion.chain import Samples
from dadiff.diffusion.context import Limiting
from dadiff.diffusion.enforcement import PostHoc
from dadiff.errors import NotApplicableError
from dadiff.evaluation import ClosedLoop, Exact, planned_errors, replay, spread, tracking_errors, violations
from dadiff.evaluation.closed_loop import TIMED_PLANS, Bench, latencies, means
from dadiff.evaluation.likeness import likeness
from dadiff.evaluation.mahalanobis import distance_to
from dadiff.evaluation.records import ChainRecorder, Snapshots, headline, merged, tables
from dadiff.exact import Exactness, exactness, sampled_exactness
from dadiff.outside import passwords_removed
from dadiff.planning import Planner
from dadiff.planning.files import in_folder
from dadiff.randomness import numpy_generator, torch_generator
from dadiff.running.assembly import Experiment
from dadiff.running.provenance import record_of
from dadiff.store import StoredRun
from dadiff.systems import Robots, System, TimeVarying, Unknown
from dadiff.tasks import Scores
from dadiff.tasks.task import Repeatable, Steering
from dadiff.trajectory import TrajectoryLayout

EXAMPLE_ROBOTS = 3
EXACT_SCORES = ("exact_distance", "exact_mean_distance", "exact_spread")


Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass
class Timed(Generic[Function]):
    """A function that counts its calls and the seconds they take, on an accelerator too."""

    function: Function
    device: str = "cpu"
    calls: int = 0
    seconds: float = 0.0

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call it."""
        return self.timed(self.function, *arguments, **options)

    def timed(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call another function on the same account."""
        self._wait()
        start = time.perf_counter()
        result = function(*arguments, **options)
        self._wait()
        self.seconds += time.perf_counter() - start
        self.calls += 1
        return result

    def _wait(self) -> None:
        if self.device != "cpu":
            torch.cuda.synchronize(self.device)


class TimedWithinLimits(Timed[Limiting]):
    """A projection that keeps to limits, and is asked without them, too."""

    @property
    def unlimited(self) -> Callable[..., Any]:
        """See `dadiff.diffusion.context.Limiting`."""
        return partial(self.timed, self.function.unlimited)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """See `dadiff.diffusion.context.Limiting`."""
        return self.function.box


@dataclass
class Plans:
    """What sampling gave, in physical units, and what it took."""

    planned: np.ndarray
    samples: Samples
    measures: dict[str, float]
    chain: ChainRecorder | None
    snapshots: Snapshots


def execute(experiment: Experiment) -> StoredRun:
    """Run an experiment, or return its stored result.

    Raises:
        DadiffError: if the configuration, the data or the store do not allow it.
    """
    results, key = experiment.results, experiment.identity.key
    with results.working(key):
        if experiment.is_done:
            return results.read(key)
        started = time.time()
        plans = draw_plans(experiment)
        return _store(experiment, plans, started)


def draw_plans(experiment: Experiment) -> Plans:
    """Sample plans for every case, with the same noise whatever the projector."""
    evaluation, cases = experiment.parts.evaluation, experiment.cases
    environment = np.repeat(cases.environment, evaluation.samples, axis=-2)
    project, measures = measured_projection(experiment, environment)
    chain, snapshots = _observers(experiment, environment)
    watch = Timed(lambda *seen: [observe(*seen) for observe in (chain, snapshots) if observe])
    planner, generator = experiment.planner, torch_generator(evaluation.seed, "sampling noise")
    start = time.perf_counter()
    samples = planner.draw(environment, generator, project, watch, progress=experiment.parts.settings.progress)
    elapsed = time.perf_counter() - start - watch.seconds
    measures |= {"sampling_seconds": elapsed, "network_calls": samples.network_calls}
    if project and project.calls:
        measures |= {"projection_seconds": project.seconds / project.calls, "projection_calls": project.calls}
        measures |= unconverged(project.function)
    tau = samples.tau.cpu().numpy().reshape(*cases.environment.shape[:-1], evaluation.samples, -1)
    return Plans(experiment.coordinates.to_physical(tau), samples, measures, chain, snapshots)


def measured_projection(experiment: Experiment, environment: np.ndarray) -> tuple[Timed[Any] | None, dict[str, float]]:
    """The projection bound to coordinates and conditions E (*robots, plans, c), and what is measured of its set."""
    start = time.perf_counter()
    behaviour = experiment.behaviour
    fitted = time.perf_counter() - start
    bind = Timed(experiment.planner.projection)  # once the denoiser is there, which may have to be trained
    projection = bind(environment)
    if behaviour is None or projection is None:
        return None, {}
    measures = {"projector_setup_seconds": fitted + bind.seconds, **behaviour.notes}
    if "recording" in experiment.sources:
        measures |= experiment.sources["recording"].notes
    known = not isinstance(experiment.target, Unknown)
    if known and (experiment.sources or isinstance(experiment.parts.projector, Nominal)):
        held = pins(experiment.parts.projector, experiment.layout, experiment.condition.get(environment, "x_init"))
        measures |= compared(behaviour, Known().fit(experiment.layout, experiment.target), held)
        measures |= prediction_error(behaviour, experiment.target, experiment.cases.reference)
        measures |= cost_of_model(experiment, model_of(behaviour))
    if isinstance(projection, Limiting):
        return TimedWithinLimits(projection, experiment.device), measures
    return Timed(projection, experiment.device), measures


def cost_of_model(experiment: Experiment, model: System | None) -> dict[str, float]:
    """`model_cost_ratio`: what the expert's plans for a model cost on the robot: what its errors cost, whoever plans.

    Nothing where there is no model, or no expert that takes one.
    """
    task, target, cases = experiment.parts.task, experiment.target, experiment.cases
    if model is None or isinstance(model, TimeVarying) or not isinstance(task, Steering):
        return {}
    planned = task.solve(target, cases.environment, model)[..., None, :]
    rollout = replay(target, experiment.layout, planned, cases.x_init)
    ratio = task.score(target, cases, planned, rollout).per_plan["cost_ratio"].mean(axis=(-2, -1))
    return {"model_cost_ratio": float(ratio.mean()), "model_cost_ratio_median": float(np.median(ratio))}


def unconverged(projection: Projection) -> dict[str, float]:
    """How many plans the last projection did not bring into the set, and for how many the set is proven to be empty.

    Nothing of closed forms, which always do.
    """
    info = projection.info
    if info.kind in ("dense", "blocks"):
        return {}
    found: dict[str, float] = {"unconverged": info.unconverged}
    return found | ({"infeasible": info.infeasible} if info.kind == "limited" else {})


def _observers(experiment: Experiment, environment: np.ndarray) -> tuple[ChainRecorder | None, Snapshots]:
    """The recorder of Theorem 1, if it is wanted, for one system of a known law; and snapshots of the first plan."""
    parts = experiment.parts
    snapshots = Snapshots(parts.schedule.alpha_bar, (0,) * (environment.ndim - 1))
    if parts.denoiser.trainable or environment.ndim > 2 or not parts.evaluation.theorem1:
        return None, snapshots
    followed = np.arange(0, len(environment), parts.evaluation.samples)
    distance = distance_to(experiment.law, environment[followed])
    return ChainRecorder(distance, followed, experiment.coordinates.to_physical), snapshots


def _store(experiment: Experiment, plans: Plans, started: float) -> StoredRun:
    """Evaluate and write. Of a diverged chain nothing but where it diverged, and how its distance went."""
    diverged_at = plans.samples.diverged_at
    written = {"chain": plans.chain.table()} if plans.chain else {}
    metrics, arrays = dict(plans.measures), {}
    if diverged_at is None:
        scores = evaluate(experiment, plans.planned)
        written |= tables(scores)
        metrics = headline(scores) | metrics | experiment.told_of_data | latency(experiment)
        if isinstance(experiment.parts.evaluation, ClosedLoop):
            shown = experiment.demonstrations if "cloned" in experiment.parts.evaluation.controllers else None
            episodes = Bench(experiment.planner, experiment.cases, experiment.parts.evaluation, shown).table()
            written["closed_loop"] = episodes
            metrics |= means(episodes)
        if isinstance(experiment.parts.evaluation, Exact):
            written["exact"] = exact_table(experiment, experiment.parts.evaluation)
            metrics |= {name: float(written["exact"][name].mean()) for name in EXACT_SCORES}
        arrays = examples(experiment, plans)
    record = record_of(
        experiment.identity,
        experiment.config,
        "finished" if diverged_at is None else "diverged",
        started,
        experiment.device,
        reason=None if diverged_at is None else f"a value exceeded the bound at step {diverged_at}",
        diverged_step=diverged_at,
        metrics=metrics,
        notes={"cases": experiment.cases.notes, "schedule": experiment.parts.schedule.conditions()},
        counts=_counts(experiment),
    )
    files = {"config.yaml": yaml.safe_dump(passwords_removed(experiment.config), sort_keys=False).encode()}
    trained = experiment.identity.denoiser
    files |= in_folder(experiment.planner, trained.key if trained else None)
    return experiment.results.write(record, files=files, tables=written, arrays=arrays)


def evaluate(experiment: Experiment, planned: np.ndarray) -> Scores:
    """What can be said of plans (*robots, cases, samples, d): errors along time, and the task's own scores."""
    system, layout, cases = experiment.target, experiment.layout, experiment.cases
    if isinstance(system, Unknown):  # what becomes of plans is not known: only what they are is scored
        told = planned_errors(layout, cases, planned), spread(planned), violations(system, layout, planned)
        return merged(*told)
    rollout = replay(system, layout, planned, cases.x_init)
    return merged(
        tracking_errors(system, layout, cases, planned, rollout),
        spread(planned, experiment.covariance_trace),
        experts_likeness(experiment, planned),
        violations(system, layout, planned, rollout),
        experiment.parts.task.score(system, cases, planned, rollout),
    )


def experts_likeness(experiment: Experiment, planned: np.ndarray) -> Scores:
    """Plans against fresh runs of the expert, where the law of these is known: it knows no bounds."""
    task, system = experiment.parts.task, experiment.target
    if not isinstance(task, Repeatable) or system.bounds.any:
        return Scores()
    law, told = task.of_runs(system, experiment.cases.environment)
    rng = numpy_generator(experiment.parts.evaluation.seed, "fresh runs of the expert")
    return likeness(experiment.layout, planned, law, told, rng)


def latency(experiment: Experiment) -> dict[str, float]:
    """Seconds that one plan for one robot takes: the median, and, of a hundred, that of all but one.

    In closed loop also the share of plans later than the robot asks for; elsewhere a tenth of the time is spent on it.
    """
    first, evaluation = experiment.cases.environment[..., :1, :], experiment.parts.evaluation
    planner = experiment.planner_of(0)  # of a fleet that of its first robot; of one system, all there is
    seconds = latencies(planner, first[:1], share=1.0 if isinstance(evaluation, ClosedLoop) else 0.1)
    measures = {"plan_latency": float(np.median(seconds))}
    if len(seconds) == TIMED_PLANS:
        measures["plan_latency_p99"] = float(np.quantile(seconds, 0.99))
    if isinstance(evaluation, ClosedLoop):
        measures["deadlines_missed"] = float((seconds > 1 / evaluation.rate).mean())
    return measures


def exact_table(experiment: Experiment, evaluation: Exact) -> pd.DataFrame:
    """For a few robots that differ most, how far the law of their plans for one case is from the right one.

    See `dadiff.exact`. The right one knows the dynamics, whatever the method knows.
    """
    target, rows = experiment.target, []
    chosen = target.most_different(evaluation.robots) if isinstance(target, Robots) else [0]
    for robot in map(int, chosen):
        planner = experiment.planner_of(robot)
        environment = experiment.cases.environment[..., :1, :]
        environment = environment[robot : robot + 1] if target.robots else environment
        known = Known("fixed").fit(experiment.layout, planner.system)
        truth = replace(planner, behaviour=known, enforcement=PostHoc(), starts_fixed=True)
        found = exactness_of(planner, environment, truth, evaluation)
        scores = {name: getattr(found, name) for name in ("distance", "mean_distance", "spread")}
        rows.append({"robot": robot, **dict(zip(EXACT_SCORES, scores.values(), strict=True)), "exact": found.exact})
    return pd.DataFrame(rows)


def exactness_of(planner: Planner, environment: np.ndarray, truth: Planner, evaluation: Exact) -> Exactness:
    """In closed form where every step is affine, else from draws."""
    try:
        return exactness(planner, environment, truth)
    except NotApplicableError:
        return sampled_exactness(planner, environment, truth, evaluation.draws, evaluation.seed)


def examples(experiment: Experiment, plans: Plans) -> dict[str, np.ndarray]:
    """The first cases' plans, for figures, and one plan along the chain beside its noised reference.

    states and rollout_states (cases, samples, T+1, n), inputs (cases, samples, T, m), reference_states (cases, T+1, n),
    reference_inputs (cases, T, m), and environment_* (cases, ...), the channels of E. Of a fleet all these have a
    first dimension of a few robots that differ most, `robots` (k,) says which ones, and their first case is the same.
    Names and units of states and inputs lie beside them, see `_named`; where the robot has a shape, `outlines`
    (cases, samples, T+1, k, 2) shows it as it replays its plans.
    """
    layout, cases, count = experiment.layout, experiment.cases, experiment.parts.evaluation.examples
    system, shown = _shown(experiment.target)
    planned = plans.planned[shown][..., :count, :, :]
    reference, environment = (values[shown][..., :count, :] for values in (cases.reference, cases.environment))
    E = cases.condition.unpack(environment)
    steps, chain = plans.snapshots.stacked()
    states, inputs = layout.split(planned)
    reference_states, reference_inputs = layout.split(reference)
    noised = _noised(experiment, cases.reference[(*plans.snapshots.plan[:-1], 0)], steps)
    rollout = _replayed(system, layout, planned, E["x_init"])
    return {
        "states": states,
        "inputs": inputs,
        "rollout_states": rollout,
        **_outlines(system, rollout),
        "reference_states": reference_states,
        "reference_inputs": reference_inputs,
        **{f"environment_{name}": values for name, values in E.items()},
        "chain_steps": steps,
        "chain_states": layout.states(experiment.coordinates.to_physical(chain)),
        "noised_states": layout.states(noised),
        **({} if shown is Ellipsis else {"robots": shown}),
        **_named(layout),
    }


def _outlines(system: System, rollout: np.ndarray) -> dict[str, np.ndarray]:
    """`outlines` of the robot along rollout_states (..., T+1, n), if it is more than a point where the states say."""
    found = system.outline(rollout)
    return {"outlines": found} if found.shape[-2] > 1 and not system.plane else {}


def _replayed(system: System, layout: TrajectoryLayout, planned: np.ndarray, x_init: np.ndarray) -> np.ndarray:
    """States after replay; nan where the system is unknown."""
    if isinstance(system, Unknown):
        return np.full_like(layout.states(planned), np.nan)
    return layout.states(replay(system, layout, planned, x_init))


def _named(layout: TrajectoryLayout) -> dict[str, np.ndarray]:
    """state_names, state_units (n,), input_names, input_units (m,), as far as the system has them."""
    x, u = layout.channel("x"), layout.channel("u")
    found = {"state_names": x.labels, "state_units": x.units, "input_names": u.labels, "input_units": u.units}
    return {name: np.array(values) for name, values in found.items() if values}


def _shown(target: System) -> tuple[System, Any]:
    """The robots whose plans are stored, as a system and as an index; everything where there is one system."""
    if not isinstance(target, Robots):
        return target, Ellipsis
    shown = target.most_different(EXAMPLE_ROBOTS)
    return target.take(shown), shown


def _noised(experiment: Experiment, reference: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """The forward process applied to a reference (d,): sqrt(alpha_bar_i) z + sqrt(1 - alpha_bar_i) eps, (k, d)."""
    alpha_bar = experiment.parts.schedule.alpha_bar[steps][:, None]
    eps = numpy_generator(experiment.parts.evaluation.seed, "forward noise").standard_normal(reference.shape)
    z = experiment.coordinates.to_scaled(reference)
    return experiment.coordinates.to_physical(np.sqrt(alpha_bar) * z + np.sqrt(1 - alpha_bar) * eps)


def _counts(experiment: Experiment) -> dict[str, int]:
    *robots, num_cases, _ = experiment.cases.environment.shape
    counts = {"cases": num_cases, "samples": experiment.parts.evaluation.samples}
    return counts | ({"robots": robots[0]} if robots else {})

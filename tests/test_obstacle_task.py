"""The obstacle task: what it draws, how it encodes it, what it scores, and the printed cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dadiff.errors import ConfigError, InfeasibleError, ShapeError
from dadiff.experts.obstacles import literal
from dadiff.experts.obstacles.problem import ObstacleProblem
from dadiff.systems import double_integrator
from dadiff.tasks.environments import Environments, decode, encode
from dadiff.tasks.obstacle_scores import choice, collision_scores, side_scores, success_scores, waypoint_scores
from dadiff.tasks.obstacles import Obstacles
from dadiff.tasks.task import Cases

SYSTEM = double_integrator(process_noise=0.0)


@pytest.fixture(scope="module")
def cases() -> Cases:
    return Obstacles().cases(SYSTEM, 200, np.random.default_rng(0))


def test_the_default_distribution_is_not_trivial(cases: Cases) -> None:
    assert 0.45 < cases.notes["obstacle_free_collides_share"] < 0.7
    assert cases.notes["active_obstacles_mean"] > 0.4
    assert cases.notes["unsolved"] == 0
    assert {"environments_redrawn", "centres_redrawn_mean"} <= cases.notes.keys()


@pytest.mark.parametrize("distribution", ["default", "uniform", "hard"])
def test_drawn_environments_leave_room_and_lie_in_range(distribution: str) -> None:
    task = Obstacles(distribution=distribution)  # type: ignore[arg-type]
    e, _ = task.distribution_for(0.1).sample(100, np.random.default_rng(1))
    fewest = 4 if distribution == "hard" else 1
    assert set(e.present.sum(axis=1)) == set(range(fewest, 5))
    assert np.abs(e.x_init).max() <= 1
    assert np.abs(e.target).max() <= 4
    assert ((e.radius >= 0.4) & (e.radius <= 0.8))[e.present].all()
    assert np.ptp(e.radius[e.present]) > 0.35
    assert (e.radius[~e.present] == 0).all()
    points = np.stack([e.x_init[:, :2], e.x_init[:, :2] + 0.1 * e.x_init[:, 2:], e.target, *e.waypoint.swapaxes(0, 1)])
    gap = np.linalg.norm(points[:, :, None] - e.centre, axis=-1) - e.radius
    assert gap[:, e.present].min() >= 0.2
    between = (
        np.linalg.norm(e.centre[:, :, None] - e.centre[:, None], axis=-1) - e.radius[:, :, None] - e.radius[:, None]
    )
    pairs = e.present[:, :, None] & e.present[:, None] & ~np.eye(4, dtype=bool)
    assert between[pairs].min() >= 0.3


def test_the_late_waypoint_lies_in_the_annulus_and_the_early_one_on_the_drift() -> None:
    e, _ = Obstacles().distribution_for(0.1).sample(300, np.random.default_rng(2))
    np.testing.assert_array_equal(e.time, np.tile([5.0, 33.0], (300, 1)))
    distance = np.linalg.norm(e.waypoint[:, 1] - e.target, axis=1)
    assert distance.min() >= 0.5
    assert distance.max() <= 2
    assert np.abs(e.waypoint[:, 0] - e.x_init[:, :2] - 0.5 * e.x_init[:, 2:]).max() <= 0.75


def test_a_waypoint_due_half_way_is_a_late_one() -> None:
    e, _ = (
        Obstacles(horizon=20, waypoint_times=[10], max_waypoints=1)
        .distribution_for(0.1)
        .sample(100, np.random.default_rng(2))
    )
    distance = np.linalg.norm(e.waypoint[:, 0] - e.target, axis=1)
    assert (distance.min() >= 0.5) & (distance.max() <= 2)


@pytest.mark.parametrize("late", [20, 33])
def test_discs_on_the_way_lie_beside_it_between_two_steps_after_the_early_and_before_the_late_waypoint(late) -> None:
    given = replace(Obstacles().distribution_for(0.1), near=1.0, times=(5, late))
    path = np.random.default_rng(0).standard_normal((2000, 41, 2)).cumsum(axis=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dadiff.tasks.obstacle_distribution._ASIDE", 0.0)
        centre = given._centres(path, np.random.default_rng(1))
    distance = np.linalg.norm(path - centre[:, None], axis=-1)
    assert distance.min(axis=1).max() == 0
    assert set(distance.argmin(axis=1)) == set(range(5 + 2, late - 2 + 1))
    aside = given._centres(path, np.random.default_rng(1)) - centre
    along = np.stack([path[k, t + 1] - path[k, t - 1] for k, t in enumerate(distance.argmin(axis=1))])
    np.testing.assert_allclose((aside * along).sum(axis=1), 0, atol=1e-12)
    assert np.linalg.norm(aside, axis=1).std() == pytest.approx(0.35 * np.sqrt(1 - 2 / np.pi), rel=0.1)


def test_what_is_not_redrawn_is_not_counted() -> None:
    _, notes = Obstacles(max_obstacles=0).distribution_for(0.1).sample(50, np.random.default_rng(0))
    assert notes == {"environments_redrawn": 0, "centres_redrawn_mean": 0}
    easy, hard = (
        Obstacles(distribution=name)
        .distribution_for(0.1)
        .sample(50, np.random.default_rng(0))[1]["centres_redrawn_mean"]
        for name in ("default", "hard")
    )
    assert hard > 2 * easy > 0


@pytest.mark.parametrize(
    "settings",
    [
        {"horizon": 12, "waypoint_times": [4, 9]},
        {"waypoint_times": [], "max_waypoints": 0},
        {"waypoint_times": [10], "max_waypoints": 3},
        {"waypoint_times": [8, 20, 30], "max_waypoints": 3, "max_obstacles": 2},
        {"max_obstacles": 0},
    ],
)
def test_sizes_are_settable(settings: dict) -> None:
    task = Obstacles(**settings)
    found = task.demonstrations(SYSTEM, 5, np.random.default_rng(0))
    assert found.environment.shape == (5, task.condition(SYSTEM).size)
    assert found.trajectories.shape == (5, SYSTEM.layout(task.horizon).size)
    assert found.notes["unsolved"] == 0


def test_other_time_steps_are_planned_for() -> None:
    system = double_integrator(time_step=0.2, process_noise=0.0)
    task = Obstacles(horizon=20, waypoint_times=[3, 16])
    cases = task.cases(system, 10, np.random.default_rng(0))
    plans = cases.reference[:, None]
    assert task.score(system, cases, plans, plans).per_plan["collision_at_samples_planned"].max() == 0


def test_the_condition_holds_the_whole_environment() -> None:
    task = Obstacles(waypoint_times=[5], max_waypoints=2)
    e, _ = task.distribution_for(0.1).sample(50, np.random.default_rng(3))
    E = encode(e, task.horizon)
    assert E.shape == (50, 30)
    back = decode(E, task.condition(), task.horizon)
    for name in ("x_init", "target", "time", "due", "radius", "present"):
        np.testing.assert_array_equal(getattr(back, name), getattr(e, name))
    np.testing.assert_array_equal(back.centre[e.present], e.centre[e.present])
    assert (E[:, 10:14] == 0).all()  # the waypoint slot that is not used
    absent = E[:, 14:].reshape(50, 4, 4)[~e.present]
    assert (absent == 0).all()


def test_augmenting_shuffles_obstacles_and_nothing_else(cases: Cases) -> None:
    E = torch.from_numpy(cases.environment)
    shuffled = Obstacles().augment(E, torch.Generator().manual_seed(0))
    assert torch.equal(shuffled[:, :14], E[:, :14])
    before, after = E[:, 14:].reshape(-1, 4, 4), shuffled[:, 14:].reshape(-1, 4, 4)
    moved = (before != after).flatten(1).any(dim=1)
    assert moved.double().mean() > 0.5
    for row in range(len(E)):
        assert sorted(map(tuple, before[row].tolist())) == sorted(map(tuple, after[row].tolist()))
    again = Obstacles().augment(E, torch.Generator().manual_seed(0))
    assert torch.equal(shuffled, again)


def test_solving_given_environments_gives_their_references(cases: Cases) -> None:
    again = Obstacles().solve(SYSTEM, cases.environment[:20])
    np.testing.assert_allclose(again.reference, cases.reference[:20], atol=1e-5)
    np.testing.assert_array_equal(again.x_init, cases.x_init[:20])


def test_more_obstacles_than_a_model_has_slots_for_are_refused(cases: Cases) -> None:
    with pytest.raises(ShapeError, match="max_obstacles = 3 make 26"):
        Obstacles(max_obstacles=3).solve(SYSTEM, cases.environment)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 1}, "horizon is 1"),
        ({"margin": -0.1}, "margin is -0.1"),
        ({"input_cost": 0.0}, "input_cost is 0.0"),
        ({"waypoint_tolerance": 0.0}, "waypoint_tolerance is 0.0"),
        ({"box": 0.3}, "box is 0.3"),
        ({"waypoint_times": [33, 5]}, "waypoint_times are"),
        ({"waypoint_times": [5, 40]}, "waypoint_times are"),
        ({"waypoint_times": [0, 5]}, "waypoint_times are"),
        ({"waypoint_times": [5, 9, 33]}, "max_waypoints is 2"),
        ({"radius_range": [0.8, 0.4]}, "radius_range is"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Obstacles(**settings)


def test_discs_that_cannot_fit_are_said() -> None:
    task = Obstacles(radius_range=[6.0, 6.5], max_obstacles=2, distribution="hard")
    with pytest.raises(InfeasibleError, match="lower max_obstacles or radius_range"):
        task.cases(SYSTEM, 1, np.random.default_rng(0))


# --- scores ---------------------------------------------------------------------------------------------------------


def one_disc(present: bool = True) -> Environments:
    """A disc of radius 0.5 at (1, 0), a waypoint at (1, 1) due at t = 1, the target at (2, 0)."""
    radius = np.array([[0.5 * present]])
    return Environments(
        x_init=np.zeros((1, 4)),
        target=np.array([[2.0, 0.0]]),
        waypoint=np.array([[[1.0, 1.0]]]),
        time=np.array([[1.0]]),
        due=np.array([[True]]),
        centre=np.array([[[1.0, 0.0]]]) * present,
        radius=radius,
        present=np.array([[present]]),
    )


THROUGH = [[0.0, 0], [2, 0], [2, 0]]  # jumps across the disc between two samples
INSIDE = [[0.0, 0], [1, 0.2], [2, 0]]
ABOVE, BELOW = [[0.0, 0], [1, 1], [2, 0]], [[0.0, 0], [1, -1], [2, 0]]


def paths(*positions: list) -> np.ndarray:
    return np.array(positions)[None]


def test_collisions_at_and_between_samples_are_told_apart() -> None:
    scores, inside = collision_scores(one_disc(), paths(THROUGH, INSIDE, ABOVE))
    np.testing.assert_array_equal(scores["collision"], [[1, 1, 0]])
    np.testing.assert_array_equal(scores["collision_at_samples"], [[0, 1, 0]])
    np.testing.assert_array_equal(inside, [[[0, 0, 0], [0, 1, 0], [0, 0, 0]]])
    above = np.sqrt(0.5) - 0.5  # from (1, 0) to the line from (0, 0) to (1, 1)
    np.testing.assert_allclose(scores["clearance"][0, [0, 2]], [-0.5, above])
    np.testing.assert_allclose(scores["depth"][0, [0, 2]], [0.5, 0])


def test_without_a_disc_nothing_collides_and_clearance_is_undefined() -> None:
    scores, _ = collision_scores(one_disc(present=False), paths(THROUGH))
    assert scores["collision"] == scores["depth"] == 0
    assert np.isnan(scores["clearance"]).all()
    sides = side_scores(one_disc(present=False), paths(THROUGH), np.array([ABOVE]))
    assert np.isnan(sides["side_agreement"]).all()


def test_waypoints_are_measured_at_their_time() -> None:
    scores = waypoint_scores(one_disc(), paths(ABOVE, BELOW))
    np.testing.assert_allclose(scores["waypoint_distance_1"], [[0, 2]])
    np.testing.assert_allclose(scores["waypoint_distance_target"], [[0, 0]])


def test_sides_are_told_by_how_the_path_turns_about_the_disc() -> None:
    scores = side_scores(one_disc(), paths(ABOVE, BELOW), np.array([ABOVE]))
    np.testing.assert_array_equal(scores["side_agreement"], [[1, 0]])
    np.testing.assert_array_equal(scores["left_share"], [[0, 1]])
    away = [[1.6, 0.0], [2, 0], [3, 0]]  # straight away from the centre: it turns about it by no angle
    np.testing.assert_array_equal(side_scores(one_disc(), paths(away), np.array([away]))["left_share"], [[0]])


def test_the_expert_scores_perfectly_and_a_straight_run_collides(cases: Cases) -> None:
    plans = cases.reference[:, None]
    scores = Obstacles().score(SYSTEM, cases, plans, plans)
    assert scores.per_plan["collision_rollout"].mean() < 0.02
    assert scores.per_plan["collision_at_samples_planned"].max() == 0
    np.testing.assert_allclose(scores.per_plan["cost_ratio"], 1)
    np.testing.assert_array_equal(np.nan_to_num(scores.per_plan["side_agreement_planned"], nan=1), 1)
    assert scores.per_step["inside_planned"].shape == (200, 1, 41)
    freely = Obstacles(max_obstacles=4, margin=0.0)
    bare = cases.environment.copy()
    bare[:, 14:] = 0
    through = freely.solve(SYSTEM, bare).reference[:, None]
    scores = freely.score(SYSTEM, cases, through, through)
    assert 0.4 < scores.per_plan["collision_planned"].mean() < 0.7
    assert (scores.per_plan["cost_ratio"] <= 1 + 1e-9).all()


def test_success_is_to_keep_clear_and_to_pass_the_waypoints() -> None:
    e, plans = one_disc(), paths(ABOVE, BELOW, INSIDE)
    collisions, _ = collision_scores(e, plans)
    scores = {f"{k}_rollout": v for k, v in (collisions | waypoint_scores(e, plans)).items()}
    np.testing.assert_array_equal(success_scores(scores, tolerance=0.1), [[1, 0, 0]])
    np.testing.assert_array_equal(success_scores(scores, tolerance=2.0), [[1, 1, 0]])
    scores["waypoint_distance_1_rollout"] = np.full((1, 3), np.nan)  # an environment without that waypoint
    np.testing.assert_array_equal(success_scores(scores, tolerance=0.1), [[1, 1, 0]])


def test_the_plan_chosen_is_the_cheapest_that_is_clear_or_else_the_one_that_enters_least() -> None:
    cost, nothing = np.array([[3.0, 1, 2]]), np.full((1, 3), np.nan)
    np.testing.assert_array_equal(choice(cost, np.array([[0.1, -0.1, 0.0]])), [[False, False, True]])
    np.testing.assert_array_equal(choice(cost, np.array([[-0.1, -0.3, -0.2]])), [[True, False, False]])
    np.testing.assert_array_equal(choice(cost, nothing), [[False, True, False]])


def test_scores_of_chosen_and_successful_plans_leave_out_the_others(cases: Cases) -> None:
    good = cases.reference
    bad = good + 1.0
    plans = np.stack([bad, good, bad], axis=1)
    scores = Obstacles().score(SYSTEM, cases, plans, plans)
    np.testing.assert_array_equal(scores.per_plan["success"], np.tile([0.0, 1.0, 0.0], (200, 1)))
    assert scores.headline["successful_plans"] == 200
    kept = scores.per_plan["cost_ratio_successful"]
    np.testing.assert_allclose(kept[:, 1], 1)
    assert np.isnan(kept[:, [0, 2]]).all()
    for name, expected in (("success", 1), ("collision", 0), ("state_error", 0), ("cost_ratio", 1)):
        found = scores.per_plan[f"{name}_chosen"]
        assert (~np.isnan(found)).sum(axis=1).tolist() == [1] * 200
        np.testing.assert_allclose(np.nanmean(found), expected, atol=1e-12)


# --- the printed cost -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("obstacles", "expected"), [(1, -14.6), (2, -33.3), (3, -52.0), (4, -70.7)])
def test_the_printed_cost_is_unbounded_at_the_papers_sizes(obstacles: int, expected: float) -> None:
    problem = literal_problem(waypoint_weight=1.0, input_cost=1.0)
    smallest = np.linalg.eigvalsh(literal.curvature(problem, 0, obstacles))[0]
    assert smallest == pytest.approx(expected, rel=0.01)


def literal_problem(**settings: float) -> ObstacleProblem:
    task = Obstacles(formulation="literal", **settings)  # type: ignore[arg-type]
    e, _ = task.distribution_for(0.1).sample(1, np.random.default_rng(0))
    return task.problem(e, 0.1, margin=0.0)


def test_an_unbounded_printed_cost_is_refused_with_what_would_do() -> None:
    task = Obstacles(formulation="literal", input_cost=1.0)
    with pytest.raises(InfeasibleError, match=r"lambda_min\(M\) = -.* input_cost >= .* task.formulation=constrained"):
        task.cases(SYSTEM, 2, np.random.default_rng(0))


def test_the_input_cost_that_the_message_names_is_the_smallest_that_does() -> None:
    problem = literal_problem(input_cost=1.0)
    present = int((problem.radius > 0).sum())
    needed = 1.0 - np.linalg.eigvalsh(literal.curvature(problem, 0, present))[0]
    literal.check_bounded(replace(problem, input_cost=needed * (1 + 1e-9)), 0)
    with pytest.raises(InfeasibleError):
        literal.check_bounded(replace(problem, input_cost=needed * (1 - 1e-6)), 0)


@pytest.mark.parametrize("input_cost", [1.0, 30.0, 60.0])
def test_the_number_of_obstacles_that_the_message_names_is_the_largest_that_does(input_cost: float) -> None:
    problem = literal_problem(input_cost=input_cost)
    present = int((problem.radius > 0).sum())
    least = [np.linalg.eigvalsh(literal.curvature(problem, 0, k))[0] for k in range(present + 1)]
    if least[present] >= 0:
        return literal.check_bounded(problem, 0)
    with pytest.raises(InfeasibleError) as told:
        literal.check_bounded(problem, 0)
    assert f"or at most {sum(value >= 0 for value in least) - 1} of its {present} obstacles" in str(told.value)


def test_a_number_of_obstacles_that_just_does_is_named() -> None:
    problem = literal_problem(input_cost=1.0)
    least = np.linalg.eigvalsh(literal.curvature(problem, 0, 1))[0]
    with pytest.raises(InfeasibleError, match="or at most 1 of its"):
        literal.check_bounded(replace(problem, input_cost=1.0 - least + 0.5), 0)


def test_a_bounded_printed_cost_is_solved_to_its_minimum() -> None:
    problem = literal_problem(waypoint_weight=1000.0, input_cost=1.0)
    found = literal.solve(problem)
    assert found.solved.all()
    rng = np.random.default_rng(0)
    G = literal.response(problem.horizon, problem.time_step)
    for _ in range(20):
        moved = found.positions + (G @ (0.02 * rng.normal(size=(problem.horizon - 1, 2))))[None]
        assert literal.cost(problem, moved)[0] >= found.cost[0]
    np.testing.assert_allclose(found.positions[:, :2], problem.start, atol=1e-12)


def test_plans_are_not_priced_against_the_printed_cost() -> None:
    task = Obstacles(formulation="literal", waypoint_weight=1000.0, input_cost=1.0)
    cases = task.cases(SYSTEM, 2, np.random.default_rng(0))
    plans = cases.reference[:, None]
    assert "cost_ratio" not in task.score(SYSTEM, cases, plans, plans).per_plan


def test_waypoints_may_be_due_one_step_after_the_start_and_one_before_the_end() -> None:
    assert Obstacles(horizon=12, waypoint_times=[1, 11]).waypoint_times == [1, 11]

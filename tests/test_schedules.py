"""Laws of schedules, run on every preset in conf/."""

from __future__ import annotations

import numpy as np
import pytest
from laws import component, presets

from dadiff.diffusion.schedule import Schedule, cosine, ddpm_linear, paper_linear
from dadiff.errors import ConfigError

every_schedule = pytest.mark.parametrize("schedule", [component("schedule", p) for p in presets("schedule")])


@every_schedule
class TestEverySchedule:
    def test_alpha_bar_is_the_product_of_what_is_left(self, schedule):
        assert len(schedule.beta) == schedule.num_steps + 1
        assert schedule.alpha_bar[0] == 1
        np.testing.assert_allclose(schedule.alpha_bar, np.cumprod(1 - schedule.beta), rtol=1e-13)

    def test_noise_only_ever_grows(self, schedule):
        assert (np.diff(schedule.alpha_bar) <= 0).all()
        assert schedule.alpha_bar[1] < 1
        assert ((schedule.beta >= 0) & (schedule.beta <= 1)).all()

    def test_its_conditions_are_those_of_its_beta(self, schedule):
        held = schedule.conditions()
        assert held["C1"] == (schedule.beta[0] == 0 and schedule.beta[-1] == 1)
        assert held["C2"]
        assert held["C3"] == all(a <= b for a, b in zip(schedule.beta, schedule.beta[1:], strict=False))

    def test_little_signal_is_left_at_the_end(self, schedule):
        assert schedule.alpha_bar[-1] < 1e-4


def test_the_papers_schedule_satisfies_all_its_conditions():
    schedule = component("schedule", "paper_linear")
    np.testing.assert_allclose(schedule.beta, 0.001 * np.arange(1001), rtol=1e-15)
    assert schedule.alpha_bar[-1] == 0
    assert schedule.conditions() == {"C1": True, "C2": True, "C3": True}


def test_a_schedule_that_ends_in_1_up_to_rounding_ends_in_1():
    assert 49 * (1 / 49) != 1
    assert paper_linear(49, 1 / 49).beta[-1] == 1
    assert paper_linear(49, 0.5 / 49).beta[-1] == pytest.approx(0.5)


def test_the_usual_schedules_do_not_reach_beta_1():
    assert ddpm_linear().conditions() == {"C1": False, "C2": True, "C3": True}
    assert cosine().conditions() == {"C1": False, "C2": True, "C3": True}
    np.testing.assert_allclose(ddpm_linear().beta[[1, -1]], [1e-4, 0.02])


def test_the_cosine_schedule_follows_the_cosine():
    schedule, share = cosine(100), np.arange(100) / 100
    expected = np.cos((share + 0.008) / 1.008 * np.pi / 2) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(schedule.alpha_bar[:-1], expected, rtol=1e-10)


def test_a_falling_beta_fails_the_third_condition():
    assert not Schedule(np.array([0, 0.5, 0.2, 1.0])).conditions()["C3"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: paper_linear(slope=0.002), r"beta_501 = 1\.002 lies outside \[0, 1\]"),
        (lambda: paper_linear(slope=-0.001), r"beta_1 = -0\.001 lies outside"),
        (lambda: paper_linear(slope=float("nan")), "beta_1 = nan lies outside"),
        (lambda: ddpm_linear(beta_last=1.5), "lies outside"),
        (lambda: ddpm_linear(beta_first=0.0), "the first step adds no noise"),
        (lambda: ddpm_linear(beta_first=1e-20), "the first step adds no noise"),
        (lambda: paper_linear(num_steps=0), "num_steps is 0; it must be at least 1"),
        (lambda: ddpm_linear(num_steps=-3), "num_steps is -3"),
        (lambda: cosine(num_steps=0), "num_steps is 0"),
        (lambda: Schedule(np.array([0.1, 0.2])), r"beta\[0\] = 0"),
        (lambda: Schedule(np.zeros((3, 2))), r"shape \(3, 2\)"),
    ],
)
def test_values_out_of_range_are_refused_in_one_line(make, message):
    with pytest.raises(ConfigError, match=rf"^schedule: [^\n]*{message}[^\n]*$"):
        make()


def test_a_schedule_whose_beta_stays_the_same_does_not_fall():
    assert Schedule(np.array([0.0, 0.1, 0.1, 0.2])).conditions()["C3"]
    assert not Schedule(np.array([0.0, 0.1, 0.05])).conditions()["C3"]

"""Intervals and bands cover as often as they say, are no wider than need be, and pair what is paired."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import stdtrit

from dadiff.errors import ShapeError
from dadiff.reporting import statistics as st
from dadiff.reporting.statistics import Draws

CROSSED = ("training seed", "case")
TAIL = (1 - st.CONFIDENCE) / 2


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def crossed(rng, seeds: int, cases: int, ratio: float, together: float, repeats: int) -> np.ndarray:
    """Seed and case effects and what is left, about 0: (seeds, cases, repeats); the one seed of one is the truth."""
    of_seeds = ratio * rng.standard_normal((seeds, 1, repeats)) * (seeds > 1)
    left = together * rng.standard_normal((seeds, cases, repeats))
    return of_seeds + rng.standard_normal((1, cases, repeats)) + left


def widths(values: np.ndarray) -> dict[str, np.ndarray]:
    """Half widths of the usual methods: Student's t over seeds or over cases alone, the sum of both, the bootstrap's.

    The pigeonhole bootstrap (Owen 2007) has the variance of the sum of both in expectation; its percentiles were
    widened by Student's t over the seeds.
    """
    seeds, cases = (values.mean(axis=axis) for axis in (1, 0))
    by_seed, by_case = (part.var(axis=0, ddof=1) / len(part) if len(part) > 1 else np.nan for part in (seeds, cases))
    outer = len(seeds) - 1 if len(seeds) > 1 else len(cases) - 1
    both = np.nansum([by_seed * np.ones(values.shape[-1]), by_case * np.ones(values.shape[-1])], axis=0)
    freedom = {"seeds": len(seeds) - 1, "cases": len(cases) - 1, "both": outer}
    sizes = {"seeds": by_seed, "cases": by_case, "both": both}
    return {name: stdtrit(max(freedom[name], 1), 1 - TAIL) * np.sqrt(sizes[name]) for name in sizes}


def simulated(rng, seeds, cases, ratio, together, repeats) -> tuple[float, float]:
    """How often the interval covers, and its mean width over that of the best method that covers as often as asked."""
    values = crossed(rng, seeds, cases, ratio, together, repeats)
    error, half = np.abs(values.mean(axis=(0, 1))), st.deviation(Draws(values, CROSSED)).interval(TAIL)
    known = {name: width for name, width in widths(values).items() if not np.isnan(width).any()}
    fit = [width.mean() for width in known.values() if (error <= width).mean() >= 0.92]
    return float((error <= half).mean()), float(half.mean() / min(fit))


@pytest.mark.parametrize("seeds", [1, 3, 5, 10])
@pytest.mark.parametrize("ratio", [0, 0.1, 0.5, 3])
def test_intervals_cover_and_are_no_wider_than_need_be(rng, seeds, ratio):
    coverage, width = simulated(rng, seeds, 40, ratio, 0.5, 3000)
    assert 0.92 <= coverage <= 0.97
    assert width <= 1.3


@pytest.mark.slow
@pytest.mark.parametrize("cases", [20, 100])
@pytest.mark.parametrize("together", [0.1, 1.0])
@pytest.mark.parametrize("seeds", [1, 3, 5, 10])
@pytest.mark.parametrize("ratio", [0, 0.05, 0.1, 0.2, 0.5, 1, 3])
def test_intervals_cover_over_the_whole_range(rng, seeds, cases, ratio, together):
    coverage, width = simulated(rng, seeds, cases, ratio, together, 10_000)
    assert 0.917 <= coverage <= 0.973  # 0.92 to 0.97, within what 10,000 repeats leave open
    assert width <= 1.3


@pytest.mark.parametrize("ratio", [0, 0.5, 3])
def test_two_seeds_cover_less(rng, ratio):
    coverage, _ = simulated(rng, 2, 40, ratio, 0.5, 3000)
    assert 0.87 <= coverage <= 0.985


@pytest.mark.parametrize("recordings", [1, 3, 10])
@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_three_factors_cover(rng, recordings, spread):
    """Training seeds, recordings and cases, each with all."""
    repeats, shape = 2000, (3, recordings, 30)
    values = 0.3 * rng.standard_normal((*shape, repeats))
    for axis, size in ((0, 0.3), (1, spread * (recordings > 1)), (2, 1.0)):
        one = [n if at == axis else 1 for at, n in enumerate(shape)]
        values += size * rng.standard_normal((*one, repeats))
    half = st.deviation(Draws(values, ("training seed", "recording", "case"))).interval(TAIL)
    assert 0.92 <= (np.abs(values.mean(axis=(0, 1, 2))) <= half).mean() <= 0.97


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize("ratio", [0, 0.5])
def test_ratios_that_vary_by_factors_cover_on_the_logarithmic_scale(rng, seeds, ratio):
    """Case difficulties are exponential, seeds multiply by lognormal factors: the truth is exp(mean of their logs)."""
    factors = np.exp(ratio * rng.standard_normal((seeds, 1, 2000)))
    values = factors * rng.exponential(size=(1, 100, 2000)) * rng.lognormal(-0.02, 0.2, size=(seeds, 100, 2000))
    logs = Draws(values, CROSSED).logarithmic()
    half = st.deviation(logs).interval(TAIL)
    assert 0.91 <= (np.abs(logs.values.mean(axis=(0, 1))) <= half).mean() <= 0.97


def test_cases_of_their_own_are_nested(rng):
    values = 0.3 * rng.standard_normal((4, 1, 4000)) + rng.standard_normal((4, 25, 4000))
    half = st.deviation(Draws(values, CROSSED, nested=True)).interval(TAIL)
    assert 0.94 <= (np.abs(values.mean(axis=(0, 1))) <= half).mean() <= 0.96
    over_runs = stdtrit(3, 1 - TAIL) * values.mean(axis=1).std(axis=0, ddof=1) / 2
    np.testing.assert_allclose(half, over_runs)


def test_more_seeds_that_say_the_same_decide_no_less(rng):
    """What one seed decides stays decided with more of them, in all but what the intervals' confidence leaves open."""
    values = 0.4 + 0.05 * rng.standard_normal((10, 1, 500)) + rng.standard_normal((1, 60, 500))
    values = values + 0.5 * rng.standard_normal((10, 60, 500))
    low = {
        seeds: values[:seeds].mean(axis=(0, 1)) - st.deviation(Draws(values[:seeds], CROSSED)).interval(TAIL)
        for seeds in (1, 3, 5, 10)
    }
    decided = low[1] > 0
    assert decided.mean() > 0.5
    for seeds in (3, 5, 10):
        assert (low[seeds][decided] > 0).mean() > 0.9
        assert (low[seeds] > 0).mean() > decided.mean() - 0.02


def test_three_recordings_that_agree_on_the_direction_decide():
    """Ratios of 15, 94 and 173 are 62, and above 1."""
    levels = ("recording", "case")
    estimate = st.ratio(Draws(np.array([[15.0], [94.0], [173.0]]), levels), Draws(np.ones((3, 1)), levels))
    assert estimate.value == pytest.approx(62.5, rel=1e-3)
    assert (estimate.low, estimate.high) == pytest.approx((2.65, 1475), rel=0.01)


def test_one_entry_leaves_nothing_to_draw_and_gives_no_interval():
    estimate = st.mean(Draws(np.array([[3.0]]), CROSSED))
    assert estimate.value == pytest.approx(3)
    assert np.isnan([estimate.low, estimate.high]).all()
    band = st.band(Draws(np.ones((1, 1, 4)), CROSSED))
    np.testing.assert_array_equal(band.value, 1)
    assert np.isnan(band.low).all()


def test_bounds_of_what_is_positive_stay_positive(rng):
    values = rng.lognormal(sigma=1.5, size=(2, 30))
    estimate = st.mean(Draws(values, CROSSED))
    assert 0 < estimate.low < estimate.value
    assert estimate.value == pytest.approx(np.sqrt(values.mean(axis=1).prod()))
    cost = st.mean(Draws(1 + values, CROSSED), floor=1)
    assert (cost.low - 1, cost.high - 1) == pytest.approx((estimate.low, estimate.high))
    assert st.mean(Draws(values - 1, CROSSED)).value == pytest.approx(values.mean() - 1)


@pytest.mark.parametrize("seeds", [1, 3, 5])
def test_the_band_covers_the_whole_curve_where_pointwise_intervals_do_not(rng, seeds):
    band_hits = pointwise_hits = 0
    for _ in range(200):
        values = rng.standard_normal((1, 60, 15)) + 0.3 * rng.standard_normal((seeds, 60, 15))
        values = values + (seeds > 1) * 0.1 * rng.standard_normal((seeds, 1, 15)).cumsum(axis=-1) / 3
        draws = Draws(values - values.min(), CROSSED)
        band = st._simultaneous(draws)
        half = st.deviation(draws).interval(TAIL)
        truth = -values.min()
        band_hits += ((band.low <= truth) & (band.high >= truth)).all()
        pointwise_hits += (np.abs(band.value - truth) <= half).all()
    assert band_hits / 200 >= 0.9
    assert pointwise_hits / 200 <= 0.75


def test_a_band_of_positive_values_is_positive_and_has_no_width_at_zero(rng):
    values = rng.lognormal(sigma=2, size=(1, 10, 4))
    values[..., 0], values[..., 3] = 0, np.nan
    band = st.band(Draws(values, CROSSED))
    assert band.low[0] == band.high[0] == 0
    assert (band.low[1:3] > 0).all()
    assert (band.low[1:3] < band.value[1:3]).all()
    assert np.isnan([band.value[3], band.low[3], band.high[3]]).all()
    ratios = st.ratio_band(Draws(2 * values, CROSSED), Draws(values, CROSSED))
    np.testing.assert_allclose([ratios.low, ratios.high], 2 * np.array([[np.nan, 0.5, 0.5, np.nan]] * 2) * 2)


def test_comparisons_are_paired(rng):
    """Where one is exactly twice the other, the ratio has no uncertainty, however much the cases differ."""
    baseline = Draws(rng.lognormal(sigma=2, size=(2, 30)), CROSSED)
    ratio = st.ratio(baseline.times(2), baseline)
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx((2, 2, 2))
    difference = st.difference(Draws(baseline.values + 1, CROSSED), baseline)
    assert (difference.low, difference.high) == pytest.approx((1, 1))


def test_a_level_that_the_baseline_lacks_is_the_same_for_all(rng):
    baseline = Draws(rng.lognormal(size=(3, 20)), CROSSED)
    factors = np.array([2.0, 4.0, 8.0, 16.0])[:, None]
    values = Draws(baseline.values[:, None] * factors, ("training seed", "recording", "case"))
    for estimate, truth in ((st.ratio(values, baseline), 2**2.5), (st.ratio(baseline, values), 2**-2.5)):
        assert estimate.value == pytest.approx(truth)
        assert estimate.low < truth < estimate.high


def test_entries_that_one_side_lacks_count_in_neither():
    values, baseline = np.array([[np.nan, 1.0, 1.0, 1.0]]), np.array([[101.0, 1.0, 1.0, 1.0]])
    assert st.ratio(Draws(values, CROSSED), Draws(baseline, CROSSED)).value == 1


def test_ratios_of_shares_that_are_zero_in_a_run(rng):
    share, other = Draws(rng.integers(0, 2, (3, 40)).astype(float), CROSSED), Draws(np.ones((3, 40)), CROSSED)
    none = Draws(np.concatenate([share.values[:2], np.zeros((1, 40))]), CROSSED)
    assert st.ratio(none, other).value == pytest.approx(none.values.mean())
    assert st.ratio(none, other).low < st.ratio(none, other).value
    assert np.isnan(st.ratio(other, Draws(np.zeros((3, 40)), CROSSED)).value)


def test_undefined_entries_carry_no_weight():
    values = np.tile([1.0, 2.0, 3.0, np.nan, np.nan], 20)[None]
    estimate, known = st.mean(Draws(values, CROSSED)), st.mean(Draws(values[~np.isnan(values)][None], CROSSED))
    assert estimate.value == pytest.approx(2)
    assert estimate.high == pytest.approx(known.high, rel=0.01)
    nothing = st.mean(Draws(np.full_like(values, np.nan), CROSSED))
    assert np.isnan([nothing.value, nothing.low, nothing.high]).all()


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"shape \(2, 0\) for the levels training seed, case"):
        Draws(np.zeros((2, 0)), CROSSED)
    with pytest.raises(ShapeError, match="expected robot and case last"):
        Draws(np.zeros((2, 2)), CROSSED[::-1])

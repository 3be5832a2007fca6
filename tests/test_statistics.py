"""Intervals and bands cover as often as they say, respect the levels of replication, and pair what is paired."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import trim_mean

from dadiff.errors import ShapeError
from dadiff.reporting import statistics as st


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("levels", [(7,), (1, 9), (3, 5), (2, 3, 4)])
def test_weights_are_shares(levels, rng):
    weights = st.bootstrap_weights(levels, 50, rng)
    assert weights.shape == (50, *levels)
    np.testing.assert_allclose(weights.reshape(50, -1).sum(axis=1), 1)


def test_all_seeds_are_tried_on_the_same_drawn_cases(rng):
    weights = st.bootstrap_weights((3, 8), 200, rng)
    seeds, cases = weights.sum(axis=2), weights.sum(axis=1)
    for share, size in ((seeds, 3), (cases, 8)):
        np.testing.assert_allclose(share * size, (share * size).round(), atol=1e-12)
    np.testing.assert_allclose(weights, seeds[:, :, None] * cases[:, None], atol=1e-12)


def test_other_numbers_of_seeds_leave_the_drawn_cases_alike():
    few, many = (st.bootstrap_weights((n, 8), 20, np.random.default_rng(0)).sum(axis=1) for n in (2, 5))
    np.testing.assert_allclose(few, many, atol=1e-12)


def test_the_seed_is_the_unit_of_replication(rng):
    """With equal cases within a seed, all variation is between seeds, however many cases there are."""
    seeds = rng.standard_normal(6)
    values = np.repeat(seeds[:, None], 50, axis=1)
    means = st.resampled_means(values, st.bootstrap_weights((6, 50), 4000, rng))
    assert means.std() == pytest.approx(seeds.std() / np.sqrt(6), rel=0.05)


def test_one_seed_leaves_the_cases(rng):
    values = rng.standard_normal((1, 80))
    means = st.resampled_means(values, st.bootstrap_weights((1, 80), 4000, rng))
    assert means.std() == pytest.approx(values.std() / np.sqrt(80), rel=0.05)


def test_intervals_cover(rng):
    hits = 0
    for _ in range(300):
        values = rng.exponential(size=(1, 60))
        estimate = st.mean(values, st.bootstrap_weights((1, 60), 300, rng))
        hits += estimate.low <= 1 <= estimate.high
    assert 0.89 <= hits / 300 <= 0.98


@pytest.mark.parametrize(("seeds", "seed_deviation"), [(2, 1.0), (3, 1.0), (3, 0.1), (8, 1.0)])
def test_intervals_over_few_seeds_on_shared_cases_cover(rng, seeds, seed_deviation):
    hits = 0
    for _ in range(300):
        cases = rng.standard_normal(40)
        values = 5 + seed_deviation * rng.standard_normal((seeds, 1)) + cases + 0.3 * rng.standard_normal((seeds, 40))
        estimate = st.difference(values, np.zeros_like(values), st.bootstrap_weights((seeds, 40), 300, rng))
        hits += estimate.low <= 5 <= estimate.high
    assert hits / 300 >= 0.91


def test_one_entry_leaves_nothing_to_draw_and_gives_no_interval(rng):
    weights = st.bootstrap_weights((1, 1), 20, rng)
    estimate = st.mean(np.array([[3.0]]), weights)
    assert estimate.value == 3
    assert np.isnan([estimate.low, estimate.high]).all()
    band = st.simultaneous_band(np.ones((1, 1, 4)), weights)
    np.testing.assert_array_equal(band.value, 1)
    assert np.isnan(band.low).all()


def test_bounds_of_what_is_positive_stay_positive(rng):
    values = rng.lognormal(sigma=1.5, size=(2, 30))
    weights = st.bootstrap_weights((2, 30), 500, rng)
    assert st.widening(weights) > 8
    assert 0 < st.mean(values, weights).low < st.mean(values, weights).value


def test_the_band_covers_the_whole_curve_where_pointwise_intervals_do_not(rng):
    band_hits = pointwise_hits = 0
    for _ in range(200):
        values = rng.standard_normal((1, 60, 15))
        weights = st.bootstrap_weights((1, 60), 300, rng)
        band = st.simultaneous_band(values, weights)
        low, high = np.quantile(st.resampled_means(values, weights), [0.025, 0.975], axis=0)
        band_hits += ((band.low <= 0) & (band.high >= 0)).all()
        pointwise_hits += ((low <= 0) & (high >= 0)).all()
    assert band_hits / 200 >= 0.88
    assert pointwise_hits / 200 <= 0.75


def test_a_logarithmic_band_is_positive_and_has_no_width_at_zero(rng):
    values = rng.lognormal(sigma=2, size=(1, 10, 4))
    values[..., 0], values[..., 3] = 0, np.nan
    band = st.simultaneous_band(values, st.bootstrap_weights((1, 10), 400, rng), log=True)
    assert band.low[0] == band.high[0] == 0
    assert (band.low[1:3] > 0).all()
    assert (band.low[1:3] < band.value[1:3]).all()
    assert np.isnan([band.value[3], band.low[3], band.high[3]]).all()


def test_interquartile_mean_is_the_trimmed_mean(rng):
    values = rng.standard_cauchy((1, 40))
    estimate = st.interquartile_mean(values, st.bootstrap_weights((1, 40), 300, rng))
    assert estimate.value == pytest.approx(trim_mean(values.ravel(), 0.25))
    assert estimate.low <= estimate.value <= estimate.high


def test_comparisons_are_paired(rng):
    """Where one is exactly twice the other, the ratio has no uncertainty, however much the cases differ."""
    baseline = rng.lognormal(sigma=2, size=(1, 30))
    weights = st.bootstrap_weights((1, 30), 300, rng)
    ratio = st.ratio(2 * baseline, baseline, weights)
    assert ratio.value == ratio.low == ratio.high == pytest.approx(2)
    difference = st.difference(baseline + 1, baseline, weights)
    assert difference.low == pytest.approx(1)
    assert difference.high == pytest.approx(1)


def test_entries_that_one_side_lacks_count_in_neither(rng):
    values, baseline = np.array([[np.nan, 1.0, 1.0, 1.0]]), np.array([[101.0, 1.0, 1.0, 1.0]])
    assert st.ratio(values, baseline, st.bootstrap_weights((1, 4), 100, rng)).value == 1


def test_undefined_entries_carry_no_weight(rng):
    values = np.array([[1.0, 2.0, 3.0, np.nan, np.nan]])
    weights = st.bootstrap_weights((1, 5), 500, rng)
    assert st.mean(values, weights).value == pytest.approx(2)
    assert np.nanmax(st.resampled_means(values, weights)) <= 3 + 1e-12
    assert 1 <= st.interquartile_mean(values, weights).value <= 3
    for statistic in (st.mean, st.interquartile_mean):
        nothing = statistic(np.full_like(values, np.nan), weights)
        assert np.isnan([nothing.value, nothing.low, nothing.high]).all()


def test_the_same_generator_gives_the_same_interval():
    weights = [st.bootstrap_weights((2, 5), 100, np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(*weights)


def test_wrong_shapes_are_named(rng):
    with pytest.raises(ShapeError, match=r"levels are \(2, 0\)"):
        st.bootstrap_weights((2, 0), 10, rng)
    with pytest.raises(ShapeError, match=r"shape \(4, 3\); the weights are for \(3, 4\)"):
        st.mean(np.zeros((4, 3)), st.bootstrap_weights((3, 4), 10, rng))

"""Laws of covariances diag(D) + U U': algebra, and what is left once entries are known."""

from __future__ import annotations

import numpy as np
import pytest

from dadiff.errors import ConfigError, ShapeError
from dadiff.trajectory.covariance import Covariance
from dadiff.trajectory.subspace import semidefinite_inverse, semidefinite_root

SIZE = 6


def some(rank: int = 2, batch: tuple[int, ...] = (), seed: int = 0) -> Covariance:
    rng = np.random.default_rng(seed)
    return Covariance(rng.uniform(0.1, 1, (*batch, SIZE)), rng.standard_normal((*batch, SIZE, rank)))


@pytest.mark.parametrize("batch", [(), (3,)], ids=["one", "fleet"])
@pytest.mark.parametrize("rank", [0, 2, SIZE])
class TestAlgebra:
    def test_the_matrix_is_diagonal_plus_low_rank(self, batch, rank, rng):
        C, v = some(rank, batch), rng.standard_normal((*batch, 4, SIZE))
        expected = C.diagonal[..., None] * np.eye(SIZE) + C.factor @ C.factor.swapaxes(-1, -2)
        np.testing.assert_allclose(C.matrix, expected, atol=1e-14)
        np.testing.assert_allclose(C.times(v), v @ C.matrix, atol=1e-12)

    def test_scales(self, batch, rank):
        C = some(rank, batch)
        np.testing.assert_allclose(C.scaled(0.3).matrix, 0.3 * C.matrix, atol=1e-12)
        scale = np.linspace(0.5, 2, SIZE)
        np.testing.assert_allclose(C.rescaled(scale).matrix, scale[:, None] * C.matrix * scale, atol=1e-12)

    def test_what_is_left_given_entries_is_the_schur_complement(self, batch, rank):
        C, known = some(rank, batch), [1, 4]
        left, gain = C.given(known)
        full = C.matrix
        expected = full[..., :, known] @ np.linalg.inv(full[..., known, :][..., :, known])
        np.testing.assert_allclose(gain, expected, atol=1e-10)
        np.testing.assert_allclose(left.matrix, full - expected @ full[..., known, :], atol=1e-10)
        assert not left.matrix[..., known].any()

    def test_draws_have_the_covariance(self, batch, rank, rng):
        C = some(rank, batch)
        z = C.draw(rng, (40_000,))
        assert z.shape == (*batch, 40_000, SIZE)
        np.testing.assert_allclose(z.swapaxes(-1, -2) @ z / 40_000, C.matrix, atol=0.03 * np.abs(C.matrix).max())


def test_a_draw_takes_no_more_noise_than_there_are_directions(rng):
    C, eps, more = some(2), rng.standard_normal((3, SIZE)), rng.standard_normal((3, SIZE))
    np.testing.assert_allclose(C.colour(eps, more), eps * np.sqrt(C.diagonal) + more[:, :2] @ C.factor.T, atol=1e-14)


def test_a_dense_matrix_is_one(rng):
    root = rng.standard_normal((SIZE, 3))
    np.testing.assert_allclose(Covariance.dense(root @ root.T).matrix, root @ root.T, atol=1e-12)


def test_leading_directions_are_kept_and_the_others_become_a_diagonal():
    C = some(SIZE)
    few = C.leading(2)
    assert few.factor.shape == (SIZE, 2)
    np.testing.assert_allclose(np.diag(few.matrix), np.diag(C.matrix), atol=1e-12)
    np.testing.assert_allclose(C.leading(SIZE).matrix, C.matrix, atol=1e-12)
    diagonal = C.leading(0)
    np.testing.assert_allclose(diagonal.matrix, np.diag(np.diag(C.matrix)), atol=1e-12)


def test_an_invertible_form_has_a_diagonal_keeps_the_variances_and_is_found_once(rng):
    C = Covariance.dense(np.cov(rng.standard_normal((40, 200))))
    assert C.invertible is C.invertible
    assert C.invertible.diagonal.min() > 0
    np.testing.assert_allclose(np.diag(C.invertible.matrix), np.diag(C.matrix), rtol=1e-9)
    certain = Covariance.diagonal_of(np.array([0.0, 1.0]))
    assert 0 < certain.invertible.diagonal[0] < 1e-5


def test_certain_entries_that_are_given_move_nothing():
    C = Covariance(np.array([0.0, 1, 1]), np.zeros((3, 0)))
    left, gain = C.given([0])
    assert not gain.any()
    np.testing.assert_array_equal(left.matrix, C.matrix)


def test_two_are_the_same_only_if_they_are_one_object():
    C = some()
    assert len({C, C}) == 1
    assert len({C, some()}) == 2


def test_what_is_no_covariance_is_refused():
    with pytest.raises(ConfigError, match="a variance on the diagonal is negative"):
        Covariance.diagonal_of(np.array([1.0, -1e-3]))
    with pytest.raises(ShapeError, match=r"D has shape \(3,\), U \(4, 1\)"):
        Covariance(np.ones(3), np.ones((4, 1)))


def test_roots_and_inverses_of_semidefinite_matrices_do_not_depend_on_units(rng):
    root, units = rng.standard_normal((5, 3)), 10.0 ** np.arange(-4, 6, 2)
    M = root @ root.T
    np.testing.assert_allclose(semidefinite_root(M) @ semidefinite_root(M).T, M, atol=1e-12)
    for scale in (np.ones(5), units):
        scaled = scale[:, None] * M * scale
        inverse = semidefinite_inverse(scaled)
        np.testing.assert_allclose(scaled @ inverse @ scaled / np.outer(scale, scale), M, atol=1e-8)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_what_is_made_invertible_does_not_depend_on_units(size):
    """Certain entries are given a millionth of the mean variance."""
    C = Covariance(np.array([0.0, 1, 2, 0, 3, 4]), np.zeros((SIZE, 0)))
    found = C.scaled(size).invertible
    np.testing.assert_allclose(found.matrix, size * C.invertible.matrix, rtol=1e-9, atol=1e-15 * size)
    assert np.diag(C.invertible.matrix)[[0, 3]] == pytest.approx(1e-6 * 10 / 6, rel=1e-3)


@pytest.mark.parametrize("count", [0, 2, SIZE])
def test_leading_directions_of_a_fleet_are_those_of_its_robots(count):
    fleet = some(3, (2,))
    for k in range(2):
        alone = Covariance(fleet.diagonal[k], fleet.factor[k]).leading(count)
        np.testing.assert_allclose(fleet.leading(count).matrix[k], alone.matrix, atol=1e-12)

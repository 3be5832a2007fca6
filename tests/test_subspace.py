"""Laws of subspaces: bases, kernels, ranks, angles and distances."""

from __future__ import annotations

import numpy as np
import pytest

from dadiff.trajectory.subspace import (
    column_basis,
    column_scaled,
    largest_angle,
    null_space,
    numerical_rank,
    projector_distance,
)


def test_a_basis_is_orthonormal_and_spans_the_image(rng):
    M = rng.standard_normal((2, 9, 4))
    Q = column_basis(M)
    np.testing.assert_allclose(Q.swapaxes(-1, -2) @ Q, np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-14)
    np.testing.assert_allclose(Q @ (Q.swapaxes(-1, -2) @ M), M, atol=1e-13)


def test_the_kernel_is_orthonormal_and_maps_to_0(rng):
    M = rng.standard_normal((2, 3, 8))
    N = null_space(M)
    assert N.shape == (2, 8, 5)
    np.testing.assert_allclose(M @ N, 0, atol=1e-13)
    np.testing.assert_allclose(N.swapaxes(-1, -2) @ N, np.broadcast_to(np.eye(5), (2, 5, 5)), atol=1e-14)


def test_a_rank_does_not_depend_on_scale(rng):
    low = rng.standard_normal((8, 3)) @ rng.standard_normal((3, 6))
    full = rng.standard_normal((8, 6))
    for scale in (1e-9, 1.0, 1e9):
        assert numerical_rank(scale * low) == 3
        assert numerical_rank(scale * np.stack([low, full])) == 3
    assert numerical_rank(np.zeros((4, 4))) == 0


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.3, 1.5])
def test_the_angle_between_a_plane_and_its_rotation(rng, angle):
    basis = column_basis(rng.standard_normal((6, 6)))
    rotated = np.stack([np.cos(angle) * basis[:, 0] + np.sin(angle) * basis[:, 2], basis[:, 1]], axis=-1)
    np.testing.assert_allclose(largest_angle(basis[:, :2], rotated), angle, atol=1e-14, rtol=1e-9)


def test_subspaces_of_other_dimensions_are_a_right_angle_apart(rng):
    Q = column_basis(rng.standard_normal((2, 6, 4)))
    assert (largest_angle(Q, Q[..., :3]) == np.pi / 2).all()


def test_the_distance_is_that_of_the_projectors(rng):
    U, V = (column_basis(rng.standard_normal((3, 9, 4))) for _ in range(2))
    difference = U @ U.swapaxes(-1, -2) - V @ V.swapaxes(-1, -2)
    expected = np.linalg.norm(difference, axis=(-2, -1)) / np.sqrt(8)
    np.testing.assert_allclose(projector_distance(U, V), expected, rtol=1e-12)
    assert projector_distance(U, U).max() < 1e-15
    np.testing.assert_allclose(projector_distance(np.eye(6)[:, :3], np.eye(6)[:, 3:]), 1)


def test_orthogonal_images_are_a_right_angle_apart_whatever_rounding_does(rng):
    bases = column_basis(rng.standard_normal((200, 6, 6)))
    np.testing.assert_allclose(largest_angle(bases[..., :3], bases[..., 3:]), np.pi / 2)


def test_columns_are_scaled_to_length_1_whatever_their_unit_and_zeros_stay(rng):
    M = rng.standard_normal((3, 8, 5)) * [1e-9, 0.1, 0.0, 10.0, 1e9]
    scaled = column_scaled(M)
    np.testing.assert_allclose(np.linalg.norm(scaled, axis=-2), np.tile([1, 1, 0, 1, 1], (3, 1)))
    np.testing.assert_allclose(scaled * np.linalg.norm(M, axis=-2, keepdims=True), M)

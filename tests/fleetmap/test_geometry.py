"""Rotations, rigid transforms and alignments against scipy, matrix exponentials and evo's Umeyama."""

import numpy as np
import pytest
from evo.core import geometry as evo_geometry
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from fleetmap.geometry import (
    Array,
    align_points,
    interpolate_se3,
    length,
    quat_wxyz_from_rotation,
    rotation_angle_rad,
    rotation_between_vectors,
    rotation_from_quat_wxyz,
    se3,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    skew,
    so3_exp,
    so3_left_jacobian,
    so3_log,
    transform_points,
)

triples = arrays(np.float64, 3, elements=st.floats(-1, 1, allow_subnormal=False))
tangents = arrays(np.float64, 6, elements=st.floats(-1.7, 1.7, allow_subnormal=False))


def directions(count: int) -> Array:
    rows = np.random.default_rng(1).normal(size=(count, 3))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-7, 9e-7, 1.1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-5, np.pi - 1e-9])
def test_rotation_exponential_and_logarithm_agree_with_scipy(angle_rad: float) -> None:
    for axis in [*np.eye(3), *-np.eye(3), *directions(5)]:
        rotvec = angle_rad * axis
        rotation = so3_exp(rotvec)
        np.testing.assert_allclose(rotation, Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(so3_log(rotation), rotvec, atol=1e-9)
        assert rotation_angle_rad(rotation) == pytest.approx(angle_rad, abs=1e-9)


def test_logarithm_of_a_half_turn_gives_the_half_turn_back() -> None:
    for axis in directions(20):
        rotation = so3_exp(np.pi * axis)
        np.testing.assert_allclose(so3_exp(so3_log(rotation)), rotation, atol=1e-9)
        assert np.linalg.norm(so3_log(rotation)) == pytest.approx(np.pi, abs=1e-9)


def test_quaternions_agree_with_scipy_in_every_branch() -> None:
    for rotation in [*Rotation.random(50, random_state=3), *(Rotation.from_rotvec(3.1 * a) for a in np.eye(3))]:
        expected = rotation.as_quat(canonical=True, scalar_first=True)
        quat = quat_wxyz_from_rotation(rotation.as_matrix())
        assert quat[0] >= 0
        np.testing.assert_allclose(quat, expected, atol=1e-12)
        np.testing.assert_allclose(rotation_from_quat_wxyz(3.0 * quat), rotation.as_matrix(), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(tangents)
def test_rigid_transforms_are_the_matrix_exponential_and_come_back(rot_trans: Array) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(rot_trans[:3]), rot_trans[3:]
    np.testing.assert_allclose(se3_exp(rot_trans), expm(generator), atol=1e-8)
    np.testing.assert_allclose(se3_log(se3_exp(rot_trans)), rot_trans, atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(triples)
def test_left_jacobian_is_the_derivative_of_the_exponential(rotvec: Array) -> None:
    steps = 1e-6 * np.eye(3)
    ends = [[so3_log(so3_exp(rotvec + sign * d) @ so3_exp(rotvec).T) for sign in (1, -1)] for d in steps]
    columns = np.transpose([(ahead - behind) / 2e-6 for ahead, behind in ends])
    np.testing.assert_allclose(so3_left_jacobian(rotvec), columns, atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(tangents, tangents)
def test_adjoint_carries_a_perturbation_to_other_axes(where: Array, perturbation: Array) -> None:
    target_from_source = se3_exp(where)
    carried = se3_exp(se3_adjoint(target_from_source) @ perturbation) @ target_from_source
    np.testing.assert_allclose(carried, target_from_source @ se3_exp(perturbation), atol=1e-7)


@settings(max_examples=40, deadline=None)
@given(triples, triples)
def test_cross_product_matrix(a: Array, b: Array) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("is_planar", [False, True])
def test_alignment_agrees_with_evo(with_scale: bool, is_planar: bool) -> None:
    """Noisy points, also in a plane, where a reflection would fit as well as a rotation."""
    rng = np.random.default_rng(5)
    points_source = rng.normal(size=(30, 3)) * ([1, 1, 0] if is_planar else [1, 1, 1])
    target_from_source = se3_exp(np.array([0.5, -2.0, 1.0, 3.0, -1.0, 2.0]))
    points_target = 1.7 * transform_points(target_from_source, points_source) + 0.05 * rng.normal(size=(30, 3))
    found, scale = align_points(points_target, points_source, with_scale=with_scale)
    rotation, translation, evo_scale = evo_geometry.umeyama_alignment(points_source.T, points_target.T, with_scale)
    np.testing.assert_allclose(found, se3(rotation, translation), atol=1e-9)
    assert scale == pytest.approx(evo_scale)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_interpolation_halves_the_way() -> None:
    a, b = se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])), se3_exp(np.array([1.0, -0.4, 0.2, 0.0, 2.0, -3.0]))
    middle = interpolate_se3(a, b, 0.5)
    np.testing.assert_allclose(se3_inverse(a) @ middle, se3_inverse(middle) @ b, atol=1e-12)
    np.testing.assert_allclose(interpolate_se3(a, b, 0.0), a, atol=1e-12)
    np.testing.assert_allclose(interpolate_se3(a, b, 1.0), b, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(triples.filter(lambda v: np.linalg.norm(v) > 1e-3), triples.filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_smallest_rotation_between_directions(source: Array, target: Array) -> None:
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    rotation = rotation_between_vectors(source, target)
    np.testing.assert_allclose(rotation @ a, b, atol=1e-9)
    assert rotation_angle_rad(rotation) == pytest.approx(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b), abs=1e-8)


@pytest.mark.parametrize("source", [*np.eye(3), np.array([0.6, 0.0, -0.8])])
def test_rotation_to_the_opposite_direction_is_a_half_turn(source: Array) -> None:
    rotation = rotation_between_vectors(source, -source)
    np.testing.assert_allclose(rotation @ source, -source, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@given(arrays(np.float64, st.integers(1, 6), elements=st.floats(-1e6, 1e6)))
def test_length_is_the_norm_to_the_bit(vector: Array) -> None:
    padded = np.zeros((len(vector), 4))
    padded[:, 3] = vector  # a column, as of a transform
    assert length(vector) == np.linalg.norm(vector)
    assert length(padded[:, 3]) == np.linalg.norm(padded[:, 3])


@given(tangents)
def test_one_inverse_is_that_of_a_stack_to_the_bit(tangent: Array) -> None:
    a_from_b = se3_exp(tangent)
    np.testing.assert_allclose(se3_inverse(a_from_b), np.linalg.inv(a_from_b), atol=1e-12)
    np.testing.assert_array_equal(se3_inverse(a_from_b), se3_inverse(np.stack([a_from_b, a_from_b]))[1])

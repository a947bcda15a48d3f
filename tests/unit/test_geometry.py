"""Rotations and cameras in numpy: round trips, canonical quaternions and the pixel-centre convention."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_histmv import geometry

AXIS_ALIGNED = np.eye(3, 4)


def random_quaternions(count: int) -> np.ndarray:
    q = np.random.default_rng(count).normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([Rotation.random(rng=rng).as_matrix(), rng.normal(size=(3, 1))], axis=1)


def test_quaternions_survive_the_way_through_matrices() -> None:
    q = random_quaternions(31)
    matrices = geometry.matrix_from_quaternion(q)
    np.testing.assert_allclose(matrices, Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(geometry.quaternion_from_matrix(matrices), geometry.canonical(q), atol=1e-9)


def test_canonical_is_the_same_for_q_and_minus_q_and_changes_no_rotation() -> None:
    q = random_quaternions(31)
    canonical = geometry.canonical(q)
    assert (canonical[:, 0] >= 0).all()
    np.testing.assert_array_equal(geometry.canonical(-q), canonical)
    np.testing.assert_array_equal(geometry.canonical(canonical), canonical)
    np.testing.assert_allclose(
        geometry.matrix_from_quaternion(canonical), geometry.matrix_from_quaternion(q), atol=1e-12
    )


@pytest.mark.parametrize("axis", [1, 2, 3])
def test_half_turns_have_one_canonical_quaternion(axis: int) -> None:
    half_turn = np.eye(4)[axis]
    np.testing.assert_array_equal(geometry.canonical(half_turn), half_turn)
    np.testing.assert_array_equal(geometry.canonical(-half_turn), half_turn)


def test_unit_quaternion_forgives_rounding_and_keeps_the_shape() -> None:
    q = random_quaternions(7).reshape(7, 1, 4)
    rounded = geometry.unit_quaternion(np.float16(q))
    assert rounded.shape == q.shape
    np.testing.assert_allclose(np.linalg.norm(rounded, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(rounded, geometry.canonical(q), atol=1e-3)


@pytest.mark.parametrize("broken", [[0.0] * 4, [2.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 1.0], [0.3, -0.1, 0.2, 0.0]])
def test_unit_quaternion_names_what_is_not_one(broken: list[float]) -> None:
    among_good_ones = np.concatenate([random_quaternions(5), [broken]])
    with pytest.raises(ValueError, match=r"state of frame 7 .*not a unit quaternion \(w, x, y, z\)") as error:
        geometry.unit_quaternion(among_good_ones, what="state of frame 7")
    assert str(broken) in str(error.value), "the message shows the offending value"


def test_angle_between_is_the_angle_of_the_relative_rotation() -> None:
    first, second = random_quaternions(31), random_quaternions(31)[::-1]
    one, other = (Rotation.from_quat(q, scalar_first=True) for q in (first, second))
    expected = (one.inv() * other).magnitude()
    np.testing.assert_allclose(geometry.angle_between(first, second), expected, atol=1e-7)
    np.testing.assert_allclose(geometry.angle_between(second, -first), expected, atol=1e-7)
    np.testing.assert_allclose(geometry.angle_between(first, -first), 0, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_projecting_a_deprojected_image_gives_every_pixel_and_its_depth(seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.2, 3, size=(5, 7))
    intrinsics, pose = np.array([11.0, 13.0, 2.9, 2.3]), random_pose(seed)
    pixels, z = geometry.project(geometry.deproject(depth, intrinsics, pose), intrinsics, pose)
    v, u = np.indices(depth.shape)
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-9)
    np.testing.assert_allclose(z, depth, atol=1e-12)


def test_unmeasured_pixels_map_to_the_camera() -> None:
    pose = random_pose(3)
    points = geometry.deproject(np.zeros((2, 3)), np.array([5.0, 5.0, 1.0, 0.5]), pose)
    np.testing.assert_allclose(points, np.broadcast_to(pose[:, 3], (2, 3, 3)), atol=1e-15)


def test_pixel_centres_lie_on_whole_numbers() -> None:
    """In an image of W columns, cx = (W - 1) / 2 and the field of view ends half a pixel beyond the outer centres."""
    width, height, half_angle = 7, 5, np.deg2rad(30)
    focal = width / 2 / np.tan(half_angle)
    intrinsics = np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
    z = 1.7
    axis, right_edge = [0, 0, z], [z * np.tan(half_angle), 0, z]
    lower_edge = [0, z * np.tan(half_angle) * height / width, z]
    pixels, _ = geometry.project(np.array([axis, right_edge, lower_edge]), intrinsics, AXIS_ALIGNED)
    expected = [[3, 2], [width - 0.5, 2], [3, height - 0.5]]
    np.testing.assert_allclose(pixels, expected, atol=1e-12)


def test_camera_axes_are_right_down_forward() -> None:
    pixels, z = geometry.project(np.array([[0.1, 0.2, 1.0]]), np.array([10.0, 10.0, 0.0, 0.0]), AXIS_ALIGNED)
    np.testing.assert_allclose(pixels, [[1, 2]])
    np.testing.assert_allclose(z, [1])


def test_points_behind_the_camera_have_no_pixel() -> None:
    pixels, z = geometry.project(np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0]]), np.ones(4), AXIS_ALIGNED)
    assert np.isnan(pixels).all()
    assert (z <= 0).all()

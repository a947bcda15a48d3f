"""Noise of cameras: nothing at strength 0, the stated laws at strength 1."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from lerobot_histmv.envs import sensor_noise

ROWS, COLUMNS = 61, 83


def plane(millimetres: int) -> np.ndarray:
    return np.full((ROWS, COLUMNS, 1), millimetres, np.uint16)


def test_strength_0_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    image, depth = (
        rng.integers(0, 256, (ROWS, COLUMNS, 3), np.uint8),
        rng.integers(0, 2000, (ROWS, COLUMNS, 1), np.uint16),
    )
    np.testing.assert_array_equal(sensor_noise.noisy_colors(image, 0, rng), image)
    np.testing.assert_array_equal(sensor_noise.stereo_depth(depth, 0, rng), depth)


@pytest.mark.parametrize("strength", [1, 3])
@pytest.mark.parametrize("metres", [0.5, 1.0, 2.0])
def test_depth_noise_grows_with_the_square_of_distance(metres: float, strength: float) -> None:
    depth = sensor_noise.stereo_depth(plane(round(1000 * metres)), strength, np.random.default_rng(0))
    errors = depth[depth > 0] / 1000 - metres
    expected = strength * metres**2 * sensor_noise.SUBPIXEL / sensor_noise.FOCAL_BASELINE
    assert errors.std() == pytest.approx(expected, rel=0.1, abs=3e-4)
    assert abs(errors.mean()) < 4 * expected / np.sqrt(len(errors)) + 1e-4
    assert (depth == 0).mean() == pytest.approx(sensor_noise.DROPOUTS * strength, rel=0.4)


def test_holes_open_at_edges_and_missing_depth_stays_missing() -> None:
    depth = plane(800)
    depth[:, 40:] = 900
    depth[:7] = 0
    found = np.mean([sensor_noise.stereo_depth(depth, 1, np.random.default_rng(i)) == 0 for i in range(20)], axis=0)
    assert (found[:7] == 1).all()
    at_edge = found[9:, 39:41]
    assert at_edge.mean() == pytest.approx(sensor_noise.EDGE_HOLES, abs=0.06)
    assert found[9:, :38].mean() < 2 * sensor_noise.DROPOUTS


def test_colours_stay_in_range() -> None:
    image = np.concatenate([np.zeros((ROWS, COLUMNS, 3), np.uint8), np.full((ROWS, COLUMNS, 3), 255, np.uint8)])
    noisy = sensor_noise.noisy_colors(image, 5, np.random.default_rng(0))
    assert noisy.dtype == np.uint8
    assert noisy[:ROWS].max() < 200
    assert noisy[ROWS:].min() > 55


def test_a_card_hides_its_share_of_colour_and_depth() -> None:
    image = np.full((ROWS, COLUMNS, 3), 7, np.uint8)
    shown, depth = sensor_noise.hide_behind_card(image, plane(800), 0.25, 0.3)
    hidden = (shown == sensor_noise.CARD_COLOR).all(axis=-1)
    np.testing.assert_array_equal(hidden, depth[..., 0] == sensor_noise.CARD_DEPTH)
    assert hidden.mean() == pytest.approx(0.3, abs=0.02)
    assert (image == 7).all()

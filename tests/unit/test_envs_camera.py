"""Images: calibrated to a fraction of a millimetre and of a pixel, and never black."""

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from lerobot_histmv import geometry
from lerobot_histmv.envs import UR5Env, camera, make

SIZE = 127
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


@pytest.fixture(scope="module")
def env() -> Iterator[UR5Env]:
    built = make("reach_target", image_size=SIZE)
    built.reset(seed=0)
    yield built
    built.close()


def test_the_tent_keeps_constants_and_centres() -> None:
    np.testing.assert_array_equal(camera._tent(np.full((7, 7, 3), 201, np.uint8)), 201)
    impulse = np.zeros((11, 11, 3), np.uint8)
    impulse[2 * 3 + 1, 2 * 1 + 1] = 255
    small = camera._tent(impulse)
    assert small.shape == (5, 5, 3)
    assert small[3, 1, 0] == 64
    assert np.count_nonzero(small[..., 0]) == 1


@pytest.mark.parametrize("name", camera.CAMERAS)
def test_depth_deprojects_to_what_a_ray_hits(env: UR5Env, name: str) -> None:
    renderer, simulation = env.stage.renderer, env.stage.simulation
    _, depth = renderer.render(simulation.data, name, SIZE)
    intrinsics, extrinsics = renderer.intrinsics(name, SIZE), renderer.extrinsics(simulation.data, name)
    points = geometry.deproject(depth[..., 0] / 1000, intrinsics, extrinsics)
    eye, geom, errors = extrinsics[:, 3], np.zeros(1, np.int32), []
    for point in points[::11, ::11].reshape(-1, 3):
        ray = (point - eye) / np.linalg.norm(point - eye)
        hit = mujoco.mj_ray(simulation.model, simulation.data, eye, ray, VISIBLE_GROUPS, 1, -1, geom)
        errors.append(abs(hit - np.linalg.norm(point - eye)))
    assert np.median(errors) < 5e-4
    assert np.percentile(errors, 95) < 1e-3


@pytest.mark.parametrize("name", camera.CAMERAS)
def test_colour_and_calibration_agree_below_a_quarter_pixel(env: UR5Env, name: str) -> None:
    renderer, simulation = env.stage.renderer, env.stage.simulation
    ball = env.stage.task.slots[0]
    for other in env.stage.task.slots[1:]:
        simulation.place_fixed(other, (-1.0, 0.0, 0.0))
    simulation.paint(ball, (0.0, 1.0, 0.0))
    rng, errors = np.random.default_rng(0), []
    for _ in range(10):
        simulation.place_fixed(ball, rng.uniform([0.35, -0.15, 0.1], [0.55, 0.15, 0.1]))
        simulation.refresh()
        image, _ = renderer.render(simulation.data, name, SIZE)
        seen = np.argwhere(image[..., 1] > 1.5 * image[..., 0]).mean(0)[::-1]
        intrinsics, extrinsics = renderer.intrinsics(name, SIZE), renderer.extrinsics(simulation.data, name)
        errors.append(seen - geometry.project(simulation.position(ball)[None], intrinsics, extrinsics)[0][0])
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.2)


def test_intrinsics_are_symmetric_and_scale_with_the_image(env: UR5Env) -> None:
    small, large = (env.stage.renderer.intrinsics("front", size) for size in (31, 310))
    np.testing.assert_allclose(small[2:], 15)
    np.testing.assert_allclose(large[:2] / small[:2], 10, rtol=0.02)


def test_closing_one_environment_leaves_the_others_images(env: UR5Env) -> None:
    expected = env.observe()["pixels"]
    other = make("pick_and_lift", image_size=SIZE)
    other.reset(seed=0)
    other.close()
    for name, image in env.observe()["pixels"].items():
        assert image.std() > 5
        np.testing.assert_array_equal(image, expected[name])


def test_background_has_no_depth(env: UR5Env) -> None:
    simulation, renderer = env.stage.simulation, env.stage.renderer
    gaze = simulation.model.body("front_gaze")
    before = gaze.pos.copy()
    gaze.pos[:] = (0.4, 0, 5)
    simulation.refresh()
    _, depth = renderer.render(simulation.data, "front", SIZE)
    gaze.pos[:] = before
    simulation.refresh()
    assert (depth == 0).any()

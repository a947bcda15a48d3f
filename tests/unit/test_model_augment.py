"""Augmentation keeps colours, depth, calibration and poses consistent with one another."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_scene import SEEN, SIZE, cameras_around, noise_images

from lerobot_histmv.model.augment import (
    AugmentConfig,
    jitter_colours,
    move_cameras,
    move_points,
    noisy_depth,
    random_world_motion,
)
from lerobot_histmv.model.cameras import deproject, project
from lerobot_histmv.windows import Window

N, K = 2, 3
STRONG = AugmentConfig(yaw=1.0, shift=0.3, pixels=7, brightness=0.3, contrast=0.3, depth_noise=0.01)
OFF = AugmentConfig(
    yaw=0.0, shift=0.0, pixels=0, brightness=0.0, contrast=0.0, lost_view=0.0, card=0.0, depth_noise=0.0
)


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    rgb, depth = noise_images(N, K, torch.Generator().manual_seed(0))
    intrinsics, extrinsics = cameras_around(K)
    return rgb, depth, intrinsics.repeat(N, 1, 1), extrinsics.repeat(N, 1, 1, 1)


def motion(config: AugmentConfig = STRONG) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(3)
    return random_world_motion(N, config, SEEN)


def test_motion_s_quaternion_is_its_matrix_s_and_turns_about_the_vertical() -> None:
    matrices, quaternions = motion()
    expected = Rotation.from_quat(quaternions.numpy(), scalar_first=True).as_matrix()
    torch.testing.assert_close(matrices[:, :, :3], torch.from_numpy(expected).float())
    assert matrices[:, 2, :3].tolist() == [[0, 0, 1]] * N


def test_rotation_keeps_the_centre_and_strength_bounds_the_travel() -> None:
    torch.manual_seed(0)
    turned, _ = random_world_motion(101, AugmentConfig(yaw=2.0, shift=0.0), SEEN)
    torch.testing.assert_close(move_points(turned, SEEN.expand(101, 1, 3)), SEEN.expand(101, 1, 3))
    moved, quaternions = random_world_motion(101, AugmentConfig(yaw=0.3, shift=0.05), SEEN)
    travel = (move_points(moved, SEEN.expand(101, 1, 3))[:, 0] - SEEN).abs()
    assert (travel.amax(dim=0) <= torch.tensor([0.05, 0.05, 0.025]) + 1e-6).all()
    assert (travel.amax(dim=0) > torch.tensor([0.04, 0.04, 0.02])).all()
    assert (2 * quaternions[:, 0].acos() <= 0.3 + 1e-3).all()


def test_world_motion_moves_the_cloud_rigidly() -> None:
    _, depth, intrinsics, extrinsics = scene()
    matrices, _ = motion()
    before = deproject(depth, intrinsics, extrinsics)
    after = deproject(depth, intrinsics, move_cameras(matrices, extrinsics[:, None])[:, 0])
    expected = move_points(matrices, before.movedim(2, -1).flatten(1, 3)).unflatten(1, (K, *SIZE)).movedim(-1, 2)
    torch.testing.assert_close(after, expected, atol=1e-5, rtol=0)


def test_world_motion_leaves_projections_unchanged() -> None:
    _, _, intrinsics, extrinsics = scene()
    matrices, _ = motion()
    points = SEEN + 0.1 * torch.randn(N, 5, 3)
    moved_cameras = move_cameras(matrices, extrinsics[:, None])[:, 0]
    before, after = (
        project(points, intrinsics, extrinsics),
        project(move_points(matrices, points), intrinsics, moved_cameras),
    )
    torch.testing.assert_close(after[0], before[0], atol=1e-3, rtol=0)
    torch.testing.assert_close(after[1], before[1], atol=1e-5, rtol=0)


def test_cameras_given_are_not_changed() -> None:
    _, _, _, extrinsics = scene()
    matrices, _ = motion()
    kept = extrinsics.clone()
    move_cameras(matrices, extrinsics[:, None])
    assert extrinsics.equal(kept)


def shifted_scene(most: int) -> tuple[Window, Window]:
    """A window before and after nothing but a pixel shift."""
    rgb, depth, intrinsics, extrinsics = scene()
    tool, heat, turn = SEEN.expand(N, 1, 3), torch.ones(N, 1), torch.eye(4)[:1].expand(N, 4)
    window = Window(
        torch.ones(N, 1).bool(), rgb, depth, intrinsics, extrinsics, tool, heat, turn, torch.ones(N), action=None
    )
    torch.manual_seed(0)
    return window, window.distorted(replace(OFF, pixels=most))


def colours_and_points(window: Window) -> torch.Tensor:
    """Colour and world point of every pixel (n, k, 6, y, x)."""
    return torch.cat([window.rgb, deproject(window.depth, window.intrinsics, window.extrinsics)], dim=2)


def test_pixel_shift_keeps_the_world_point_and_the_colour_of_every_pixel() -> None:
    window, shifted = shifted_scene(7)
    steps = (shifted.intrinsics - window.intrinsics).int()
    assert steps[..., :2].eq(0).all(), "focal lengths stay"
    assert steps[..., 2:].ne(0).any()
    before, after = colours_and_points(window), colours_and_points(shifted)
    for n, k in torch.cartesian_prod(torch.arange(N), torch.arange(K)).tolist():
        across = zip(SIZE, (steps[n, k, 3], steps[n, k, 2]), strict=True)
        rows, columns = (torch.arange(side)[max(0, step) : side + min(0, step)] for side, step in across)
        found = after[n, k][:, rows[:, None], columns]
        expected = before[n, k][:, (rows - steps[n, k, 3])[:, None], columns - steps[n, k, 2]]
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
        uncovered = torch.ones(SIZE, dtype=torch.bool)
        uncovered[rows[:, None], columns] = False
        assert shifted.depth[n, k][uncovered].eq(0).all(), "uncovered pixels have no depth"


def test_views_are_shifted_independently_and_no_further_than_asked() -> None:
    steps = torch.cat([(b.intrinsics - a.intrinsics)[..., 2:] for a, b in (shifted_scene(m) for m in (1, 2, 3))])
    assert steps.abs().max() == 3
    assert not steps[:, 0].equal(steps[:, 1])


def test_shift_beyond_the_image_leaves_nothing_of_it() -> None:
    _, shifted = shifted_scene(10 * max(SIZE))
    assert shifted.depth.shape[-2:] == SIZE
    assert shifted.depth.eq(0).any()


def test_colours_stay_in_range_and_change_in_every_view() -> None:
    rgb, *_ = scene()
    changed = jitter_colours(rgb, STRONG)
    assert ((changed >= 0) & (changed <= 1)).all()
    assert (changed - rgb).abs().amax(dim=(2, 3, 4)).gt(0).all()


def test_depth_noise_grows_with_the_square_of_distance_and_spares_invalid_pixels() -> None:
    torch.manual_seed(0)
    depth = torch.tensor([0.0, 0.5, 1.0])[:, None].expand(3, 5003)[None, None]
    noise = noisy_depth(depth, 0.01) - depth
    assert noise[0, 0, 0].eq(0).all()
    torch.testing.assert_close(noise[0, 0, 1:].std(dim=1), torch.tensor([0.0025, 0.01]), rtol=0.05, atol=0)


def test_strength_0_changes_nothing() -> None:
    rgb, depth, _, _ = scene()
    matrices, quaternions = motion(OFF)
    torch.testing.assert_close(matrices, torch.eye(3, 4).expand(N, 3, 4))
    assert quaternions.tolist() == [[1, 0, 0, 0]] * N
    assert jitter_colours(rgb, OFF).equal(rgb)
    assert noisy_depth(depth, 0.0).equal(depth)
    window, same = shifted_scene(0)
    assert all(getattr(same, name).equal(getattr(window, name)) for name in ("rgb", "depth", "intrinsics"))


@pytest.mark.parametrize(
    "name", ["yaw", "shift", "pixels", "brightness", "contrast", "depth_noise", "lost_view", "card"]
)
def test_negative_strengths_are_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=rf"augment\.{name}=-1"):
        AugmentConfig(**{name: -1 if name == "pixels" else -1.0})


def test_a_probability_above_one_is_refused() -> None:
    with pytest.raises(ValueError, match=r"augment\.lost_view=1\.5"):
        AugmentConfig(lost_view=1.5)

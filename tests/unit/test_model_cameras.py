"""Cameras in torch equal those in numpy; the pose heat map is a closed form of the projection."""

import math

import numpy as np
import pytest
import torch
from tiny_scene import SEEN, SIZE, cameras_around

from lerobot_histmv import geometry
from lerobot_histmv.model.cameras import Workspace, deproject, pose_heat_map, project

N, K = 2, 3
STRIDE = 8
CELLS = (SIZE[0] // STRIDE, SIZE[1] // STRIDE)


def calibration() -> tuple[torch.Tensor, torch.Tensor]:
    intrinsics, extrinsics = cameras_around(K)
    return intrinsics.expand(N, K, 4).double(), extrinsics.expand(N, K, 3, 4).double()


def test_deproject_equals_numpy() -> None:
    intrinsics, extrinsics = calibration()
    depth = torch.rand(N, K, 5, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = deproject(depth, intrinsics, extrinsics)
    for n, k in np.ndindex(N, K):
        expected = geometry.deproject(depth[n, k].numpy(), intrinsics[n, k].numpy(), extrinsics[n, k].numpy())
        np.testing.assert_allclose(points[n, k].permute(1, 2, 0), expected, atol=1e-12)


def test_project_equals_numpy_ahead_of_the_camera() -> None:
    intrinsics, extrinsics = calibration()
    points = SEEN.double() + 2 * torch.randn(N, 11, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pixels, depths = project(points, intrinsics, extrinsics)
    assert (depths < 0).any(), "some points must lie behind a camera"
    for n, k in np.ndindex(N, K):
        expected, z = geometry.project(points[n].numpy(), intrinsics[n, k].numpy(), extrinsics[n, k].numpy())
        ahead = z > 0
        np.testing.assert_allclose(depths[n, k], z, atol=1e-12)
        np.testing.assert_allclose(pixels[n, k][torch.from_numpy(ahead)], expected[ahead], atol=1e-9)


def test_projection_is_finite_for_every_point_and_its_gradient_too() -> None:
    intrinsics, extrinsics = calibration()
    camera_centre = extrinsics[0, 0, :, 3]
    points = (
        torch.stack([SEEN.double(), camera_centre, 2 * camera_centre - SEEN]).expand(N, 3, 3).clone().requires_grad_()
    )
    pixels, depths = project(points, intrinsics, extrinsics)
    (pixels.sum() + depths.sum()).backward()
    assert pixels.isfinite().all()
    assert points.grad is not None
    assert points.grad.isfinite().all()


def draw(points: torch.Tensor, heats: list[float]) -> torch.Tensor:
    """Pose map of ``points`` (p, 3) in the first camera."""
    intrinsics, extrinsics = cameras_around(1)
    pixels, depths = project(points[None], intrinsics[None], extrinsics[None])
    return pose_heat_map(pixels, depths, torch.tensor([heats]), CELLS, STRIDE)[0, 0, 0]


def point_seen_at(row: float, column: float) -> torch.Tensor:
    """A world point whose projection in the first camera is the given pixel."""
    intrinsics, extrinsics = (values[0].double().numpy() for values in cameras_around(1))
    fx, fy, cx, cy = intrinsics
    ray = np.array([(column - cx) / fx, (row - cy) / fy, 1.0])
    return torch.from_numpy(0.5 * extrinsics[:, :3] @ ray + extrinsics[:, 3]).float()


def centre_of_cell(row: int, column: int) -> torch.Tensor:
    """Middle of the pixels ``column * STRIDE`` to ``column * STRIDE + STRIDE - 1``, and of the rows alike."""
    return point_seen_at(row * STRIDE + (STRIDE - 1) / 2, column * STRIDE + (STRIDE - 1) / 2)


def test_pose_map_is_a_gaussian_around_the_pinhole_projection() -> None:
    row, column, heat = 1, 2, 0.7
    heat_map = draw(centre_of_cell(row, column)[None], [heat])
    rows, columns = torch.meshgrid(torch.arange(CELLS[0]), torch.arange(CELLS[1]), indexing="ij")
    expected = heat * torch.exp(-0.5 * ((rows - row) ** 2 + (columns - column) ** 2).float())
    torch.testing.assert_close(heat_map, expected, atol=1e-4, rtol=0)


def test_pose_map_lies_between_cells_where_the_tool_does() -> None:
    heat_map = draw(point_seen_at(STRIDE + (STRIDE - 1) / 2, 2 * STRIDE - 0.5)[None], [1.0])
    torch.testing.assert_close(heat_map[1, 1], heat_map[1, 2], atol=1e-4, rtol=0)
    assert math.isclose(heat_map[1, 1].item(), math.exp(-0.125), abs_tol=1e-4)


def test_points_behind_the_camera_and_absent_steps_draw_nothing() -> None:
    _, extrinsics = cameras_around(1)
    behind = 2 * extrinsics[0, :, 3] - SEEN
    assert draw(behind[None], [1.0]).eq(0).all()
    assert draw(SEEN[None], [0.0]).eq(0).all()


def test_overlapping_steps_keep_the_hotter_one() -> None:
    spots = torch.stack([centre_of_cell(1, 1), centre_of_cell(1, 3), centre_of_cell(1, 3)])
    heat_map = draw(spots, [1.0, 0.6, 0.36])
    assert heat_map.max() == heat_map[1, 1]
    torch.testing.assert_close(heat_map[1, 3], torch.tensor(0.6), atol=1e-4, rtol=0)
    assert heat_map.max() <= 1


def test_workspace_holds_its_corners_and_no_pixel_beyond_or_without_depth() -> None:
    workspace = Workspace((0.0, -1.0, 2.0, 1.0, 1.0, 3.0))
    inside = torch.tensor([[0, -1, 2], [1, 1, 3], [0.5, 0, 2.5]])
    outside = torch.tensor([[-0.01, 0, 2.5], [0.5, 1.01, 2.5], [0.5, 0, 1.99]])
    points = torch.cat([inside, outside, inside])
    depth = torch.tensor([1.0] * 6 + [0.0] * 3)
    scaled, valid = workspace.normalise_map(points.T.reshape(1, 1, 3, 1, 9), depth.reshape(1, 1, 1, 9))
    assert valid.flatten().tolist() == [True] * 3 + [False] * 6
    expected = torch.cat([workspace.normalise(inside), torch.zeros(6, 3)])
    torch.testing.assert_close(scaled[0, 0, :, 0].T, expected)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_normalised_coordinates_are_centred_and_linear(scale: float) -> None:
    workspace = Workspace((0.0, -1.0, 2.0, 1.0, 1.0, 3.0))
    torch.testing.assert_close(workspace.normalise(workspace.centre[None]), torch.zeros(1, 3))
    step = torch.tensor([[0.1, 0.2, 0.3]])
    once = workspace.normalise(workspace.centre + step)
    torch.testing.assert_close(workspace.normalise(workspace.centre + scale * step), scale * once)

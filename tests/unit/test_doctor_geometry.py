"""Views of one ray-cast world agree; another calibration convention is recognised; depth between pixels is exact."""

from collections.abc import Callable

import numpy as np
import pytest
from helpers.scene import RIG, episode, ray_cast

from dataset_tools.doctor.calibration import evenly, on_tool
from dataset_tools.doctor.findings import Severity
from dataset_tools.doctor.geometry import (
    DepthView,
    Instant,
    converted,
    depth_at,
    inverted,
    turned,
    views_apart,
    views_disagree,
)
from lerobot_histmv import keys


@pytest.fixture(scope="module")
def instants() -> list[Instant]:
    frames = episode(RIG, 5, 0)
    return [
        [
            DepthView(
                camera,
                frame[keys.depth_key(camera)][..., 0] / 1000,
                RIG.intrinsics,
                frame[keys.EXTRINSICS].reshape(-1, 3, 4)[i].astype(float),
            )
            for i, camera in enumerate(RIG.cameras)
        ]
        for frame in frames
    ]


def test_views_of_one_world_agree(instants: list[Instant]) -> None:
    assert views_disagree(instants, 0) + views_apart(instants, 0) == []


@pytest.mark.parametrize(
    ("convert", "named"), [(inverted, "T_cam_world is stored instead"), (turned, "camera axes are those of OpenGL")]
)
def test_calibration_in_another_convention_is_recognised(
    instants: list[Instant], convert: Callable[[np.ndarray], np.ndarray], named: str
) -> None:
    stored = converted(instants, convert)
    found = views_disagree(stored, 0) + views_apart(stored, 0)
    assert found
    assert all(named in finding.message for finding in found)


@pytest.mark.parametrize(("metres", "severity"), [(0.013, Severity.WARNING), (0.1, Severity.ERROR)])
def test_the_distance_of_two_views_is_measured(instants: list[Instant], metres: float, severity: Severity) -> None:
    up = np.zeros((3, 4))
    up[2, 3] = metres
    moved = [
        [
            DepthView(v.camera, v.depth, v.intrinsics, v.extrinsics + up * (v.camera == "side"))
            for v in instant
            if v.camera != "wrist"
        ]
        for instant in instants
    ]
    (finding,) = views_disagree(moved, 0)
    assert (finding.camera, finding.severity) == ("front, side", severity)
    assert float(finding.message.split()[0]) / 100 == pytest.approx(metres, rel=1.0)


def test_depth_between_pixels_is_exact_on_a_plane() -> None:
    plane = np.array([[1.0, 0, 0, 0], [0, -0.6, -0.8, 0], [0, 0.8, -0.6, 1.0]])
    _, depth = ray_cast(RIG, plane, np.array([9.0, 9.0, 9.0]))
    fx, fy, cx, cy = RIG.intrinsics
    pixels = np.random.default_rng(0).uniform([0, 17], [36, 28], (101, 2))
    rays = np.column_stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(101)]) @ plane[:, :3].T
    floor = -1.0 / rays[:, 2]
    clear = np.abs(rays * floor[:, None] - [0.5, -0.2, -1.0])[:, :2].max(axis=1) > 0.4  # away from the box
    clear &= floor < 2.4  # the floor ends at 3 m
    assert clear.sum() > 20
    np.testing.assert_allclose(depth_at(depth[..., 0] / 1000, pixels)[clear], floor[clear], atol=0.002)


def test_depth_beside_invalid_pixels_is_unknown() -> None:
    depth = np.ones((3, 5))
    depth[1, 2] = 0
    found = depth_at(depth, np.array([[1.5, 0.5], [2.0, 1.0], [0.0, 0.0], [4.0, 2.0], [3.5, 1.9]]))
    assert np.isnan(found).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("name", "expected"), [("wrist", True), ("left_hand_cam", True), ("front", False), ("handle_side", False)]
)
def test_cameras_on_the_tool_are_told_by_name(name: str, expected: bool) -> None:
    assert on_tool(name) is expected


@pytest.mark.parametrize(
    ("length", "count", "expected"), [(11, 3, [0, 5, 10]), (2, 7, [0, 1]), (1, 3, [0]), (5, 1, [0])]
)
def test_frames_are_spread_evenly(length: int, count: int, expected: list[int]) -> None:
    assert evenly(length, count) == expected

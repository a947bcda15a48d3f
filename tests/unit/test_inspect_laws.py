"""Laws of the inspection's pictures: the drawn tool is where a pinhole camera sees it, the errors are those that
keyframing counts, and the merged cloud of a plane lies on the plane.
"""

import numpy as np
import pytest

from dataset_tools.inspect.cameras import CameraView, merged_cloud
from dataset_tools.inspect.episodes import Episode, KeyPose, Motion, Observation
from dataset_tools.inspect.panels import PANELS, left_out
from dataset_tools.inspect.paths import draw_errors
from dataset_tools.inspect.views import NEXT, TOOL, TRIAD, draw_projections, tool_triad
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.signals import Trajectory
from lerobot_histmv.geometry import matrix_from_quaternion

HEIGHT, WIDTH = 17, 23
INTRINSICS = np.array([29.0, 31.0, 10.5, 8.25])
LOOKING_DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
HALF_TURN_ABOUT_X = np.array([0.0, 1.0, 0.0, 0.0])


def looking_down(x: float, y: float, z: float, tilt: float = 0.0) -> np.ndarray:
    """``T_world_cam`` of a camera over the table, tilted about the world's y axis."""
    c, s = np.cos(tilt), np.sin(tilt)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.hstack([turn @ LOOKING_DOWN, [[x], [y], [z]]])


def pinhole(point: np.ndarray, x: float, y: float, z: float) -> tuple[float, float]:
    """Where an untilted camera at (x, y, z) that looks down sees a world point, written out."""
    fx, fy, cx, cy = INTRINSICS
    ahead = z - point[2]
    return fx * (point[0] - x) / ahead + cx, fy * (y - point[1]) / ahead + cy


def view(world_from_cam: np.ndarray | None, depth: np.ndarray | None = None) -> CameraView:
    color = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    return CameraView(color, depth, None if world_from_cam is None else INTRINSICS, world_from_cam)


def episode_seen_by(views: dict[str, CameraView], tool: np.ndarray, following: np.ndarray) -> Episode:
    """Two keyframes: the tool is at ``tool`` and goes to ``following``."""
    poses = [KeyPose("start", tool, HALF_TURN_ABOUT_X), KeyPose("end", following, HALF_TURN_ABOUT_X)]
    return Episode(3, "lift", poses, [Observation(0.0, tool, HALF_TURN_ABOUT_X, views)], None, False, [])


def drawn(figure_axes: object, name: str) -> np.ndarray:
    """Points of the line called ``name`` (n, 2)."""
    (line,) = [line for line in figure_axes.lines if line.get_gid() == name]  # type: ignore[attr-defined]
    return np.asarray(line.get_xydata())


def test_the_tool_is_drawn_where_each_pinhole_camera_sees_it() -> None:
    tool, following = np.array([0.41, 0.02, 0.13]), np.array([0.37, -0.05, 0.02])
    places = {"front": (0.43, 0.01, 0.7), "side": (0.35, -0.03, 1.1)}
    figure = draw_projections(
        episode_seen_by({name: view(looking_down(*place)) for name, place in places.items()}, tool, following)
    )
    for axes, place in zip(figure.axes, places.values(), strict=True):
        np.testing.assert_allclose(drawn(axes, TOOL)[0], pinhole(tool, *place), atol=1e-9)
        np.testing.assert_allclose(drawn(axes, NEXT)[1], pinhole(following, *place), atol=1e-9)
        assert not axes.texts or "outside" not in axes.texts[-1].get_text()
        assert axes.get_xlim() == (-0.5, WIDTH - 0.5)
        assert axes.get_ylim() == (HEIGHT - 0.5, -0.5)


def test_a_tool_behind_or_beside_the_picture_is_said_to_be_outside() -> None:
    tool, following = np.array([0.41, 0.02, 0.13]), np.array([0.37, -0.05, 0.02])
    views = {"below": view(looking_down(0.4, 0, 0.1)), "far": view(looking_down(3.0, 0, 0.7)), "bare": view(None)}
    figure = draw_projections(episode_seen_by(views, tool, following))
    assert [axes.get_title() for axes in figure.axes] == ["below", "far"]
    assert all(axes.texts[-1].get_text() == "tool outside this view" for axes in figure.axes)
    assert np.isnan(drawn(figure.axes[0], TOOL)).all()


def test_the_triad_is_three_centimetres_along_the_tools_axes() -> None:
    observation = Observation(0.0, np.array([0.4, 0.1, 0.2]), np.array([0.5, 0.5, -0.5, 0.5]), {})
    triad = tool_triad(observation)
    axes = (triad[:, 1] - triad[:, 0]) / TRIAD
    assert TRIAD == 0.03
    np.testing.assert_allclose(axes.T, matrix_from_quaternion(observation.quaternion), atol=1e-12)


def wandering(frames: int) -> Trajectory:
    """A curved path with a rest, at which the gripper closes, in the middle."""
    time = np.linspace(0, 3, frames)
    moving = np.stack([0.2 * np.sin(2 * time), 0.2 * np.cos(time), 0.1 * time], axis=-1)
    middle, rest = frames // 2, frames // 5
    position = np.concatenate([moving[:middle], np.repeat(moving[middle : middle + 1], rest, 0), moving[middle:]])
    gripper = (np.arange(len(position)) < middle + 2).astype(np.float64)
    return Trajectory(position, fps=20.0, gripper=gripper)


def distance_to_segment(point: np.ndarray, start: np.ndarray, stop: np.ndarray) -> float:
    share = np.linspace(0, 1, 20_001)[:, None]
    return float(np.linalg.norm(start + share * (stop - start) - point, axis=-1).min())


def test_every_moving_frame_has_its_distance_and_rests_have_none() -> None:
    trajectory = wandering(331)
    options = KeyframeOptions(method="uniform", most=7, nodes=29)
    found = extract(trajectory, options)
    motion = Motion.of(trajectory, found.keyframes, options)
    assert len(motion.errors) == len(trajectory) > 5 * options.nodes
    resting = np.zeros(len(trajectory), bool)
    for keyframe in found.keyframes:
        resting[keyframe.pose_frame + 1 : keyframe.observation_frame + 1] = True
    assert resting.sum() > 50
    np.testing.assert_array_equal(np.isnan(motion.errors), resting)
    assert np.nanmean(motion.errors) == pytest.approx(found.error_mean, rel=1e-12)
    assert np.nanmax(motion.errors) == pytest.approx(found.error_max, rel=1e-12)
    poses = [keyframe.pose_frame for keyframe in found.keyframes]
    for frame in np.flatnonzero(~resting)[::37]:
        after = max(1, int(np.searchsorted(poses, frame)))
        start, stop = trajectory.position[poses[after - 1]], trajectory.position[poses[after]]
        wanted = distance_to_segment(trajectory.position[frame], start, stop)
        assert motion.errors[frame] == pytest.approx(wanted, abs=1e-7)
    poses_drawn = [KeyPose(one.reason, trajectory.position[one.pose_frame]) for one in found.keyframes]
    line = draw_errors(Episode(0, "", poses_drawn, [], motion, False, [])).axes[0].lines[0]
    np.testing.assert_allclose(line.get_ydata(), 1000 * motion.errors)


def depth_of_plane(height: float, world_from_cam: np.ndarray) -> np.ndarray:
    """Depth image [mm] of the plane z = ``height``, one pixel of it without a measurement."""
    fx, fy, cx, cy = INTRINSICS
    v, u = np.indices((HEIGHT, WIDTH))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones((HEIGHT, WIDTH))], axis=-1)
    depth = (height - world_from_cam[2, 3]) / (rays @ world_from_cam[2, :3])
    millimetres = np.rint(1000 * depth).astype(np.uint16)
    millimetres[5, 7] = 0
    return millimetres


def test_a_plane_seen_by_two_cameras_merges_into_one_plane() -> None:
    height = 0.11
    right, left = looking_down(0.4, 0.1, 0.8), looking_down(0.2, -0.1, 0.6, tilt=0.3)
    views = {"right": view(right, depth_of_plane(height, right)), "left": view(left, depth_of_plane(height, left))}
    cloud = merged_cloud(views | {"bare": view(None)})
    assert cloud is not None
    assert cloud.cameras == ["right", "left"]
    assert np.bincount(cloud.camera).tolist() == [HEIGHT * WIDTH - 1] * 2
    assert np.abs(cloud.points[:, 2] - height).max() < 1e-3
    wrong = merged_cloud(views | {"left": view(looking_down(0.2, -0.1, 0.6, tilt=0.35), views["left"].depth)})
    assert wrong is not None
    assert np.abs(wrong.points[wrong.camera == 1, 2] - height).max() > 5e-3


def test_what_is_lacking_is_left_out_with_a_reason() -> None:
    tool = np.array([0.41, 0.02, 0.13])
    depth = np.ones((HEIGHT, WIDTH), np.uint16)
    camera = looking_down(0.4, 0, 1)
    cases = {
        ("errors",): view(camera, depth),
        ("errors", "cloud"): view(camera),
        ("errors", "projections", "cloud"): view(None, depth),
    }
    for names, one in cases.items():
        episode = episode_seen_by({"front": one}, tool, tool)
        assert tuple(panel.name for panel in PANELS if panel.lacking(episode)) == names
        assert len(left_out(episode)) == len(names)
    assert "depth images" in left_out(episode_seen_by({"front": view(camera)}, tool, tool))[1]
    some = episode_seen_by({"front": view(camera, depth), "side": view(None, depth)}, tool, tool)
    assert left_out(some)[1].startswith("no calibration for side")
    larger = view(camera, np.ones((2 * HEIGHT, WIDTH), np.uint16))
    assert "as large as" in left_out(episode_seen_by({"front": larger}, tool, tool))[1]
    assert [panel.name for panel in PANELS if panel.lacking(episode_seen_by({}, tool, tool))] == [
        *("errors", "keyframes", "projections", "cloud")
    ]

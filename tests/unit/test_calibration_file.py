"""A calibration written by hand is taken as written, or refused with what is wrong and what would be accepted."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dataset_tools.calibrate.file import read_calibrations

SIZES = {"front": (23, 29), "wrist": (23, 29)}
TURN = Rotation.from_rotvec([0.3, -1.1, 2.0])
POSE = np.column_stack([TURN.as_matrix(), [0.1, 0.2, 0.7]])


def entry(**changes: Any) -> dict[str, Any]:
    """A correct entry, changed; a change to None leaves the key out."""
    whole = {"fx": 31.0, "fy": 32.0, "cx": 14.0, "cy": 11.0, "T_world_cam": POSE.tolist()} | changes
    return {key: value for key, value in whole.items() if value is not None}


def write(folder: Path, content: Any) -> Path:
    path = folder / "cameras.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    "pose",
    [
        POSE.tolist(),
        [*POSE.tolist(), [0, 0, 0, 1]],
        {"position": POSE[:, 3].tolist(), "quaternion_xyzw": TURN.as_quat().tolist()},
        {"position": POSE[:, 3].tolist(), "quaternion_wxyz": TURN.as_quat(scalar_first=True).tolist()},
    ],
)
def test_every_spelling_of_a_pose_is_the_same(tmp_path: Path, pose: Any) -> None:
    found = read_calibrations(write(tmp_path, {"wrist": entry(T_world_cam=pose)}), SIZES)
    assert list(found) == ["wrist"]
    assert found["wrist"].intrinsics.tolist() == [31, 32, 14, 11]
    assert found["wrist"].pose == pytest.approx(POSE)
    assert found["wrist"].extrinsics(None, 2) == pytest.approx(np.stack([POSE.ravel()] * 2))


def test_a_camera_on_the_tool_moves_with_it(tmp_path: Path) -> None:
    mounted = entry(T_world_cam=None, mounted_on="tool", T_tool_cam=POSE.tolist())
    found = read_calibrations(write(tmp_path, {"wrist": mounted}), SIZES)["wrist"]
    tools = np.concatenate([Rotation.random(3, rng=7).as_matrix(), np.full((3, 3, 1), 0.5)], axis=-1)
    for tool, row in zip(tools, found.extrinsics(tools, 3), strict=True):
        point = np.array([0.1, -0.2, 0.9])
        in_tool = POSE[:, :3] @ point + POSE[:, 3]
        in_world = tool[:, :3] @ in_tool + tool[:, 3]
        assert row.reshape(3, 4) @ np.append(point, 1) == pytest.approx(in_world)


def test_numbers_that_yaml_takes_for_text_are_read(tmp_path: Path) -> None:
    text = "front: {fx: 3e1, fy: 30, cx: 14, cy: 11, T_world_cam: [[1, 0, 0, 1e-3], [0, 1, 0, 0], [0, 0, 1, 0]]}"
    found = read_calibrations(write(tmp_path, text), SIZES)["front"]
    assert (found.intrinsics[0], found.pose[0, 3]) == (30, 0.001)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"top": entry()}, r"top are no cameras .* those are front, wrist"),
        ({"front": entry(fx=-31.0)}, r"fx, fy are -31, 32; focal lengths must be positive"),
        ({"front": entry(cx=29.0)}, r"cx is 29, outside of the image, which is 29 x 23"),
        ({"front": entry(cy=-3)}, r"cy is -3, outside"),
        ({"front": entry(cy="high")}, r"are no numbers"),
        ({"front": entry(fx=float("nan"))}, r"must be finite"),
        ({"front": entry(T_world_cam=(1.1 * POSE).tolist())}, r"R R' is off the identity by 0.21"),
        ({"front": entry(T_world_cam=(POSE * [-1, 1, 1, 1]).tolist())}, r"mirrors"),
        ({"front": entry(T_world_cam=POSE.T.tolist())}, r"must be 4 numbers"),
        ({"front": entry(T_world_cam=[*POSE.tolist(), [0, 0, 0, 2]])}, r"0 0 0 1"),
        ({"front": entry(T_world_cam=[1, 2, 3])}, r"must be 4 numbers"),
        ({"front": entry(T_world_cam={"position": [0, 0, 0], "quaternion": [1, 0, 0, 0]})}, r"quaternion_wxyz or"),
        ({"front": entry(T_world_cam={"position": [0, 0, 0], "quaternion_wxyz": [1, 1, 0, 0]})}, r"its norm must be 1"),
        ({"front": entry(fy=None)}, r"missing are \['fy'\]"),
        ({"front": entry(k1=0.1)}, r"not understood \['k1'\]"),
        ({"front": entry(mounted_on="hand")}, r"mounted_on is 'hand'; it must be 'tool'"),
        ({"front": entry(mounted_on="tool")}, r"missing are \['T_tool_cam'\], not understood \['T_world_cam'\]"),
        ({"front": [1, 2]}, r"front must have fx"),
        ([], r"entry per camera; cameras are front, wrist"),
        ("front: !!python/object/apply:os.system ['true']", r"is no YAML"),
        ("front: [", r"is no YAML"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_calibrations(write(tmp_path, content), SIZES)

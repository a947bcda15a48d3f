"""Finding position, rotation and gripper in a dataset's columns: ours, others', unnamed ones, and ambiguous ones."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from dataset_tools.column_guesses import resolve
from dataset_tools.columns import Column, ColumnsConfig
from lerobot_histmv import keys

JOINTS = [f"joint_{i}.pos" for i in range(6)]


def features(**vectors: Sequence[str] | int | Mapping[str, list[str]]) -> dict[str, dict[str, Any]]:
    """LeRobot features; ``__`` in an argument stands for a dot, a number for that many unnamed entries."""
    found = {}
    for key, names in vectors.items():
        count = (
            names
            if isinstance(names, int)
            else sum(map(len, names.values()))
            if isinstance(names, Mapping)
            else len(names)
        )
        found[key.replace("__", ".")] = {
            "dtype": "float32",
            "shape": (count,),
            "names": None if isinstance(names, int) else names,
        }
    return found


OURS = features(observation__state=[*keys.POSE_NAMES, *JOINTS], action=list(keys.POSE_NAMES))


def test_our_own_names_need_no_option() -> None:
    found = resolve(OURS, ColumnsConfig())
    assert found.curve == Column(keys.STATE, (0, 1, 2), keys.POSITION_NAMES)
    assert found.rotation == Column(keys.STATE, (3, 4, 5, 6), keys.QUATERNION_NAMES)
    assert found.rotation_format == "wxyz"
    assert found.gripper == Column(keys.ACTION, (7,), (keys.GRIPPER_NAME,))
    assert found.gripper_range == (0, 1)
    assert found.commanded is not None
    assert resolve(OURS, ColumnsConfig(commanded=False)).commanded is None


def test_a_quaternion_named_in_another_order_is_put_in_ours() -> None:
    names = ["ee.x.pos", "ee.y.pos", "ee.z.pos", "ee.qx.pos", "ee.qy.pos", "ee.qz.pos", "ee.qw.pos"]
    found = resolve(features(observation__state=names), ColumnsConfig())
    assert found.rotation is not None
    assert found.rotation.indices == (6, 3, 4, 5)


@pytest.mark.parametrize(
    ("names", "position", "rotation", "rotation_format"),
    [
        (["x", "y", "z", "roll", "pitch", "yaw", "gripper"], (0, 1, 2), (3, 4, 5), "rpy"),
        (["gripper", "tcp_z", "tcp_y", "tcp_x"], (3, 2, 1), None, ""),
        (["obj_x", "obj_y", "obj_z", "eef_x", "eef_y", "eef_z"], (3, 4, 5), None, ""),
        (["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"], (0, 1, 2), (3, 4, 5), "rotvec"),
        (["px", "py", "pz", "quat_x", "quat_y", "quat_z", "quat_w"], (0, 1, 2), (6, 3, 4, 5), "wxyz"),
        (["vel_x", "vel_y", "vel_z", "x", "y", "z"], (3, 4, 5), None, ""),
        ({"motors": ["x", "y", "z"]}, (0, 1, 2), None, ""),
    ],
)
def test_common_names_are_understood(
    names: Any, position: tuple[int, ...], rotation: tuple[int, ...] | None, rotation_format: str
) -> None:
    found = resolve(features(observation__state=names), ColumnsConfig())
    assert found.curve.indices == position
    assert (found.rotation.indices if found.rotation else None, found.rotation_format) == (rotation, rotation_format)


def test_a_feature_of_its_own_may_hold_the_position() -> None:
    found = resolve(features(observation__state=6, observation__ee_pos=3, action=7), ColumnsConfig())
    assert found.curve == Column("observation.ee_pos", (0, 1, 2))
    assert found.rotation is None
    assert found.gripper is None


@pytest.mark.parametrize(
    ("vectors", "feature", "index"),
    [
        ({"observation__state": ["x", "y", "z", "gripper"], "action": [*JOINTS, "gripper"]}, keys.ACTION, 6),
        ({"observation__state": ["x", "y", "z", "gripper_width"], "action": JOINTS}, keys.STATE, 3),
        ({"observation__state": ["x", "y", "z"], "observation__gripper": 1, "action": 6}, "observation.gripper", 0),
    ],
    ids=["command before measurement", "measurement", "a feature of its own"],
)
def test_the_gripper_is_the_command_if_there_is_one(vectors: dict[str, Any], feature: str, index: int) -> None:
    found = resolve(features(**vectors), ColumnsConfig())
    assert found.gripper is not None
    assert (found.gripper.feature, found.gripper.indices) == (feature, (index,))
    assert found.gripper_range is None


def test_two_arms_or_two_grippers_are_a_question_to_the_user() -> None:
    arms = [f"{side}_ee_{axis}" for side in ("left", "right") for axis in "xyz"]
    with pytest.raises(ValueError, match=r"left_ee_x.*right_ee_x.*--columns\.position"):
        resolve(features(observation__state=arms), ColumnsConfig())
    grippers = features(observation__state=["x", "y", "z"], action=["left_gripper", "right_gripper"])
    with pytest.raises(ValueError, match=r"left_gripper or .*right_gripper.*--columns\.gripper"):
        resolve(grippers, ColumnsConfig())
    chosen = resolve(grippers, ColumnsConfig(gripper="action:right_gripper"))
    assert chosen.gripper == Column(keys.ACTION, (1,), ("right_gripper",))
    assert resolve(grippers, ColumnsConfig(gripper="none")).gripper is None


def test_without_a_tool_position_the_message_lists_what_there_is_and_both_ways_on() -> None:
    joints = features(observation__state=[*JOINTS, "gripper.pos"], action=[*JOINTS, "gripper.pos"])
    with pytest.raises(ValueError, match=r"joint_0\.pos.*--columns\.position.*--columns\.joints.*radians"):
        resolve(joints, ColumnsConfig())
    found = resolve(joints, ColumnsConfig(joints="observation.state:0:6"))
    assert found.is_joints
    assert found.curve.names == tuple(JOINTS)
    assert found.rotation is None


def test_columns_may_be_told_by_slice_index_names_or_as_a_whole() -> None:
    plain = features(observation__state=8, observation__tool=3, action=["a", "b", "c", "d"])
    told = resolve(plain, ColumnsConfig(position="observation.tool", gripper="observation.state:7"))
    assert told.curve.indices == (0, 1, 2)
    assert told.gripper == Column(keys.STATE, (7,))
    assert resolve(plain, ColumnsConfig(position="observation.state:1:4")).curve.indices == (1, 2, 3)
    assert resolve(plain, ColumnsConfig(position="action:d,a,b")).curve == Column("action", (3, 0, 1), ("d", "a", "b"))


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ("observation.stat:0:3", "no such vector; there are observation.state"),
        ("observation.state:6:9", "start:stop, one index, or names"),
        ("observation.state:x,y,z", "start:stop, one index, or names"),
        ("observation.state:0:2", "must be x, y, z"),
    ],
)
def test_a_column_that_does_not_exist_is_told_what_does(position: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        resolve(features(observation__state=8), ColumnsConfig(position=position))


def test_an_unnamed_rotation_needs_its_format() -> None:
    plain = features(observation__state=8)
    told = {"position": "observation.state:0:3", "rotation": "observation.state:3:7"}
    with pytest.raises(ValueError, match=r"do not tell the order.*rotation_format.*wxyz, xyzw"):
        resolve(plain, ColumnsConfig(**told))
    assert resolve(plain, ColumnsConfig(**told, rotation_format="xyzw")).rotation_format == "xyzw"
    with pytest.raises(ValueError, match="4 entries; rotvec has 3"):
        resolve(plain, ColumnsConfig(**told, rotation_format="rotvec"))


def test_a_named_rotation_that_is_told_needs_no_format() -> None:
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    found = resolve(features(observation__state=names), ColumnsConfig(rotation="observation.state:3:7"))
    assert found.rotation is not None
    assert (found.rotation.indices, found.rotation_format) == ((6, 3, 4, 5), "wxyz")
    assert resolve(features(observation__state=names), ColumnsConfig(rotation="none")).rotation is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"position": "a:0:3", "joints": "a:0:6"}, "exclude each other"),
        ({"rotation": "a:3:7", "rotation_format": "zyx"}, "must be one of wxyz, xyzw, rotvec, rpy"),
        ({"rotation_format": "xyzw"}, "give both"),
        ({"gripper_range": [1.0, 1.0]}, "two different numbers"),
        ({"gripper_range": [1.0]}, "two different numbers"),
    ],
)
def test_options_that_contradict_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ColumnsConfig(**wrong)

"""``histmv keyframe`` on datasets that are not ours: video, RGB only, other cameras, states and forms of depth."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.episodes import Frame, dense_features, image_feature, pick, vector_feature, with_cameras, write
from lerobot.datasets import LeRobotDataset
from scipy.spatial.transform import Rotation

from dataset_tools.columns import ColumnsConfig
from dataset_tools.keyframe import KeyframeConfig, OutputConfig, SourceConfig, run
from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.geometry import canonical

SIZE = (64, 96)
SHORT = 29
"""Frames of the first episode."""
RGB, DEPTH = "observation.images.top", "observation.images.top_depth"
ARM = ("waist", "shoulder", "elbow", "gripper")


def keyframed(dense: Path, **options: Any) -> LeRobotDataset:
    output = OutputConfig("test/keys", dense.parent / "keys")
    run(KeyframeConfig(SourceConfig("test/dense", dense), output, **options))
    return LeRobotDataset("test/keys", root=dense.parent / "keys")


def notices(dataset: LeRobotDataset) -> str:
    return "\n".join(json.loads((dataset.root / keys.KEYFRAMING_FILE).read_text())["notices"])


def frames_with(**columns: np.ndarray) -> list[Frame]:
    """Frames out of columns; ``__`` in a name stands for a dot."""
    named = {key.replace("__", "."): column for key, column in columns.items()}
    count = min(len(column) for column in named.values())
    return [{key: column[i] for key, column in named.items()} for i in range(count)]


def smooth_images(count: int, channels: int) -> np.ndarray:
    """Images that a video codec keeps well: a moving gradient."""
    v, u = np.indices(SIZE)
    return np.stack([np.stack([(u + v + 2 * i + 50 * c) % 256 for c in range(channels)], -1) for i in range(count)])


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """RGB and depth as video, a state of another layout, a delta action, and a column that is neither."""
    motion = pick(np.random.default_rng(0))
    count = len(motion["position"])
    depth = (500 + smooth_images(count, 1)).astype(np.uint16)
    depth[:, :5] = 0
    state = np.hstack([0.08 * motion["gripper"][:, None], motion["position"]]).astype(np.float32)
    features = {
        RGB: image_feature(3, "video", SIZE),
        DEPTH: {**image_feature(1, "video", SIZE), "info": {"is_depth_map": True}},
        keys.STATE: vector_feature(("gripper_width", "tcp_x", "tcp_y", "tcp_z")),
        keys.ACTION: vector_feature(("delta_x", "delta_y", "delta_z")),
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    }
    frames = frames_with(
        **{RGB: smooth_images(count, 3).astype(np.uint8), DEPTH: depth},
        observation__state=state,
        action=np.zeros((count, 3), np.float32),
        next__reward=np.zeros((count, 1), np.float32),
    )
    return write(tmp_path_factory.mktemp("video") / "dense", [frames[:SHORT], frames], features, paraphrases=False)


@pytest.fixture(scope="module")
def video_keys(video: Path) -> LeRobotDataset:
    return keyframed(video)


def test_video_becomes_the_same_images(video: Path, video_keys: LeRobotDataset) -> None:
    source = LeRobotDataset("test/dense", root=video, video_backend="pyav")
    assert video_keys.features[RGB]["dtype"] == "image"
    for row in video_keys:
        seen = source[SHORT * int(row[keys.SOURCE_EPISODE]) + int(row[keys.SOURCE_FRAME])]
        assert torch.equal((255 * row[RGB]).round(), (255 * seen[RGB]).round())
        assert torch.equal(row[keys.STATE], seen[keys.STATE])


def test_depth_video_becomes_millimetres_with_zero_where_nothing_was_measured(
    video: Path, video_keys: LeRobotDataset
) -> None:
    source = LeRobotDataset("test/dense", root=video, video_backend="pyav")
    assert video_keys.features[DEPTH] == {
        **image_feature(1, size=SIZE),
        "info": {"is_depth_map": True, "depth_unit": "mm"},
    }
    for row in video_keys:
        seen = source[SHORT * int(row[keys.SOURCE_EPISODE]) + int(row[keys.SOURCE_FRAME])][DEPTH]
        assert (row[DEPTH][:, :5] == 0).all()
        assert (row[DEPTH][:, 5:] - seen[:, 5:]).abs().max() <= 0.5


def test_other_layouts_give_labels_of_what_there_is_and_say_what_is_missing(video_keys: LeRobotDataset) -> None:
    motion = pick(np.random.default_rng(0))
    assert video_keys.features[keys.ACTION]["names"] == [*keys.POSITION_NAMES, keys.GRIPPER_NAME]
    action = video_keys[0][keys.ACTION].numpy()
    np.testing.assert_allclose(action[:3], motion["position"][13], atol=1e-6)
    assert action[3] == 0
    said = notices(video_keys)
    for part in (
        f"lacks {keys.INTRINSICS}, {keys.EXTRINSICS}, a tool rotation",
        "read from observation.state:gripper_width, which may lag",
        "closed at 0 and open at 0.08",
        "not kept: next.reward",
        "each task's text is its only instruction",
    ):
        assert part in said


def test_a_damaged_video_is_named(video: Path, tmp_path: Path) -> None:
    dense = shutil.copytree(video, tmp_path / "dense")
    (path,) = dense.glob(f"videos/{RGB}/*/*.mp4")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match=rf"episode 0: cannot read frames \[0.*\] of {RGB} in .*mp4"):
        keyframed(dense)
    assert not (tmp_path / "keys").exists()


def arm_frames(count: int = 31) -> list[Frame]:
    angles = np.stack([np.sin(np.linspace(0, rate, count)) for rate in (0.5, 1.0, 1.7)], axis=-1)
    gripper = np.where(np.arange(count) < 11, 100.0, 3.0)[:, None]
    values = np.hstack([angles, gripper]).astype(np.float32)
    return frames_with(observation__state=values, action=values)


def test_text_matrices_and_integers_of_an_observation_are_kept(tmp_path: Path) -> None:
    features = ARM_FEATURES | {
        "observation.note": {"dtype": "string", "shape": (1,), "names": None},
        "observation.frame_of_tool": {"dtype": "float32", "shape": (2, 3), "names": None},
        "observation.contact": {"dtype": "int64", "shape": (1,), "names": None},
    }
    frames = [
        {
            **frame,
            "observation.note": f"frame {i}",
            "observation.frame_of_tool": np.arange(6, dtype=np.float32).reshape(2, 3) + i,
            "observation.contact": np.array([i % 2]),
        }
        for i, frame in enumerate(arm_frames())
    ]
    dense = write(tmp_path / "dense", [frames], features, paraphrases=False)
    rows = keyframed(dense, columns=ColumnsConfig(joints="observation.state:0:3"), epsilon=0.01)
    for row in rows:
        frame = int(row[keys.SOURCE_FRAME])
        assert row["observation.note"] == f"frame {frame}"
        assert row["observation.frame_of_tool"].tolist() == frames[frame]["observation.frame_of_tool"].tolist()
        assert int(row["observation.contact"]) == frame % 2


ARM_FEATURES = {keys.STATE: vector_feature(ARM), keys.ACTION: vector_feature(ARM)}


def test_joint_space_data_is_keyframed_over_its_joints_when_told_so(tmp_path: Path) -> None:
    dense = write(tmp_path / "dense", [arm_frames()], ARM_FEATURES, paraphrases=False)
    with pytest.raises(ValueError, match=r"no tool position found in .*waist.*--columns\.joints"):
        keyframed(dense)
    rows = keyframed(dense, columns=ColumnsConfig(joints="observation.state:0:3"), epsilon=0.01)
    assert rows.features[keys.ACTION]["names"] == ["waist", "shoulder", "elbow", keys.GRIPPER_NAME]
    told = json.loads((rows.root / keys.KEYFRAMING_FILE).read_text())
    assert told["unit"] == "rad"
    assert "errors and epsilon count radians" in notices(rows)
    frames = [keyframe["pose_frame"] for keyframe in told["episodes"][0]["keyframes"]]
    assert 11 in frames
    expected = np.array([frame[keys.STATE][:3] for frame in arm_frames()])[frames[1:]]
    np.testing.assert_allclose(np.stack([row[keys.ACTION].numpy()[:3] for row in rows]), expected)
    assert [float(row[keys.ACTION][3]) for row in rows] == [float(frame < 11) for frame in frames[1:]]


DEPTH_FEATURES = {
    DEPTH: {**image_feature(1), "info": {"is_depth_map": True}},
    keys.STATE: vector_feature(("x", "y", "z")),
    keys.ACTION: vector_feature(("x", "y", "z")),
}


def depth_frames(spoil: float | None = None) -> list[Frame]:
    position = np.linspace([0.1, 0, 0], [0.5, 0.2, 0], 7).astype(np.float32)
    depth = np.random.default_rng(0).uniform(0.2, 2, (7, 17, 19, 1)).astype(np.float32)
    depth[:, 0] = 0
    depth[:, 1] = 70
    if spoil is not None:
        depth[0, 3, 5] = spoil
    return frames_with(**{DEPTH: depth}, observation__state=position, action=position)


def test_depth_in_metres_becomes_millimetres(tmp_path: Path) -> None:
    rows = keyframed(write(tmp_path / "dense", [depth_frames()], DEPTH_FEATURES, paraphrases=False))
    depth = rows[0][DEPTH][0].numpy()
    expected = 1000 * depth_frames()[0][DEPTH][..., 0]
    np.testing.assert_allclose(depth[2:], expected[2:], atol=0.5)
    assert (depth[:2] == 0).all()
    assert rows.features[DEPTH]["info"]["depth_unit"] == "mm"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0])
def test_depth_that_is_no_distance_is_named(tmp_path: Path, value: float) -> None:
    dense = write(tmp_path / "dense", [depth_frames(value)], DEPTH_FEATURES, paraphrases=False)
    with pytest.raises(ValueError, match=rf"episode 0, frame 0: {DEPTH} holds {value}; depth must be finite"):
        keyframed(dense)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dense"]


ROTVEC_STATE = ("temperature", "grip_percent", "tcp_x", "tcp_y", "tcp_z", "tcp_rx", "tcp_ry", "tcp_rz")
TOLD = ColumnsConfig(rotation="observation.state:5:8", rotation_format="rotvec")


def rotvec_arm(root: Path, motion: dict[str, np.ndarray], action: str = "gripper") -> Path:
    """RGB-D and calibration as ours; in the state a rotation vector, and the gripper in percent, 100 being closed."""
    count, chance = len(motion["position"]), np.random.default_rng(1)
    turn = Rotation.from_quat(motion["quaternion"], scalar_first=True).as_rotvec()
    closed = 100 - 80 * motion["gripper"][:, None]
    state = np.hstack([chance.uniform(20, 30, (count, 1)), closed, motion["position"], turn]).astype(np.float32)
    command = 1 - motion["gripper"][:, None].astype(np.float32)
    features = dense_features() | {keys.STATE: vector_feature(ROTVEC_STATE), keys.ACTION: vector_feature((action,))}
    return write(root, [with_cameras(frames_with(observation__state=state, action=command), chance)], features)


@pytest.mark.parametrize(
    ("options", "opened"),
    [({"gripper_range": [1.0, 0.0]}, 1.0), ({"gripper_range": [1.0, 0.0], "opening_range": [100.0, 0.0]}, 0.8)],
    ids=["its range in the data", "told"],
)
def test_a_state_in_another_form_becomes_the_one_that_the_policy_reads(
    options: dict[str, Any], opened: float, tmp_path: Path
) -> None:
    motion = pick(np.random.default_rng(0))
    keys_of = keyframed(rotvec_arm(tmp_path / "dense", motion), columns=replace(TOLD, **options))
    HistMVConfig().set_dataset_feature_metadata(keys_of.features)
    assert keys_of.features[keys.STATE]["names"] == [*keys.POSE_NAMES, "temperature"]
    for row in keys_of:
        frame, state = int(row[keys.SOURCE_FRAME]), row[keys.STATE].numpy()
        np.testing.assert_allclose(state[:3], motion["position"][frame], atol=1e-6)
        np.testing.assert_allclose(state[3:7], canonical(motion["quaternion"][frame]), atol=1e-6)
        np.testing.assert_allclose(state[7], opened * motion["gripper"][frame], atol=1e-6)
        assert 20 <= state[8] <= 30
    assert min(float(row[keys.STATE][7]) for row in keys_of) == 0
    assert "begins with ee.x.pos" in notices(keys_of)
    assert "opening is observation.state:grip_percent, closed at 100" in notices(keys_of)


def test_without_a_measured_gripper_the_opening_is_the_command_before_the_frame(tmp_path: Path) -> None:
    motion = pick(np.random.default_rng(0))
    columns = replace(TOLD, opening="none", gripper_range=[1.0, 0.0])
    keys_of = keyframed(rotvec_arm(tmp_path / "dense", motion), columns=columns)
    openings = {int(row[keys.SOURCE_FRAME]): float(row[keys.STATE][7]) for row in keys_of}
    assert openings == {frame: motion["gripper"][max(frame - 1, 0)] for frame in openings}
    assert set(openings.values()) == {0.0, 1.0}
    assert "no measured gripper is known" in notices(keys_of)


def test_a_measured_gripper_outside_of_its_range_is_named(tmp_path: Path) -> None:
    dense = rotvec_arm(tmp_path / "dense", pick(np.random.default_rng(0)))
    with pytest.raises(ValueError, match=r"grip_percent is 20, but 100 is closed and 50 open.*opening_range"):
        keyframed(dense, columns=replace(TOLD, gripper_range=[1.0, 0.0], opening_range=[100.0, 50.0]))
    assert not (tmp_path / "keys").exists()

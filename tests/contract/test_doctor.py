"""``histmv doctor``: a healthy dataset passes without a finding; each way of breaking it gives exactly its finding.

The healthy dataset is ray-cast (``helpers.scene``); ``BROKEN`` spoils a copy of it once per check.
"""

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.episodes import edit_info, vector_feature, write, write_vector_picks
from helpers.scene import LENGTHS, RIG, STILL, Rig, look_at, write_scene
from helpers.spoiling import (
    FRONT,
    FRONT_DEPTH,
    WRIST_POSE,
    Spoil,
    again,
    as_xyzw,
    both,
    corrupt_pages,
    cut_off,
    depth,
    depth_video,
    encoded,
    feature,
    flip_odd,
    frames,
    freeze,
    hold,
    late,
    lose_row,
    lose_text,
    nearly_blind,
    numbers,
    other_size,
    pictures,
    renamed,
    scaled,
    shifted,
    spoilt_at,
    tool,
    without,
)
from PIL import Image
from rich.console import Console

from dataset_tools.cli import main
from dataset_tools.doctor.command import DoctorConfig, diagnose
from dataset_tools.doctor.findings import CHECKS, Finding, Severity
from dataset_tools.images import encode_rgb
from dataset_tools.keyframe import KeyframeConfig, OutputConfig, SourceConfig
from dataset_tools.keyframe import run as keyframe
from lerobot_histmv import keys


def look(root: Path, **options: Any) -> list[Finding]:
    config = DoctorConfig(SourceConfig("test/scene", root), **options)
    return list(diagnose(config, Console(quiet=True))[0].findings)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene") / "dense")


BLACK = encode_rgb(np.zeros((*RIG.size, 3), np.uint8))
APART = Rig({"front": STILL["front"], "back": look_at((1.5, 0.5, 0.5), (2.2, 0.9, 0.0))}, moving="")
NAMELESS = Rig({"front": STILL["front"], "side": STILL["side"]}, moving="third")
METRES: dict[str, Any] = {"info": {"is_depth_map": True, "depth_unit": "m"}}

BROKEN: list[tuple[str, Spoil]] = [
    ("damaged", cut_off),
    ("damaged", corrupt_pages),
    ("damaged", lambda root: (root / "meta/info.json").write_text('{"fps": ')),
    ("damaged", lambda root: edit_info(root, lambda info: info.update(codebase_version="v2.1"))),
    ("rows", lose_row),
    ("one_frame_episode", frames(list(range(11)), [20])),
    ("instructions_missing", lose_text),
    ("no_camera", again(write_vector_picks)),
    ("depth_missing", without(FRONT_DEPTH)),
    ("depth_picture", feature(FRONT_DEPTH, info=None)),
    ("depth_video", again(depth_video)),
    ("depth_size", other_size),
    ("intrinsics_missing", without(keys.INTRINSICS)),
    ("intrinsics_missing", renamed(keys.INTRINSICS, "front.", "camera_0.")),
    ("extrinsics_missing", without(keys.EXTRINSICS)),
    ("tool_pose_missing", feature(keys.STATE, names=list("abcdefgh"))),
    ("tool_pose_missing", feature(keys.STATE, names=[*keys.POSITION_NAMES, *"abcd", keys.GRIPPER_NAME])),
    ("action_pose_missing", renamed(keys.ACTION, "ee.", "delta_")),
    ("nan", numbers(keys.STATE, spoilt_at(5, 1, np.nan))),
    ("nan", numbers(keys.EXTRINSICS, spoilt_at(5, 1, np.inf))),
    ("time_gap", numbers("timestamp", late)),
    ("tool_jump", frames([*range(5), *range(17, 23)])),
    ("duplicate_rows", frames([i - i % 2 for i in range(23)])),
    ("duplicate_episode", frames(list(range(11)), list(range(12, 23)), list(range(11)))),
    ("quaternion_norm", numbers(keys.STATE, scaled(3, 7, 0.9))),
    ("quaternion_order", tool(as_xyzw)),
    ("quaternion_sign", tool(flip_odd)),
    ("gripper_range", tool(scaled(7, 8, 100.0))),
    ("action_not_reached", numbers(keys.ACTION, scaled(0, 3, 0.1))),
    ("action_not_reached", numbers(keys.ACTION, lambda values: np.copyto(values[:, 3:7], [0, 1, 0, 0]))),
    ("intrinsics_size", numbers(keys.INTRINSICS, scaled(0, 4, 5.0))),
    ("extrinsics_rotation", numbers(keys.EXTRINSICS, lambda values: values.__imul__(1.1))),
    ("extrinsics_constant", numbers(keys.EXTRINSICS, hold(WRIST_POSE))),
    (
        "extrinsics_constant",
        both(again(lambda root: write_scene(root, NAMELESS, (11,))), numbers(keys.EXTRINSICS, hold(WRIST_POSE))),
    ),
    ("image_undecodable", pictures(FRONT, lambda file: file[: len(file) // 2], slice(0, 1))),
    ("image_undecodable", pictures(FRONT_DEPTH, lambda file: b"no image", slice(0, 1))),
    ("rgb_lossy", pictures(FRONT, lambda file: encoded(Image.open(io.BytesIO(file)), "JPEG"))),
    ("image_blank", pictures(FRONT, lambda file: BLACK, slice(0, 1))),
    ("image_frozen", freeze),
    ("depth_unit", depth(lambda image: np.rint(image / 1000).astype(np.uint16))),
    ("depth_unit", both(depth(lambda image: image.astype(np.float32)), feature(FRONT_DEPTH, **METRES))),
    ("nan", depth(lambda image: np.where(np.arange(len(image))[:, None] < 3, np.nan, image).astype(np.float32))),
    ("depth_invalid", depth(nearly_blind)),
    ("tool_outside", tool(shifted(0, 2.0))),
    ("tool_outside", tool(scaled(0, 3, 1000.0))),
    ("views_disagree", numbers(keys.EXTRINSICS, shifted(11, 0.1))),
    ("views_apart", again(lambda root: write_scene(root, APART, (11,)))),
]


def test_every_check_has_a_broken_dataset() -> None:
    assert {check for check, _ in BROKEN} == set(CHECKS)


def test_a_healthy_dataset_passes_without_a_finding(healthy: Path) -> None:
    assert look(healthy) == []


@pytest.mark.parametrize(("check", "spoil"), BROKEN, ids=[f"{check}-{i}" for i, (check, _) in enumerate(BROKEN)])
def test_each_break_gives_exactly_its_finding(check: str, spoil: Spoil, healthy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(healthy, tmp_path / "dense")
    spoil(root)
    found = look(root)
    assert {finding.check for finding in found} == {check}, found
    assert {finding.severity for finding in found} == {CHECKS[check].severity}


def test_a_keyframed_dataset_is_judged_as_one(healthy: Path, tmp_path: Path) -> None:
    root = tmp_path / "keys"
    keyframe(KeyframeConfig(SourceConfig("test/scene", healthy), OutputConfig("test/keys", root), method="exact"))
    assert look(root) == []
    numbers(keys.ACTION, shifted(2, 0.1))(root)
    assert {finding.check for finding in look(root)} == {"action_not_reached"}


def test_a_finding_names_episode_frame_camera_value_and_remedy(healthy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(healthy, tmp_path / "dense")
    numbers(keys.STATE, spoilt_at(LENGTHS[0] + 7, 2, np.nan))(root)
    pictures(FRONT, lambda file: BLACK, slice(0, 1))(root)
    found = {finding.check: finding for finding in look(root)}
    assert (found["nan"].episode, found["nan"].frame) == (1, 7)
    assert "observation.state[ee.z.pos] is nan" in found["nan"].message
    blank = found["image_blank"]
    assert (blank.episode, blank.frame, blank.camera) == (0, 0, "front")
    assert blank.remedy == CHECKS["image_blank"].remedy


ARM = ("waist", "elbow", "gripper")


def foreign(root: Path) -> Path:
    """One unnamed camera and joint angles: nothing of what our policy needs."""
    features = {
        "observation.image": {"dtype": "image", "shape": (17, 19, 3), "names": ["height", "width", "channels"]},
        keys.STATE: vector_feature(ARM),
        keys.ACTION: {"dtype": "float32", "shape": (3,), "names": None},
    }
    rng = np.random.default_rng(0)
    rows = [
        {
            "observation.image": rng.integers(0, 256, (17, 19, 3), np.uint8),
            keys.STATE: np.float32([i, 2 * i, 0]),
            keys.ACTION: np.float32([i, 0, 1]),
        }
        for i in range(7)
    ]
    return write(root, [rows], features, paraphrases=False)


def test_a_foreign_dataset_is_told_what_the_policy_misses_and_is_fine_for_others(tmp_path: Path) -> None:
    root = foreign(tmp_path / "dense")
    missing = {"depth_missing", "intrinsics_missing", "extrinsics_missing", "tool_pose_missing"}
    assert {finding.check: finding.severity for finding in look(root)} == dict.fromkeys(missing, Severity.ERROR)
    assert {f.check: f.severity for f in look(root, policy="any")} == dict.fromkeys(missing, Severity.NOTE)


def doctor(root: Path, *options: str) -> int:
    """Exit code of the command."""
    try:
        main(["doctor", "--dataset.repo_id=test/scene", f"--dataset.root={root}", *options])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_commands_that_contact_keeps_from_being_reached_are_noted(healthy: Path, tmp_path: Path) -> None:
    root = shutil.copytree(healthy, tmp_path / "dense")

    def press(values: np.ndarray) -> None:
        values[1::4, 2] -= 0.05

    numbers(keys.ACTION, press)(root)
    found = look(root)
    assert {(one.check, one.severity) for one in found} == {("action_not_reached", Severity.NOTE)}


def test_the_exit_code_tells_what_is_to_be_mended_and_json_tells_all(
    healthy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, told = shutil.copytree(healthy, tmp_path / "dense"), tmp_path / "told/findings.json"
    assert doctor(root) == 0
    assert "healthy: nothing found in 3 episodes" in capsys.readouterr().out
    tool(flip_odd)(root)
    assert doctor(root) == 1
    assert "to be looked at before training: 6 warnings" in capsys.readouterr().out
    assert doctor(root, "--accept_warnings=true") == 0
    numbers("timestamp", late)(root)
    assert doctor(root, "--accept_warnings=true", f"--json={told}") == 1
    out = capsys.readouterr().out
    assert "not ready for training: 1 error, 6 warnings" in out
    assert "time_gap" in out
    content = json.loads(told.read_text())
    assert content["counts"] == {"error": 1, "warning": 6, "note": 0}
    gap = next(finding for finding in content["findings"] if finding["severity"] == "error")
    assert (gap["check"], gap["episode"], gap["frame"]) == ("time_gap", 0, 5)
    assert gap["remedy"] == CHECKS["time_gap"].remedy


def test_the_manual_explains_every_check() -> None:
    manual = (Path(__file__).parents[2] / "docs/doctor.md").read_text()
    for name, check in CHECKS.items():
        assert f"| `{name}` | {check.severity} |" in manual, name

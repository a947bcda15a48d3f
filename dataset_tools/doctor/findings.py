"""What ``histmv doctor`` can find: every check, how grave it is, what it means and how to mend it."""

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How grave a finding is, gravest first."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Check:
    """One thing that is looked for.

    Attributes:
        severity: of its findings, unless a finding is milder.
        meaning: what it looks for.
        remedy: what a person can do about it.
        only_histmv: whether it matters to nobody but the histmv policy.
    """

    severity: Severity
    meaning: str
    remedy: str
    only_histmv: bool = False


_E, _W, _N = Severity

CHECKS = {
    "damaged": Check(
        _E, "files are missing, cut off or cannot be read, or are not LeRobot v3", "copy or record the dataset again"
    ),
    "rows": Check(
        _E,
        "an episode's rows are missing, doubled or out of order",
        "copy the dataset again, or remove the episode with lerobot-edit-dataset",
    ),
    "one_frame_episode": Check(
        _E,
        "an episode has a single frame, but a motion needs two",
        "remove it: lerobot-edit-dataset --operation.type delete_episodes --operation.episode_indices [...]",
    ),
    "instructions_missing": Check(
        _E, "an episode's task text is empty or missing", "write it: lerobot-edit-dataset --operation.type modify_tasks"
    ),
    "no_camera": Check(_E, "there is no image at all", "record cameras as observation.images.<camera>", True),
    "depth_missing": Check(
        _E,
        "a colour camera has no depth image",
        "record <camera>_depth, aligned to colour, with info.is_depth_map (RealSense: use_depth: true)",
        True,
    ),
    "depth_picture": Check(
        _E,
        "depth is stored as an ordinary picture or colour video: 8 bits, and lossy as video",
        "record it again with dtype image, shape (height, width, 1), info.is_depth_map: what is lost cannot be mended",
        True,
    ),
    "depth_video": Check(
        _W,
        "depth is stored as LeRobot's depth video: 12 bits, and invalid 0 comes back as the smallest distance",
        "histmv keyframe turns it into images and sets invalid pixels to 0; better record dtype image",
        True,
    ),
    "depth_size": Check(
        _E,
        "depth and colour of a camera differ in size, so their pixels do not belong together",
        "align depth to colour when recording (librealsense: rs2::align), or resize one with its calibration",
        True,
    ),
    "intrinsics_missing": Check(
        _E,
        "a camera has no fx, fy, cx, cy under names that tell the camera",
        "histmv calibrate-attach adds observation.camera_intrinsics, named <camera>.fx ...; see docs/data_format.md",
        True,
    ),
    "extrinsics_missing": Check(
        _E,
        "a camera has no T_world_cam under names that tell the camera",
        "calibrate it to the robot base; histmv calibrate-attach adds observation.camera_extrinsics",
        True,
    ),
    "tool_pose_missing": Check(
        _E,
        "no tool position or rotation is found in the state",
        "name the entries as docs/data_format.md does, or tell them with --columns.position and --columns.rotation",
        True,
    ),
    "action_pose_missing": Check(
        _N,
        "the action's names tell no absolute tool pose, so that it is reached cannot be checked",
        "nothing, if actions are joints or steps; histmv keyframe makes its labels from the state",
        True,
    ),
    "nan": Check(
        _E,
        "a number is missing, infinite or NaN; the episode is not looked at further",
        "remove the episode, or fill the gap from its neighbours and run lerobot-edit-dataset's recompute_stats",
    ),
    "time_gap": Check(
        _E,
        "time stamps do not follow each other at 1 / fps",
        "set timestamp to frame_index / fps; split the episode where frames are really missing",
    ),
    "tool_jump": Check(
        _W,
        "the tool jumps between two frames: frames were dropped, or two episodes run together",
        "split or remove the episode; if the recorder drops frames, lower its fps or image size",
    ),
    "duplicate_rows": Check(
        _W,
        "many rows repeat the one before them exactly, as when a slow sensor is recorded at a fast rate",
        "record at the robot's rate, or remove the repeated rows",
    ),
    "duplicate_episode": Check(
        _W,
        "two episodes hold the same numbers: they weigh double, and leak between training and validation",
        "remove one of them with lerobot-edit-dataset",
    ),
    "quaternion_norm": Check(
        _E, "a quaternion's norm is not 1", "check that these entries are the rotation; divide them by their norm"
    ),
    "quaternion_order": Check(
        _E,
        "quaternions are stored in another order than their names tell: a camera on the tool proves it",
        "reorder the values to w, x, y, z, or rename the entries (--columns.rotation_format=xyzw for one run)",
    ),
    "quaternion_sign": Check(
        _W,
        "quaternions have w < 0: the same rotation then appears as q and as -q, between which averages break",
        "flip the sign of those with w < 0; histmv keyframe does it in its labels",
    ),
    "gripper_range": Check(
        _E,
        "a gripper.pos is not from 0 (closed) to 1 (open), as in percent or in metres",
        "scale state and action alike: (value - closed) / (open - closed)",
        True,
    ),
    "action_not_reached": Check(
        _E,
        "commanded poses are not reached by the next state (keyframed) or within half a second (dense)",
        "check that actions are absolute poses in the state's frame and unit, and not shifted in time",
    ),
    "intrinsics_size": Check(
        _E,
        "the intrinsics do not fit the image size",
        "scale fx, fy, cx, cy with the image (half the width: half of fx and cx); shift cx, cy by what was cropped",
    ),
    "extrinsics_rotation": Check(
        _E,
        "the rotation of T_world_cam is no rotation: its columns are not orthonormal, or mirrored",
        "store rows of the 3x4 matrix [R t] as float32; check that it is not transposed, scaled or quantised",
    ),
    "extrinsics_constant": Check(
        _E,
        "a camera moves, but its T_world_cam stays the same",
        "store T_world_tool(t) @ T_tool_cam in every frame (hand-eye calibration gives T_tool_cam)",
    ),
    "image_undecodable": Check(
        _E, "an image or video frame cannot be decoded", "copy the dataset again, or remove the episode"
    ),
    "rgb_lossy": Check(
        _N,
        "colour is stored with a lossy codec, whose artefacts the policy learns",
        "usually nothing; dtype image (PNG) keeps every pixel",
    ),
    "image_blank": Check(
        _W, "a colour image has one single colour: a dead camera or a dropped frame", "remove the episode"
    ),
    "image_frozen": Check(
        _W,
        "a camera shows exactly the same picture although the tool has moved: it hangs, or frames are repeated",
        "look at the episode with lerobot-dataset-viz; remove it if the camera hung",
    ),
    "depth_unit": Check(
        _E,
        "depths cannot be right in the declared unit: metres stored as millimetres, or the reverse",
        "store uint16 millimetres, or correct info.depth_unit in meta/info.json if only that is wrong",
    ),
    "depth_invalid": Check(
        _E,
        "most of a camera's depth is invalid (0)",
        "check the sensor's range, exposure and alignment; leave the camera out if it stays so",
    ),
    "tool_outside": Check(
        _E,
        "the tool lies outside every view most of the time",
        "check the base frame, the unit (metres) and the tool point of the state, and T_world_cam of every camera",
    ),
    "views_disagree": Check(
        _E,
        "two views see the same surface at different places",
        "calibrate again, and check that colour, depth, pose and T_world_cam belong to the same instant",
    ),
    "views_apart": Check(
        _W,
        "no two views see a common surface, so their calibration cannot be checked",
        "check T_world_cam of every camera, unless they really look at different places",
    ),
}
"""All checks by name."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        check: its name in ``CHECKS``.
        message: what is wrong, with the value.
        severity: as of its check, or milder.
        episode: where; None where it concerns all of them.
        frame: where; None where it concerns all of them.
        camera: which, or which two; empty where it concerns none.
    """

    check: str
    message: str
    severity: Severity
    episode: int | None = None
    frame: int | None = None
    camera: str = ""

    @classmethod
    def of(
        cls,
        check: str,
        message: str,
        episode: int | None = None,
        frame: int | None = None,
        camera: str = "",
        severity: Severity | None = None,
    ) -> "Finding":
        """A finding with its check's severity, unless another is given."""
        return cls(check, message, severity or CHECKS[check].severity, episode, frame, camera)

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return CHECKS[self.check].remedy

"""Names that LeRobot lacks: depth, camera calibration, pose components and keyframe provenance.

Every part of the project reads and writes data through these names, so that orders (of quaternion components, of
cameras) are looked up and never guessed.
"""

from collections.abc import Sequence

OBS_PREFIX = "observation."
IMAGES_PREFIX = "observation.images."
DEPTH_SUFFIX = "_depth"
CLIP_PREFIX = "observation.clip."

STATE = "observation.state"
ACTION = "action"
INTRINSICS = "observation.camera_intrinsics"
EXTRINSICS = "observation.camera_extrinsics"
FROM_ROBOT = "observation.from_robot"
"""In observations of a robot's loop, which asks for an action at every tick: its calibration was in the state."""
ROW = "index"
"""Number of a row in its dataset, as LeRobot names it."""

POSITION_NAMES = ("ee.x.pos", "ee.y.pos", "ee.z.pos")
QUATERNION_NAMES = ("ee.qw.pos", "ee.qx.pos", "ee.qy.pos", "ee.qz.pos")
GRIPPER_NAME = "gripper.pos"
GRIPPER_SLACK = 0.05
"""How far a gripper may lie outside of 0 (closed) to 1 (open): measured openings overshoot a little."""
POSE_NAMES = (*POSITION_NAMES, *QUATERNION_NAMES, GRIPPER_NAME)
"""Eight numbers of an action, and the first eight of the state: tool position [m], quaternion, gripper (1 open)."""

INTRINSICS_FIELDS = ("fx", "fy", "cx", "cy")
EXTRINSICS_FIELDS = tuple(f"{kind}{axis}" for axis in "xyz" for kind in ("r0", "r1", "r2", "t"))
"""Rows of the 3x4 ``T_world_cam``: row x is ``r0x r1x r2x tx``, and so on."""

JOINT_NAMES = tuple(
    f"{joint}.pos" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)
"""The six joint angles [rad] that follow the measured pose in the UR5e's ``observation.state``."""

SOURCE_EPISODE = "keyframe.source_episode"
SOURCE_FRAME = "keyframe.source_frame"
SOURCE_TIMESTAMP = "keyframe.source_timestamp"
REASON = "keyframe.reason"
REASONS = ("start", "pause", "gripper", "ga", "end", "user")
"""Why a keyframe was kept; ``keyframe.reason`` stores the index into this tuple."""

INSTRUCTIONS_FILE = "meta/instructions.json"
KEYFRAMING_FILE = "meta/keyframing.json"


def rgb_key(camera: str) -> str:
    """Dataset key of the colour image of ``camera``."""
    return f"{IMAGES_PREFIX}{camera}"


def depth_key(camera: str) -> str:
    """Dataset key of the depth image (uint16 millimetres) of ``camera``."""
    return f"{IMAGES_PREFIX}{camera}{DEPTH_SUFFIX}"


def clip_key(fingerprint: str, camera: str) -> str:
    """Dataset key of the stored CLIP vectors of ``camera``; ``fingerprint`` tells weights and preprocessing."""
    return f"{CLIP_PREFIX}{fingerprint}.{camera}"


def intrinsics_names(cameras: Sequence[str]) -> list[str]:
    """Feature names of ``observation.camera_intrinsics``: ``front.fx, front.fy, front.cx, front.cy, ...`` [pixels]."""
    return [f"{camera}.{field}" for camera in cameras for field in INTRINSICS_FIELDS]


def extrinsics_names(cameras: Sequence[str]) -> list[str]:
    """Feature names of ``observation.camera_extrinsics``: the rows of each camera's 3x4 ``T_world_cam``."""
    return [f"{camera}.{field}" for camera in cameras for field in EXTRINSICS_FIELDS]


def calibration_state_names(cameras: Sequence[str]) -> list[str]:
    """Names under which a LeRobot ``Robot`` gives intrinsics, then extrinsics, as the last numbers of its state.

    ``lerobot-rollout`` hands to a policy only images and numbers whose names end in ``.pos``, joined to one state.
    """
    return [f"{name}.pos" for name in (*intrinsics_names(cameras), *extrinsics_names(cameras))]


def cameras_of(names: Sequence[str]) -> list[str]:
    """Cameras, in order, that a calibration feature's ``names`` speak of."""
    return list(dict.fromkeys(name.rpartition(".")[0] for name in names))

"""What a dataset lacks, in words: keyframing goes on without it, but its user must know."""

from dataset_tools.columns import Columns
from dataset_tools.source import Source
from lerobot_histmv import keys

_REPLACED = {keys.ACTION, "timestamp", "frame_index", "episode_index", "index", "task_index"}


def notices(source: Source, columns: Columns, ends: tuple[float, float]) -> list[str]:
    """Sentences about what is missing, assumed or dropped.

    Args:
        source: the dense dataset.
        columns: what is used of it.
        ends: gripper values that count as closed and open.
    """
    needed = {
        "depth images (declared with is_depth_map)": bool(source.depth_keys),
        keys.INTRINSICS: keys.INTRINSICS in source.features,
        keys.EXTRINSICS: keys.EXTRINSICS in source.features,
        "a tool position": not columns.is_joints,
        "a tool rotation": columns.rotation is not None,
        "a gripper": columns.gripper is not None,
    }
    absent = [name for name, present in needed.items() if not present]
    found = []
    if absent:
        found.append(f"keyframed, but the histmv policy cannot train on it: it lacks {', '.join(absent)}")
    if columns.is_joints:
        found.append("the curve is joint angles: errors and epsilon count radians, and the action is joint angles")
    if columns.gripper and columns.gripper.feature != keys.ACTION:
        found.append(f"no gripper in the action: its command is read from {columns.gripper}, which may lag behind it")
    if columns.gripper and columns.gripper_range is None:
        found.append(
            f"the gripper counts as closed at {ends[0]:g} and open at {ends[1]:g}, the ends of its range in the data; "
            "if that is the wrong way round, give --columns.gripper_range=[closed,open]"
        )
    dropped = [key for key in source.features if key not in _REPLACED and not key.startswith(keys.OBS_PREFIX)]
    if dropped:
        found.append(f"not kept: {', '.join(dropped)}")
    if not (source.root / keys.INSTRUCTIONS_FILE).is_file():
        found.append(f"no {keys.INSTRUCTIONS_FILE}: each task's text is its only instruction")
    return found

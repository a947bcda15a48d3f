"""Episodes of a keyframed dataset, ready to be drawn: what its rows tell, what the file beside them tells of how they
were made, and the recorded path if the dense dataset they come from is at hand.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from dataset_tools.column_guesses import resolve
from dataset_tools.columns import ColumnsConfig, entry_names
from dataset_tools.demo_figures import scalar
from dataset_tools.demonstrations import gripper_ends
from dataset_tools.inspect.cameras import read_views
from dataset_tools.inspect.dense import instruction_of
from dataset_tools.inspect.episodes import Episode, KeyPose, Motion, Observation, key_poses
from dataset_tools.keyframes import KeyframeOptions
from dataset_tools.signals import Keyframe, PauseOptions, Trajectory
from dataset_tools.source import Source
from dataset_tools.trajectories import Vectors, trajectory_of
from lerobot_histmv import keys

PROVENANCE = (keys.SOURCE_EPISODE, keys.SOURCE_FRAME, keys.SOURCE_TIMESTAMP, keys.REASON)
UNKNOWN = (
    f"{keys.KEYFRAMING_FILE} is missing or speaks of other rows: pose frames are not known, and the last keyframe is "
    "taken for the end"
)
NO_PATH = (
    "the recorded path and the error per frame are not drawn: the dense dataset is not at hand (--source_root=...)"
)


@dataclass(frozen=True)
class Making:
    """How keyframes were made: content of ``meta/keyframing.json``.

    Attributes:
        source: repo id of the dense dataset.
        options: how they were chosen.
        keyframes: by episode of the dense dataset.
    """

    source: str
    options: KeyframeOptions
    keyframes: Mapping[int, tuple[Keyframe, ...]]


def read_making(source: Source) -> Making | None:
    """How a keyframed dataset was made; None if it does not tell, or not in our format."""
    path = source.root / keys.KEYFRAMING_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        told = content["options"]
        options = KeyframeOptions(
            method=told["method"],
            epsilon=told["epsilon"],
            distance=told["distance"],
            rotation_scale=told["rotation_scale"],
            pause=PauseOptions(**told["pause"]),
        )
        found = {
            one["source_episode"]: tuple(Keyframe(**two) for two in one["keyframes"]) for one in content["episodes"]
        }
        return Making(str(content["source"]), options, found)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def keyframed_episodes(
    source: Source, config: ColumnsConfig, making: Making | None, dense: Mapping[int, Trajectory]
) -> Iterator[Episode]:
    """Every chosen episode of a keyframed dataset, one at a time.

    Args:
        source: the keyframed dataset.
        config: which columns hold the tool's pose; guessed from their names by default.
        making: how it was made, if that is known.
        dense: recorded paths by episode of the dense dataset, as far as they are at hand.

    Raises:
        ValueError: columns that cannot be guessed, or images that cannot be read.
    """
    check_provenance(source)
    columns = resolve(source.features, config)
    ends = gripper_ends(source, columns)
    for number in source.episodes:
        vectors = source.vectors(number)
        rows = source.table(number, PROVENANCE)
        origin, seen = origin_of(source, number), _numbers(rows, keys.SOURCE_FRAME)
        made = making.keyframes.get(origin, ()) if making else ()
        known = [keyframe.observation_frame for keyframe in made[:-1]] == seen
        recorded = dense.get(origin) if known else None
        if recorded is not None and len(recorded) <= made[-1].observation_frame:
            recorded = None
        motion = Motion.of(recorded, made, making.options) if recorded is not None and making else None
        measured = trajectory_of(vectors, columns, ends, float(source.meta.fps), number)
        yield Episode(
            number=number,
            instruction=instruction_of(source, number),
            poses=_poses(source, vectors, measured, _reasons(rows, made if known else ()), made if known else ()),
            observations=_observations(source, number, vectors, measured, _numbers(rows, keys.SOURCE_TIMESTAMP)),
            motion=motion,
            is_joints=columns.is_joints,
            notes=[*([] if known else [UNKNOWN]), *([] if motion else [NO_PATH])],
        )


def origin_of(source: Source, number: int) -> int:
    """Episode of the dense dataset that an episode was made of."""
    check_provenance(source)
    return int(_numbers(source.table(number, [keys.SOURCE_EPISODE], [0]), keys.SOURCE_EPISODE)[0])


def check_provenance(source: Source) -> None:
    """ValueError if the columns that tell where rows come from are not all there."""
    if lacking := [key for key in PROVENANCE if key not in source.features]:
        raise ValueError(f"{source.root} is keyframed, but lacks {', '.join(lacking)}; write it again with keyframe")


def _numbers(rows: pa.Table, key: str) -> list[Any]:
    return [scalar(value) for value in rows.column(key).to_pylist()]


def _reasons(rows: pa.Table, made: Sequence[Keyframe]) -> list[str]:
    """Why each of the k keyframes was kept; rows tell it of all but the last."""
    told = [keys.REASONS[index] for index in _numbers(rows, keys.REASON)]
    return [*told, made[-1].reason if made else "end"]


def _poses(
    source: Source, vectors: Vectors, measured: Trajectory, reasons: Sequence[str], made: Sequence[Keyframe]
) -> list[KeyPose]:
    """The first key pose as it was measured, the others as the rows' actions."""
    names = entry_names(source.features[keys.ACTION])
    frames: Sequence[Keyframe | None] = made or [None] * len(reasons)
    first = KeyPose(
        reason=reasons[0],
        position=measured.position[0],
        quaternion=None if measured.quaternion is None else measured.quaternion[0],
        frames=frames[0],
    )
    return [first, *key_poses(vectors[keys.ACTION], names, reasons[1:], frames[1:])]


def _observations(
    source: Source, number: int, vectors: Vectors, measured: Trajectory, seconds: Sequence[float]
) -> list[Observation]:
    views = read_views(source, number, range(len(seconds)), vectors)
    turned = measured.quaternion
    return [
        Observation(
            seconds=time,
            position=measured.position[row],
            quaternion=None if turned is None else turned[row],
            views=views[row],
        )
        for row, time in enumerate(seconds)
    ]

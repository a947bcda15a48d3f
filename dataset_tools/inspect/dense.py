"""Episodes of a dense dataset, keyframed on the fly, ready to be drawn."""

from collections.abc import Iterator, Mapping, Sequence

from dataset_tools.demonstrations import Demonstrations
from dataset_tools.inspect.cameras import read_views
from dataset_tools.inspect.episodes import Episode, Motion, Observation, key_poses
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.source import Source
from dataset_tools.trajectories import label_names, labels


def dense_episodes(
    demonstrations: Demonstrations, options: KeyframeOptions, keep: Mapping[int, Sequence[int]]
) -> Iterator[Episode]:
    """Every episode of ``demonstrations``, one at a time, as images take room.

    Raises:
        ValueError: images that cannot be read, or a rotation scale without rotation.
    """
    source = demonstrations.source
    for number in source.episodes:
        trajectory = demonstrations.trajectory(number)
        found = extract(trajectory, options, number, keep.get(number, ()))
        frames = [keyframe.observation_frame for keyframe in found.keyframes]
        views = read_views(source, number, frames, source.vectors(number))
        turned = trajectory.quaternion
        yield Episode(
            number=number,
            instruction=instruction_of(source, number),
            poses=key_poses(
                labels(trajectory, found.keyframes),
                label_names(demonstrations.columns),
                [keyframe.reason for keyframe in found.keyframes],
                found.keyframes,
            ),
            observations=[
                Observation(
                    seconds=frame / trajectory.fps,
                    position=trajectory.position[frame],
                    quaternion=None if turned is None else turned[frame],
                    views=seen,
                )
                for frame, seen in zip(frames, views, strict=True)
            ],
            motion=Motion.of(trajectory, found.keyframes, options),
            is_joints=demonstrations.columns.is_joints,
            notes=[found.warning] if found.warning else [],
        )


def instruction_of(source: Source, episode: int) -> str:
    """The task's text at an episode's first frame."""
    return source.task(source.table(episode, ["task_index"], [0]).column("task_index")[0].as_py())

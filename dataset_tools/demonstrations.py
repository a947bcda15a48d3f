"""The episodes to keyframe, read and understood: which columns mean what, and what the dataset lacks."""

from dataclasses import dataclass, replace

from dataset_tools import state
from dataset_tools.column_guesses import resolve
from dataset_tools.columns import Column, Columns, ColumnsConfig
from dataset_tools.signals import Trajectory
from dataset_tools.source import Source
from dataset_tools.trajectories import GripperEnds, trajectory_of
from lerobot_histmv import keys

_REPLACED = {keys.ACTION, "timestamp", "frame_index", "episode_index", "index", "task_index"}


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Episodes of a dataset.

    Attributes:
        source: the dataset.
        columns: which of its columns are used.
        ends: gripper values that count as closed and open.
    """

    source: Source
    columns: Columns
    ends: GripperEnds

    def trajectory(self, episode: int) -> Trajectory:
        """Tool motion of one episode.

        Raises:
            ValueError: see ``Source.vectors`` and ``trajectories``.
        """
        vectors, fps = self.source.vectors(episode), float(self.source.meta.fps)
        return trajectory_of(vectors, self.columns, self.ends, fps, episode)

    def notices(self) -> list[str]:
        """Sentences about what is missing, assumed or dropped."""
        return [*self._missing(), *self._assumed(), *self._rewritten(), *self._dropped()]

    def _missing(self) -> list[str]:
        features, columns = self.source.features, self.columns
        needed = {
            "depth images (declared with is_depth_map)": bool(self.source.depth_keys),
            keys.INTRINSICS: keys.INTRINSICS in features,
            keys.EXTRINSICS: keys.EXTRINSICS in features,
            "a tool position": not columns.is_joints,
            "a tool rotation": columns.rotation is not None,
            "a gripper": columns.gripper is not None,
        }
        absent = [name for name, present in needed.items() if not present]
        if not absent:
            return []
        return [f"keyframed, but the histmv policy cannot train on it: it lacks {', '.join(absent)}"]

    def _assumed(self) -> list[str]:
        columns, (closed, opened) = self.columns, self.ends
        found = []
        if columns.is_joints:
            found.append("the curve is joint angles: errors and epsilon count radians, and the action is joint angles")
        if columns.gripper and columns.gripper.feature != keys.ACTION:
            found.append(f"no gripper in the action: its command is read from {columns.gripper}, which may lag behind")
        if columns.gripper and columns.gripper_range is None:
            found.append(
                f"the gripper counts as closed at {closed:g} and open at {opened:g}, the ends of its range in the "
                "data; if that is the wrong way round, give --columns.gripper_range=[closed,open]"
            )
        return found

    def _rewritten(self) -> list[str]:
        """How the state becomes one that the policy reads, if it has to."""
        columns = self.columns
        if not state.names(self.source.features, columns):
            return []
        told = f"{keys.STATE} begins with {', '.join(keys.POSE_NAMES)}, as the histmv policy reads it"
        if columns.opening is None or columns.opening_range is None:
            return [f"{told}; no measured gripper is known, so the opening is the command before the frame"]
        closed, opened = columns.opening_range
        return [
            f"{told}; the opening is {columns.opening}, closed at {closed:g} and open at {opened:g}: the arm's state "
            "must be made likewise; if these are not the gripper's ends, give --columns.opening_range=[closed,open]"
        ]

    def _dropped(self) -> list[str]:
        source = self.source
        dropped = [key for key in source.features if key not in _REPLACED and not key.startswith(keys.OBS_PREFIX)]
        found = [f"not kept: {', '.join(dropped)}"] if dropped else []
        if not (source.root / keys.INSTRUCTIONS_FILE).is_file():
            found.append(f"no {keys.INSTRUCTIONS_FILE}: each task's text is its only instruction")
        return found


def understand(source: Source, config: ColumnsConfig) -> Demonstrations:
    """Episodes of ``source``, with columns as configured or guessed.

    Raises:
        ValueError: an episode has a single frame; see also ``column_guesses.resolve`` and ``Source.vectors``.
    """
    short = [episode for episode in source.episodes if source.length(episode) < 2]
    if short:
        raise ValueError(
            f"episode {short[0]} has 1 frame, but a macro step needs 2: leave it out with --dataset.episodes=[...], or "
            "remove it with lerobot-edit-dataset"
        )
    columns = resolve(source.features, config)
    ends = gripper_ends(source, columns)
    if columns.opening and columns.opening_range is None:
        low, high = observed_range(source, columns.opening)
        columns = replace(columns, opening_range=(low, high) if ends[0] < ends[1] else (high, low))
    return Demonstrations(source, columns, ends)


def gripper_ends(source: Source, columns: Columns) -> GripperEnds:
    """Values that mean closed and open: those of ``columns``, else the ends of the range in the data."""
    if columns.gripper is None:
        return 0.0, 1.0
    if columns.gripper_range is not None:
        return columns.gripper_range
    return observed_range(source, columns.gripper)


def observed_range(source: Source, column: Column) -> tuple[float, float]:
    """Smallest and largest value of a column in all episodes; below and at the only one if all are alike."""
    ranges = []
    for episode in source.episodes:
        values = column.of(source.vectors(episode, [column.feature]))
        ranges.append((float(values.min()), float(values.max())))
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    return (low, high) if low < high else (low - 1, high)

"""The finished episodes of a keyframing, one file each: what survives when it is killed, and what is put together."""

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from dataset_tools import build
from dataset_tools.assembly import Episode, write_dataset
from dataset_tools.demonstrations import Demonstrations
from dataset_tools.keyframes import Keyframing
from dataset_tools.record_place import RECORDING_FILE
from dataset_tools.replay import SOURCE_RECORDING_FILE
from dataset_tools.shards import Statistics, as_arrays, as_lists, delete_leftovers, read_header, write_table
from lerobot_histmv import keys

_SHARD = "episode-{:08d}.parquet"


@dataclass(frozen=True)
class Keyframed:
    """What became of one episode; its rows lie in its shard.

    Attributes:
        episode: its number in the dense dataset.
        keyframing: its keyframes and their errors.
        failure: why executing them failed; empty for a success or without a replay.
        tasks: instruction of each row.
        statistics: LeRobot's, of all columns of the rows.
        warnings: sentences about what the rows hold.
    """

    episode: int
    keyframing: Keyframing
    failure: str
    tasks: tuple[str, ...]
    statistics: Statistics
    warnings: tuple[str, ...]


def shard(directory: Path, episode: int) -> Path:
    """Where an episode's rows lie."""
    return directory / _SHARD.format(episode)


def read_keyframed(path: Path) -> Keyframed:
    """What became of the episode of a shard.

    Raises:
        pyarrow.ArrowInvalid: the shard is damaged.
    """
    told = read_header(path)
    keyframing = Keyframing.from_json(told["keyframing"])
    statistics = as_arrays(told["statistics"])
    return Keyframed(
        told["episode"], keyframing, told["failure"], tuple(told["tasks"]), statistics, tuple(told["warnings"])
    )


def commit(directory: Path, done: Keyframed, table: pa.Table) -> None:
    """Write an episode's shard; it appears whole or not at all."""
    header = {**dataclasses.asdict(done), "statistics": as_lists(done.statistics)}
    write_table(shard(directory, done.episode), table, header)


def finished_episodes(directory: Path) -> dict[int, Keyframed]:
    """What became of the episodes whose shards lie in ``directory``; damaged shards are deleted."""
    delete_leftovers(directory)
    done = {}
    for path in sorted(directory.glob(_SHARD.replace("{:08d}", "*"))):
        try:
            one = read_keyframed(path)
        except pa.ArrowInvalid:
            path.unlink()
        else:
            done[one.episode] = one
    return done


def write(directory: Path, kept: Sequence[Keyframed], demonstrations: Demonstrations, repo_id: str, root: Path) -> None:
    """Write the dataset that holds the shards of ``kept``, in their order.

    Args:
        directory: where the shards lie.
        kept: what became of the episodes.
        demonstrations: the dense data.
        repo_id: name of the new dataset.
        root: where to write it; must not exist.
    """
    source = demonstrations.source
    features = build.keyframed_features(source, demonstrations.columns)
    episodes = (Episode(pq.read_table(shard(directory, one.episode)), one.tasks, one.statistics) for one in kept)
    write_dataset(episodes, features, build.FPS, repo_id, root, source.meta.robot_type)
    for told, copy in ((keys.INSTRUCTIONS_FILE, keys.INSTRUCTIONS_FILE), (RECORDING_FILE, SOURCE_RECORDING_FILE)):
        if (source.root / told).is_file():
            shutil.copyfile(source.root / told, root / copy)

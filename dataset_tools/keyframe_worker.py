"""What is done for each episode on its own: read it, choose its keyframes, replay them, commit its shard.

Nothing here looks at another episode, so episodes can be done by any number of processes or machines.
"""

import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from dataset_tools import build, state
from dataset_tools.columns import Columns
from dataset_tools.demonstrations import Demonstrations
from dataset_tools.keyframe_shards import Keyframed, commit
from dataset_tools.keyframes import KeyframeOptions, extract
from dataset_tools.pool import one_thread_each, serve_parent
from dataset_tools.replay import Replayer, Scenes
from dataset_tools.source import Source
from dataset_tools.trajectories import GripperEnds, labels
from lerobot_histmv import keys

WORTH_A_PROCESS = 16
"""Episodes for which it pays to start one more process."""


@dataclass(frozen=True)
class KeyframeJob:
    """What all episodes share.

    Attributes:
        directory: where shards go.
        options: how keyframes are chosen.
        columns: which columns are used.
        ends: gripper values that count as closed and open.
        keep: frames asked for by the user, by episode.
        scenes: where to replay the key poses; None for no replay.
    """

    directory: Path
    options: KeyframeOptions
    columns: Columns
    ends: GripperEnds
    keep: Mapping[int, Sequence[int]]
    scenes: Scenes | None = None


class Keyframer:
    """Does the episodes of one dataset, one after the other."""

    def __init__(self, source: Source, job: KeyframeJob) -> None:
        self._source, self._job = source, job
        self._demonstrations = Demonstrations(source, job.columns, job.ends)
        self._features = build.keyframed_features(source, job.columns)
        self._replayer = Replayer(job.scenes) if job.scenes else None

    def keyframe(self, episode: int) -> Keyframed:
        """Commit an episode's shard.

        Raises:
            ValueError: see ``Source.vectors``, ``trajectories``, ``keyframes.extract`` and ``frames.camera_frames``.
        """
        source, job = self._source, self._job
        moved = self._demonstrations.trajectory(episode)
        found = extract(moved, job.options, episode, job.keep.get(episode, ()))
        action = labels(moved, found.keyframes[1:])
        failure = self._replayer.failure(episode, action) if self._replayer else ""
        rows, tasks, warnings = build.rows(source, found, action, episode)
        if state.names(source.features, job.columns):
            rows[keys.STATE] = state.values(source.features, job.columns, moved, rows)
        statistics = build.statistics(rows, self._features)
        done = Keyframed(episode, found, failure, tuple(tasks), statistics, tuple(warnings))
        commit(job.directory, done, build.table(rows, self._features))
        return done

    def close(self) -> None:
        """Free the environment of the replay, if there is one."""
        if self._replayer:
            self._replayer.close()


def keyframe_missing(source: Source, job: KeyframeJob, episodes: Sequence[int], workers: int) -> Iterator[Keyframed]:
    """Do the given episodes, in this process if one is enough; yields each when its shard is committed.

    Raises:
        ValueError: an episode cannot be keyframed.
        ChildProcessError: a worker process died.
    """
    workers = min(workers, -(-len(episodes) // WORTH_A_PROCESS))
    if workers <= 1:
        with closing(Keyframer(source, job)) as keyframer:
            yield from map(keyframer.keyframe, episodes)
        return
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with one_thread_each(), ProcessPoolExecutor(workers, context, start_worker, (source, job)) as pool:
        try:
            yield from pool.map(keyframe_episode, episodes, chunksize=8)
        except BrokenProcessPool as error:
            kept = "finished episodes are kept and the same command goes on from there"
            raise ChildProcessError(
                f"a process died (killed, or out of memory? try fewer --workers); {kept}"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


_keyframers: list[Keyframer] = []


def start_worker(source: Source, job: KeyframeJob) -> None:
    """Initialise a worker process."""
    serve_parent()
    _keyframers[:] = [Keyframer(source, job)]


def keyframe_episode(episode: int) -> Keyframed:
    """Do an episode in this worker process."""
    return _keyframers[0].keyframe(episode)

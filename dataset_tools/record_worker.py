"""One process that turns scene seeds into finished shards: expert, frames, encoding, statistics.

It imports neither torch nor LeRobot, which would take longer to start than it takes to record some episodes.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from dataset_tools.dense_features import frame_columns
from dataset_tools.images import encode_depth, encode_rgb, image_statistics
from dataset_tools.pool import serve_parent
from dataset_tools.shards import Outcome, as_lists, write_failure, write_success
from lerobot_histmv import keys


@dataclass(frozen=True)
class WorkerSetup:
    """What a worker must know.

    Args:
        directory: where shards go.
        tasks: names; attempt i is at task i modulo their number.
        make_env: makes a task's environment; must be picklable.
        cameras: names, in the order of the calibration vectors.
        stride: control ticks per recorded frame.
        seed: scene seed of attempt 0.
    """

    directory: Path
    tasks: tuple[str, ...]
    make_env: Callable[[str], Any]
    cameras: tuple[str, ...]
    stride: int
    seed: int


def dealt(variations: Sequence[int], seed: int, turn: int) -> int:
    """The variation of a task's attempt number ``turn``: all come once, in random order, before one comes again.

    If every attempt drew its own, ten demonstrations of six colours would often lack three of them.
    """
    deck, place = divmod(turn, len(variations))
    return variations[np.random.default_rng((seed, deck)).permutation(len(variations))[place]]


class Worker:
    """Makes attempts with one environment, which lives until an attempt at another task."""

    def __init__(self, setup: WorkerSetup) -> None:
        self.setup = setup
        self._task, self._env = "", None

    def env(self, task: str) -> Any:
        """The task's environment, made when first needed, so that what it raises is an attempt's error."""
        if self._env is None or self._task != task:
            if self._env is not None:
                self._env.close()
            self._task, self._env = task, self.setup.make_env(task)
        return self._env

    def make_attempt(self, attempt: int) -> Outcome:
        """Let the expert act in the attempt's scene and commit the shard."""
        setup, seed = self.setup, self.setup.seed + attempt
        task = setup.tasks[attempt % len(setup.tasks)]
        env = self.env(task)
        variation = dealt(env.variations, setup.seed, attempt // len(setup.tasks))
        _, info = env.reset(seed=seed, options={"variation": variation})
        demonstration = Demonstration(env, setup.cameras, setup.stride)
        failure = demonstration.run()
        outcome = Outcome(
            attempt=attempt,
            seed=seed,
            task=task,
            variation=int(info["variation"]),
            instruction=info["instruction"],
            paraphrases=list(env.paraphrases),
            failure=failure,
            rows=len(demonstration.actions),
        )
        if outcome.success:
            return commit_episode(setup.directory, outcome, demonstration.columns())
        write_failure(setup.directory, outcome)
        return outcome


class Demonstration:
    """Frames of one episode in the making.

    With a stride above one, a frame spans several control ticks; its action is the one commanded for their end, so
    that following the actions at the frame rate leads along the same path.
    """

    def __init__(self, env: Any, cameras: Sequence[str], stride: int) -> None:
        self.frames: list[dict[str, np.ndarray]] = []
        self.actions: list[np.ndarray] = []
        self._env, self._cameras, self._stride = env, cameras, stride
        self._ticks = 0

    def run(self) -> str:
        """Let the expert act; returns why it failed (one of the environment's failure kinds), empty on success."""
        try:
            for motion in self._env.expert():
                self._env.execute(motion, self._on_tick)
        except ValueError:
            return "ik"
        return "" if self._env.is_success() else self._env.failure()

    def _on_tick(self, tick: Any) -> None:
        if self._ticks % self._stride == 0:
            self.frames.append(frame_columns(self._env.observe(), self._cameras))
            self.actions.append(tick.action)
        else:
            self.actions[-1] = tick.action
        self._ticks += 1

    def columns(self) -> dict[str, np.ndarray]:
        """All columns, frames stacked along the first axis."""
        columns = {key: np.stack([frame[key] for frame in self.frames]) for key in self.frames[0]}
        return columns | {keys.ACTION: np.stack(self.actions).astype(np.float32)}


def commit_episode(directory: Path, outcome: Outcome, columns: Mapping[str, np.ndarray]) -> Outcome:
    """Encode a successful episode and commit its shard; returns the outcome with the images' statistics."""
    images = {key: column for key, column in columns.items() if key.startswith(keys.IMAGES_PREFIX)}
    statistics = {key: image_statistics(column) for key, column in images.items()}
    outcome = dataclasses.replace(outcome, statistics=as_lists(statistics))
    write_success(directory, outcome, episode_table(columns))
    return outcome


def episode_table(columns: Mapping[str, np.ndarray]) -> pa.Table:
    """Arrow table of an episode: images as encoded files, vectors as fixed-size lists."""
    return pa.table({key: _arrow_column(key, column) for key, column in columns.items()})


def _arrow_column(key: str, column: np.ndarray) -> pa.Array:
    if column.ndim == 2:
        numbers = pa.py_buffer(np.ascontiguousarray(column, np.float32))
        values = pa.Array.from_buffers(pa.float32(), column.size, [None, numbers])
        return pa.FixedSizeListArray.from_arrays(values, column.shape[1])
    encode, suffix = (encode_depth, "tiff") if key.endswith(keys.DEPTH_SUFFIX) else (encode_rgb, "png")
    files = _arrow_strings([encode(image) for image in column], pa.binary())
    names = _arrow_strings([f"frame-{i:06d}.{suffix}".encode() for i in range(len(column))], pa.string())
    return pa.StructArray.from_arrays([files, names], ["bytes", "path"])


def _arrow_strings(cells: Sequence[bytes], arrow_type: pa.DataType) -> pa.Array:
    """Made from buffers, because ``pa.array`` would import pandas, which takes seconds in every process."""
    offsets = np.cumsum([0, *map(len, cells)])
    assert offsets[-1] < 2**31, f"{offsets[-1]} bytes exceed an Arrow column"
    buffers = [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(b"".join(cells))]
    return pa.Array.from_buffers(arrow_type, len(cells), buffers)


_workers: list[Worker] = []


def start_worker(setup: WorkerSetup) -> None:
    """Initialise a worker process."""
    serve_parent()
    _workers[:] = [Worker(setup)]


def make_attempt(attempt: int) -> Outcome:
    """Make an attempt in this worker process."""
    return _workers[0].make_attempt(attempt)

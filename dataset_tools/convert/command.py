"""``histmv convert``: episodes of RLBench's or robomimic's format become a dense LeRobot dataset."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from rich.console import Console

from dataset_tools.assembly import assemble
from dataset_tools.convert.episode import EpisodeSource, relative_to
from dataset_tools.convert.rlbench import RLBenchSource
from dataset_tools.convert.robomimic import RobomimicSource
from dataset_tools.dense_features import arm_features
from dataset_tools.output_place import OutputPlace
from dataset_tools.record_report import progress_bar
from dataset_tools.record_worker import commit_episode
from dataset_tools.shards import Outcome, made_attempts, missing_attempts, read_outcomes, write_json
from dataset_tools.workplace import Workplace

CONVERSION_FILE = "meta/conversion.json"
"""Where each episode of a converted dataset comes from."""
DEFAULT_FPS = 20

Format = Literal["rlbench", "robomimic"]
"""Has a name because draccus finds no comment of an option whose annotation holds quotes."""


@dataclass
class ConvertConfig:
    """Convert episodes of another format into a dense LeRobot dataset, ready for histmv keyframe.

        histmv convert --format=rlbench --source=data/train --output.repo_id=me/demos --output.root=demos

    A killed conversion goes on where it stopped when the same command is given again.
    """

    # rlbench (folders of PNG files and pickles, as RLBench's and PerAct's generators write them) or robomimic (HDF5).
    format: Format
    # rlbench: a folder of tasks, one task, one variation or its episodes. robomimic: the file.
    source: Path
    output: OutputPlace
    # Cameras to convert, in this order, e.g. [front,wrist]; by default all with colour and depth.
    cameras: list[str] = field(default_factory=list)
    # What the arm was asked for, all paraphrases; by default what the source says.
    instructions: list[str] = field(default_factory=list)
    # Frames per second; by default what the source says, else 20.
    fps: int | None = None
    # Where the source's camera matrices place the centre of the first pixel. 0.5: they count from its corner, as those
    # of CoppeliaSim and robosuite do (cx = W / 2). 0: from its centre, as OpenCV and librealsense do.
    pixel_centre: float = 0.5
    # Where the robot's base is in the source's world [m]; it becomes the origin. The axes stay as they are.
    base: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Distance between the fingers of an open gripper [m], for robomimic; that of the Panda is 0.08.
    gripper_width: float = 0.08
    # Episodes converted at the same time.
    workers: int = 2
    # Replace an existing output dataset.
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name, value in (("workers", self.workers), ("gripper_width", self.gripper_width), ("fps", self.fps or 1)):
            if value <= 0:
                raise ValueError(f"{name} is {value}; it must be above 0")
        if len(self.base) != 3:
            raise ValueError(f"base is {self.base}; it must be x, y, z [m]")
        if any(not sentence.strip() for sentence in self.instructions):
            raise ValueError(f"instructions are {self.instructions}; each must say something")


@dataclass(frozen=True)
class ConvertSettings:
    """Everything that decides the bytes of the dataset.

    Args:
        format: of the source.
        source: its name.
        episodes: digest of the names of its episodes.
        cameras: converted cameras.
        instructions: given ones.
        fps: frames per second.
        pixel_centre: as configured.
        base: as configured.
        gripper_width: as configured.
    """

    format: str
    source: str
    episodes: str
    cameras: list[str]
    instructions: list[str]
    fps: int
    pixel_centre: float
    base: list[float]
    gripper_width: float


def run(config: ConvertConfig) -> None:
    """Convert every episode that is not converted yet, then publish the dataset.

    Raises:
        ValueError: the source or the output place is not as it must be; see ``convert_rlbench``, ``convert_robomimic``.
    """
    root = config.output.folder()
    source = open_source(config)
    settings = settings_of(config, source)
    console = Console(highlight=False)
    place = Workplace(root, asdict(settings), config.overwrite, "converted")
    with place.opened() as parts:
        outcomes = read_outcomes(parts)
        with progress_bar(console) as progress:
            total = len(source.names)
            bar = progress.add_task("converting", total=total, completed=len(outcomes))
            convert_one = partial(convert_episode, source, parts, np.array(config.base, dtype=np.float64))
            for outcome in convert(convert_one, missing_attempts(outcomes, total), config.workers):
                outcomes[outcome.attempt] = outcome
                progress.advance(bar)
        made = made_attempts(outcomes, total)
        place.commit(partial(_write, parts, made, source, settings, config.output.repo_id))
    rows, sentences = sum(outcome.rows for outcome in made), {outcome.instruction for outcome in made}
    console.print(
        f"{total} episodes, {rows} frames, {len(sentences)} instructions, cameras {', '.join(source.sizes)}\n"
        f"dataset {config.output.repo_id} in {root}",
        soft_wrap=True,
    )


def open_source(config: ConvertConfig) -> EpisodeSource:
    """The episodes that ``config`` names; ValueError if there are none."""
    path = config.source.expanduser()
    if not path.exists():
        raise ValueError(f"--source is {path}, which does not exist")
    if config.format == "rlbench":
        return RLBenchSource(path, config.cameras, config.instructions, config.pixel_centre)
    return RobomimicSource(path, config.cameras, config.instructions, config.pixel_centre, config.gripper_width)


def settings_of(config: ConvertConfig, source: EpisodeSource) -> ConvertSettings:
    """What decides the dataset, with what the source and the defaults add to ``config``."""
    return ConvertSettings(
        format=config.format,
        source=config.source.name,
        episodes=hashlib.sha256("\n".join(source.names).encode()).hexdigest(),
        cameras=list(source.sizes),
        instructions=config.instructions,
        fps=config.fps or source.fps or DEFAULT_FPS,
        pixel_centre=config.pixel_centre,
        base=config.base,
        gripper_width=config.gripper_width,
    )


def convert(convert_one: Callable[[int], Outcome], indices: Sequence[int], workers: int) -> Iterator[Outcome]:
    """Convert these episodes, several at a time, and tell of each when its shard is committed.

    Threads do, since decoding and encoding images run outside of the interpreter's lock.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting = [pool.submit(convert_one, index) for index in indices]
        try:
            for done in as_completed(waiting):
                yield done.result()
        finally:
            pool.shutdown(cancel_futures=True)


def convert_episode(source: EpisodeSource, parts: Path, base: Float[np.ndarray, " 3"], index: int) -> Outcome:
    """Convert one episode and commit its shard. Its instruction is the paraphrase whose turn it is."""
    episode = relative_to(source.read(index), base)
    outcome = Outcome(
        attempt=index,
        seed=index,
        task=episode.task,
        variation=episode.variation,
        instruction=episode.instructions[index % len(episode.instructions)],
        paraphrases=list(episode.instructions),
        failure="",
        rows=len(episode.motion.position),
    )
    return commit_episode(parts, outcome, episode.columns())


def _write(
    parts: Path, made: Sequence[Outcome], source: EpisodeSource, settings: ConvertSettings, repo_id: str, root: Path
) -> None:
    joints = [f"joint_{number + 1}.pos" for number in range(source.joints)]
    assemble(parts, made, arm_features(source.sizes, joints), settings.fps, repo_id, root, source.robot_type)
    episodes = [
        {"source": source.names[outcome.attempt], "task": outcome.task, "variation": outcome.variation}
        for outcome in made
    ]
    write_json(root / CONVERSION_FILE, {"settings": asdict(settings), "episodes": episodes})

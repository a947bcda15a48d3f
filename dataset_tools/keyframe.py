"""``histmv keyframe``: from a dense LeRobot dataset to one with a row per macro step."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.progress import Progress

from dataset_tools import build
from dataset_tools.columns import ColumnsConfig
from dataset_tools.demonstrations import Demonstrations, read_demonstrations
from dataset_tools.fitness import Distance
from dataset_tools.genetic import GeneticOptions
from dataset_tools.keyframes import MOST, KeyframeOptions, Keyframing, extract
from dataset_tools.replay import read_scenes, replay, without_failures
from dataset_tools.report import Report
from dataset_tools.shards import write_json
from dataset_tools.signals import PauseOptions
from dataset_tools.simplify import Method
from dataset_tools.source import open_source
from dataset_tools.trajectories import labels
from lerobot_histmv import keys


@dataclass
class SourceConfig:
    """The dense dataset to read."""

    # Name, such as user/demonstrations. Without a root it is looked for locally, then on the Hub, as LeRobot does.
    repo_id: str
    # Folder that holds the dataset.
    root: Path | None = None
    # Episodes to use, e.g. [0,1,5]; all by default.
    episodes: list[int] | None = None
    # Branch, tag or commit on the Hub.
    revision: str | None = None


@dataclass
class OutputConfig:
    """The keyframed dataset to write."""

    # Name of the new dataset, such as user/demonstrations_keyframed.
    repo_id: str
    # Folder to write; by default LeRobot's own place for this repo_id.
    root: Path | None = None
    # Upload it when done.
    push_to_hub: bool = False
    # Upload it as a private repository.
    private: bool = False


@dataclass(kw_only=True)
class KeyframingConfig:
    """Which frames of an episode are its keyframes: the same options wherever a dense dataset is keyframed."""

    columns: ColumnsConfig = field(default_factory=ColumnsConfig)
    # ga (genetic), exact (dynamic program), heuristic (pauses and gripper only), rdp, awe (fewest under a largest
    # error) or uniform (evenly in time).
    method: Method = "ga"
    # Accepted mean distance of moving frames to the straight lines [m]; for awe the largest distance of any frame.
    epsilon: float = 0.005
    # segment: distance to the piece between two key poses. line: to the infinite line, Eq. 1 of the paper as printed.
    distance: Distance = "segment"
    # Metres that one radian of rotation counts as; 0 ignores rotation, as the paper does.
    rotation_scale: float = 0.0
    # The same seed and data give the same key poses.
    seed: int = 0
    # Key poses per episode at most, unless more are mandatory.
    most: int = MOST
    # What counts as a pause.
    pause: PauseOptions = field(default_factory=PauseOptions)
    # Settings of the genetic algorithm.
    genetic: GeneticOptions = field(default_factory=GeneticOptions)

    def options(self) -> KeyframeOptions:
        """The part that decides which frames are kept."""
        return KeyframeOptions(
            method=self.method,
            epsilon=self.epsilon,
            distance=self.distance,
            rotation_scale=self.rotation_scale,
            seed=self.seed,
            most=self.most,
            pause=self.pause,
            genetic=self.genetic,
        )


@dataclass
class KeyframeConfig(KeyframingConfig):
    """Keep the key poses of each episode: one row per macro step, with the next key pose as the action.

    Always kept are the first and last frame, pauses and gripper changes; between them the method adds the fewest poses
    such that straight lines between key poses stay within epsilon of the recorded path on average.

        histmv keyframe --dataset.repo_id=me/demos --dataset.root=demos --output.repo_id=me/keys --output.root=keys

    Any LeRobot dataset works; where the tool position, rotation and gripper cannot be guessed from the feature names,
    tell them: --columns.position=observation.state:0:3 --columns.gripper=action:6
    """

    dataset: SourceConfig
    output: OutputConfig
    # Execute each episode's key poses in the scene it was recorded in (data of histmv record only): off, flag (tell
    # which fail) or drop (leave those out).
    replay: Literal["off", "flag", "drop"] = "off"
    # Replace an existing output dataset.
    overwrite: bool = False


def run(config: KeyframeConfig) -> None:
    """Read, choose, check, write, report. Nothing appears at the output before all of it is done.

    Raises:
        ValueError: an option, the dataset or the output place is not as it must be; see ``source``, ``column_guesses``,
            ``trajectories``, ``frames`` and ``build``.
    """
    console = Console()
    root = (config.output.root or build.default_root(config.output.repo_id)).expanduser().resolve()
    build.check_free(root, config.overwrite)
    source = open_source(config.dataset.repo_id, config.dataset.root, config.dataset.episodes, config.dataset.revision)
    if root == source.root.resolve():
        raise ValueError(f"--output.root is the dataset itself ({root}); give another folder")
    demonstrations = read_demonstrations(source, config.columns)
    with build.published(root, config.overwrite) as partial, Progress(console=console) as progress:
        options = config.options()
        chosen = progress.track(demonstrations.trajectories.items(), description="choosing keyframes")
        found = {number: extract(trajectory, options, number) for number, trajectory in chosen}
        failures = {} if config.replay == "off" else replay_all(demonstrations, found, progress)
        if config.replay == "drop":
            found = without_failures(found, failures)
        bar = progress.add_task("writing episodes", total=len(found))
        blank = build.write_dataset(
            partial, demonstrations, found, config.output.repo_id, lambda: progress.advance(bar)
        )
        notices = [*demonstrations.notices(), *blank]
        report = Report(options, config.dataset.repo_id, demonstrations.columns, found, failures, notices)
        write_json(partial / keys.KEYFRAMING_FILE, report.as_json())
        (partial / keys.KEYFRAMING_FILE).with_suffix(".md").write_text(report.markdown(), encoding="utf-8")
    report.show(console)
    console.print(f"written to {root}", highlight=False)
    if config.output.push_to_hub:
        build.push(config.output.repo_id, root, config.output.private)


def replay_all(demonstrations: Demonstrations, found: Mapping[int, Keyframing], progress: Progress) -> dict[int, str]:
    """By episode, why executing its key poses failed; empty for a success."""
    source, trajectories = demonstrations.source, demonstrations.trajectories
    scenes = read_scenes(source.root, source.meta.total_episodes)
    actions = {number: labels(trajectories[number], one.keyframes[1:]) for number, one in found.items()}
    return dict(progress.track(replay(scenes, actions), total=len(actions), description="replaying"))

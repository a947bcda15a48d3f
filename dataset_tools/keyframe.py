"""``histmv keyframe``: from a dense LeRobot dataset to one with a row per macro step."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from dataset_tools import build, keyframe_shards
from dataset_tools.columns import ColumnsConfig
from dataset_tools.demonstrations import understand
from dataset_tools.fitness import Distance
from dataset_tools.genetic import GeneticOptions
from dataset_tools.hub import repositories
from dataset_tools.hub.push import push_dataset
from dataset_tools.keyframe_shards import Keyframed, finished_episodes
from dataset_tools.keyframe_worker import KeyframeJob, keyframe_missing
from dataset_tools.keyframes import MOST, KeyframeOptions
from dataset_tools.record_place import RECORDING_FILE
from dataset_tools.replay import read_scenes
from dataset_tools.report import Report
from dataset_tools.signals import PauseOptions
from dataset_tools.simplify import Method
from dataset_tools.source import Source, open_source
from dataset_tools.workplace import Workplace

ReplayUse = Literal["off", "flag", "drop"]
"""Named, because draccus shows no help for a field whose line holds more text in quotes than its default."""


@dataclass
class SourceConfig:
    """The dataset to read."""

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
    # Upload it when done, with a card that tells how it was made; histmv push does the same later.
    push_to_hub: bool = False
    # Upload it as a private repository.
    private: bool = False
    # Licence in the card, as the Hub names it; by default apache-2.0. The licence of the source may ask for another.
    license: str | None = None


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
    # Exactly so many key poses per episode (all mandatory ones included) instead of the fewest within epsilon.
    k: int | None = None
    # Frames that must be key poses, by episode: {0: [12, 40], 3: [7]}.
    keep: dict[int, list[int]] = field(default_factory=dict)
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
            k=self.k,
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
    replay: ReplayUse = "off"
    # Processes; the result does not depend on their number.
    workers: int = 2
    # Replace an existing output dataset.
    overwrite: bool = False


def run(config: KeyframeConfig) -> None:
    """Keyframe, and tell about it on the terminal.

    Raises:
        ValueError: see ``keyframe_dataset``.
    """
    keyframe_dataset(config, Console())


def keyframe_dataset(config: KeyframeConfig, console: Console) -> None:
    """Read, choose, check, write, report. Nothing appears at the output before all of it is done.

    Killed and started again with the same options, it goes on with the episodes that are missing.

    Args:
        config: the options.
        console: where progress and the report are shown.

    Raises:
        ValueError: an option, the dataset or the output place is not as it must be; see ``source``, ``column_guesses``,
            ``trajectories``, ``frames``, ``workplace`` and ``hub``.
    """
    root = (config.output.root or build.default_root(config.output.repo_id)).expanduser().resolve()
    source = open_source(config.dataset.repo_id, config.dataset.root, config.dataset.episodes, config.dataset.revision)
    check_request(config, source, root)
    place = Workplace(root, settings_of(config, source), config.overwrite, "keyframed")
    place.check_free()
    if config.output.push_to_hub:
        repositories.prepare(config.output.repo_id, config.output.private)
    demonstrations = understand(source, config.columns)
    scenes = read_scenes(source.root / RECORDING_FILE, source.meta.total_episodes) if config.replay != "off" else None
    with place.opened() as parts:
        job = KeyframeJob(parts, config.options(), demonstrations.columns, demonstrations.ends, config.keep, scenes)
        try:
            done = keyframe_all(source, job, config.workers, console)
        except ValueError:  # other options or data are needed, with which this work cannot be continued
            place.clean_up()
            raise
        kept = without_failures(done) if config.replay == "drop" else done
        report = Report(
            options=job.options,
            source=config.dataset.repo_id,
            columns=demonstrations.columns,
            episodes={one.episode: one.keyframing for one in kept},
            failures={one.episode: one.failure for one in done} if scenes else {},
            notices=[*demonstrations.notices(), *(warning for one in kept for warning in one.warnings)],
        )

        def write(path: Path) -> None:
            keyframe_shards.write(parts, kept, demonstrations, config.output.repo_id, path)
            report.write(path)

        place.commit(write)
    report.show(console)
    console.print(f"written to {root}", highlight=False)
    if config.output.push_to_hub:
        push_dataset(root, config.output.repo_id, config.output.private, config.output.license)


def check_request(config: KeyframeConfig, source: Source, root: Path) -> None:
    """ValueError if what is asked for does not fit the dataset."""
    if root == source.root.resolve():
        raise ValueError(f"--output.root is the dataset itself ({root}); give another folder")
    unknown = sorted(set(config.keep) - set(source.episodes))
    if unknown:
        raise ValueError(f"keep names episodes {unknown}, which are not among those to keyframe")
    if config.workers < 1:
        raise ValueError(f"workers is {config.workers}; it must be at least 1")


def settings_of(config: KeyframeConfig, source: Source) -> dict[str, Any]:
    """What decides the result, as JSON gives it back: work with other settings is not continued."""
    options = {"columns": asdict(config.columns), **asdict(config.options()), "keep": config.keep}
    told = {
        "source": str(source.root.resolve()),
        "frames": source.meta.total_frames,
        "episodes": list(source.episodes),
        "replay": config.replay != "off",
        **options,
    }
    plain: dict[str, Any] = json.loads(json.dumps(told))
    return plain


def without_failures(done: Sequence[Keyframed]) -> list[Keyframed]:
    """The episodes whose key poses succeeded; ValueError if there is none."""
    kept = [one for one in done if not one.failure]
    if not kept:
        failures = ", ".join(f"{one.episode}: {one.failure}" for one in done)
        raise ValueError(f"no episode's key poses succeed ({failures}); a smaller --epsilon keeps more of them")
    return kept


def keyframe_all(source: Source, job: KeyframeJob, workers: int, console: Console) -> list[Keyframed]:
    """Do the episodes that are not done yet; what became of each, in order.

    Raises:
        ValueError: an episode cannot be keyframed; the others' shards stay.
        ChildProcessError: a worker process died.
    """
    done = finished_episodes(job.directory)
    missing = [episode for episode in source.episodes if episode not in done]
    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console) as progress:
        bar = progress.add_task("keyframing", total=len(source.episodes), completed=len(done))
        for one in keyframe_missing(source, job, missing, workers):
            done[one.episode] = one
            progress.advance(bar)
    return [done[episode] for episode in source.episodes]

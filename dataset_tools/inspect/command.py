"""``histmv inspect``: pictures of a dataset's episodes, with their keyframes, as PNG files and as one HTML page."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from dataset_tools.demonstrations import understand
from dataset_tools.inspect.chapter import chapter
from dataset_tools.inspect.dense import dense_episodes
from dataset_tools.inspect.episodes import Episode
from dataset_tools.inspect.keyframed import Making, keyframed_episodes, origin_of, read_making
from dataset_tools.inspect.panels import PANELS, left_out
from dataset_tools.inspect.rerun import require_rerun, write_recording
from dataset_tools.keyframe import KeyframingConfig, SourceConfig
from dataset_tools.page import Chapter, draw_panels, page
from dataset_tools.published import check_free, published
from dataset_tools.signals import Trajectory
from dataset_tools.source import Source, open_dataset, open_source

FIRST = 3
"""Episodes to draw if none are named."""
PAGE = "inspection.html"
OUTPUTS = Path("outputs/inspect")


@dataclass
class InspectedConfig(SourceConfig):
    """The dataset to look at, dense or keyframed."""

    # Episodes to draw, e.g. [0,1,5]; the first three by default.
    episodes: list[int] | None = None


@dataclass
class InspectConfig(KeyframingConfig):
    """Draw episodes: path, keyframes and why they were kept, error per frame, images, tool in every view, cloud.

        histmv inspect --dataset.repo_id=me/demos --dataset.root=demos

    writes PNG files and inspection.html, which holds all of them. Dense datasets are keyframed on the fly, with the
    options of histmv keyframe, so that a method or an epsilon can be judged before anything is written; keyframed ones
    are drawn as they are. What a dataset lacks (depth, calibration, a tool position) is left out with a note.
    """

    dataset: InspectedConfig
    # Folder to write; by default outputs/inspect/<name of the dataset>.
    output: Path | None = None
    # Of a keyframed dataset: folder of the dense one that it was made of, for the recorded path and the error per
    # frame, which are left out otherwise.
    source_root: Path | None = None
    # Write a rerun recording (.rrd) per episode too; needs rerun-sdk.
    rerun: bool = False
    # Replace an existing output folder.
    overwrite: bool = False


def run(config: InspectConfig) -> None:
    """Read, draw, write. Nothing appears at the output before all of it is done.

    Raises:
        ValueError: an option, the dataset or the output place is not as it must be; see ``source``, ``column_guesses``,
            ``trajectories`` and ``frames``; rerun is asked for and not installed.
    """
    console = Console(highlight=False)
    root = (config.output or OUTPUTS / Path(config.dataset.repo_id).name).expanduser().resolve()
    check_free(root, config.overwrite, PAGE)
    if config.rerun:
        require_rerun()
    told = config.dataset
    source = open_dataset(told.repo_id, told.root, told.episodes, told.revision, FIRST)
    with published(root, config.overwrite, PAGE) as partial, Progress(console=console) as progress:
        bar = progress.add_task("drawing episodes", total=len(source.episodes))
        chapters = []
        for episode in read_episodes(source, config):
            chapters.append(draw_episode(episode, partial))
            if config.rerun:
                write_recording(episode, partial / f"{stem(episode)}.rrd")
            progress.advance(bar)
        drawn = f"{len(chapters)} of {source.meta.total_episodes} episodes"
        kind = "keyframed" if source.is_keyframed else "dense"
        (partial / PAGE).write_text(page(told.repo_id, f"{kind} dataset; {drawn}", chapters), encoding="utf-8")
    for one in chapters:
        console.print(f"{one.name}: {one.facts}", soft_wrap=True, markup=False)
    for note in dict.fromkeys(note for one in chapters for note in one.notes):
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    console.print(f"written to {root}: open {root / PAGE}", soft_wrap=True, markup=False)


def stem(episode: Episode) -> str:
    """How the names of an episode's files begin."""
    return f"episode_{episode.number:06d}"


def draw_episode(episode: Episode, folder: Path) -> Chapter:
    """Write the pictures of one episode that it has the data for."""
    exhibits = draw_panels(PANELS, episode, folder, stem(episode))
    return chapter(episode, [*episode.notes, *left_out(episode)], exhibits)


def read_episodes(source: Source, config: InspectConfig) -> Iterator[Episode]:
    """The chosen episodes, whichever kind the dataset is, one at a time."""
    if not source.is_keyframed:
        if config.source_root is not None:
            raise ValueError(f"source_root is {config.source_root}, but {source.root} is the dense dataset itself")
        return dense_episodes(understand(source, config.columns), config.options(), config.keep)
    making = read_making(source)
    return keyframed_episodes(source, config.columns, making, recorded_paths(source, config, making))


def recorded_paths(source: Source, config: InspectConfig, making: Making | None) -> dict[int, Trajectory]:
    """Recorded paths by episode of the dense dataset that a keyframed one was made of; none if it was not given.

    Raises:
        ValueError: the dense dataset cannot be read, or lacks these episodes.
    """
    if making is None or config.source_root is None:
        return {}
    origins = sorted({origin_of(source, number) for number in source.episodes})
    dense = understand(open_source(making.source, config.source_root, origins), config.columns)
    return {number: dense.trajectory(number) for number in origins}

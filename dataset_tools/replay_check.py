"""``histmv replay``: do the key poses of a keyframed dataset still do the task?"""

import shutil
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDataset, delete_episodes
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dataset_tools.eval_results import wilson_interval
from dataset_tools.replay import SOURCE_RECORDING_FILE, Replayer, read_scenes
from dataset_tools.shards import write_json
from dataset_tools.source import open_dataset
from dataset_tools.workplace import Workplace
from lerobot_histmv import keys

COPIED = (keys.KEYFRAMING_FILE, keys.INSTRUCTIONS_FILE, SOURCE_RECORDING_FILE)
REPLAY_FILE = "meta/replay.json"
"""By episode, why executing its key poses failed; empty for a success."""


@dataclass
class KeyframedConfig:
    """The keyframed dataset whose key poses are executed."""

    # Name, such as user/demonstrations_keyframed.
    repo_id: str
    # Folder that holds the dataset; by default LeRobot's place for this name, then the Hub.
    root: Path | None = None


@dataclass
class ReplayConfig:
    """Execute each episode's key poses in the scene in which it was recorded, and tell which succeed.

        histmv replay --dataset.repo_id=me/keys --dataset.root=keys --drop_failed=rest

    Only data of histmv record have scenes to execute them in.
    """

    dataset: KeyframedConfig
    # Folder for a dataset of the episodes that succeed; without it, nothing is written.
    drop_failed: Path | None = None
    # Replace a dataset that is in the way.
    overwrite: bool = False


def run(config: ReplayConfig) -> None:
    """Replay, report and, if asked to, write the episodes that succeed.

    Raises:
        ValueError: the dataset cannot be read, is not keyframed, or tells no scenes; or something is in the way of the
            output.
    """
    console = Console(highlight=False)
    source = open_dataset(config.dataset.repo_id, config.dataset.root)
    dataset = LeRobotDataset(config.dataset.repo_id, root=source.root)
    if not source.is_keyframed:
        raise ValueError(f"{config.dataset.repo_id} is not keyframed; make it so with histmv keyframe")
    place = _place(config, dataset) if config.drop_failed else None
    failures = _replay(dataset, console)
    console.print(_table(failures))
    low, high = wilson_interval(successes := sum(not failure for failure in failures), len(failures))
    console.print(f"{successes} of {len(failures)} episodes succeed ({100 * low:.0f} to {100 * high:.0f} %)")
    if place is None:
        return
    failed = [episode for episode, failure in enumerate(failures) if failure]
    if len(failed) == len(failures):
        raise ValueError(
            "no episode's key poses succeed, so nothing is written; a smaller --epsilon keeps more of them"
        )
    with place.opened():
        place.commit(lambda path: _write_rest(dataset, failed, path))
    console.print(f"the {successes} episodes that succeed: {place.root}")


def _place(config: ReplayConfig, dataset: LeRobotDataset) -> Workplace:
    """Where the remaining episodes go; ValueError if that is taken."""
    assert config.drop_failed is not None
    root = config.drop_failed.expanduser().resolve()
    if root == Path(dataset.root).resolve():
        raise ValueError(f"drop_failed is the dataset itself ({root}); give another folder")
    place = Workplace(root, {"source": str(Path(dataset.root).resolve())}, config.overwrite, "replayed")
    place.check_free()
    return place


def _replay(dataset: LeRobotDataset, console: Console) -> list[str]:
    """Per episode, why executing its key poses failed; empty for a success."""
    columns = dataset.hf_dataset.select_columns([keys.ACTION, keys.SOURCE_EPISODE]).with_format("numpy")
    scenes = read_scenes(Path(dataset.root) / SOURCE_RECORDING_FILE)
    failures = []
    with Progress(*Progress.get_default_columns(), console=console) as progress, closing(Replayer(scenes)) as replayer:
        for episode in progress.track(dataset.meta.episodes, description="replaying"):
            rows = columns[episode["dataset_from_index"] : episode["dataset_to_index"]]
            source = int(rows[keys.SOURCE_EPISODE][0])
            failures.append(replayer.failure(source, np.asarray(rows[keys.ACTION], np.float32)))
    return failures


def _table(failures: list[str]) -> Table:
    table = Table("result", "episodes", "which", box=SIMPLE_HEAD)
    for kind, count in Counter(failures).most_common():
        which = [str(episode) for episode, failure in enumerate(failures) if failure == kind]
        table.add_row(kind or "success", str(count), ", ".join(which) if kind else "")
    return table


def _write_rest(dataset: LeRobotDataset, failed: list[int], path: Path) -> None:
    """The dataset without the ``failed`` episodes."""
    if failed:
        delete_episodes(dataset, failed, output_dir=path, repo_id=dataset.repo_id)
    else:
        shutil.copytree(dataset.root, path)
    for name in COPIED:
        if (Path(dataset.root) / name).is_file():
            shutil.copyfile(Path(dataset.root) / name, path / name)
    write_json(path / REPLAY_FILE, {"left_out": failed})

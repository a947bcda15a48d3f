"""``histmv record``: the scripted experts of tasks demonstrate them; a LeRobot dataset holds one row per frame."""

import importlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from dataset_tools.attempts import make_attempts
from dataset_tools.dense_features import dense_features
from dataset_tools.record_place import RECORDING_FILE, RecordPlace
from dataset_tools.record_report import default_root, progress_bar, recording_report, summary_line
from dataset_tools.record_settings import SEED_LIMIT, RecordSettings
from dataset_tools.record_worker import WorkerSetup
from dataset_tools.shards import Outcome, made_attempts, missing_attempts, read_outcomes, write_json
from lerobot_histmv.envs import make
from lerobot_histmv.envs.disturbances import Disturbances
from lerobot_histmv.envs.interface import CAMERA_NAMES
from lerobot_histmv.envs.tasks import suites


@dataclass
class RecordEnvConfig:
    """The environment to record, with the flags of LeRobot's ``--env``."""

    # The environment type; only this one has scripted experts.
    type: str = "ur5"
    # What to demonstrate: a task (turn_tap), a variation (turn_tap.left), a suite (set1), or several joined by commas.
    task: str = ""
    # Index of the variation to record; by default all take turns, in random order.
    variation: int | None = None
    # Cameras to record, in this order: a list such as [front,wrist].
    cameras: list[str] = field(default_factory=lambda: list(CAMERA_NAMES))
    # Side of the square images, in pixels.
    image_size: int = 128
    # What makes episodes harder, such as --env.disturbances.lighting=1.
    disturbances: Disturbances = field(default_factory=Disturbances)


@dataclass
class RecordConfig:
    """Record successful demonstrations."""

    env: RecordEnvConfig = field(default_factory=RecordEnvConfig)
    # Successful episodes of every task that is named; its variations take turns.
    episodes: int = 50
    # Instead: successful episodes of every variation of every task that is named.
    episodes_per_variation: int | None = None
    # Name of the dataset; by default local/ur5_<task>, the first one of several.
    repo_id: str | None = None
    # Directory of the dataset; by default $HF_LEROBOT_HOME/<repo_id>.
    root: str | None = None
    # Frames per second; must divide the control rate, 20.
    fps: int = 20
    # Recording processes.
    workers: int = 2
    # Scene seed of the first attempt; attempt i uses seed + i, all below 100000.
    seed: int = 0
    # Upload the dataset when done, with a card that tells how it was made; histmv push does the same later.
    push_to_hub: bool = False
    # Upload it as a private repository.
    private: bool = False
    # Licence in the card, as the Hub names it; by default apache-2.0.
    license: str | None = None
    # Replace a dataset, or a started recording with other settings, that is in the way.
    overwrite: bool = False


def run(config: RecordConfig) -> None:
    """Record as ``config`` says, or go on where a killed recording of the same settings stopped.

    Raises:
        ValueError: a setting is impossible, something in the way must not be overwritten, or the Hub refuses.
    """
    settings = checked_settings(config)
    repo_id = config.repo_id or f"local/ur5_{config.env.task.split(',')[0].strip()}"
    options: dict[str, Any] = {
        "cameras": settings.cameras,
        "image_size": settings.image_size,
        "render_size": settings.image_size,
        "variation": settings.variation,
        "disturbances": settings.disturbances,
    }
    for task in settings.tasks:
        make(task, **options)
    make_env = partial(make, **options)
    root = Path(config.root).expanduser().resolve() if config.root else default_root(repo_id)
    recorder = Recorder(settings, make_env, RecordPlace(root, settings, config.overwrite), repo_id)
    if config.push_to_hub:
        from dataset_tools.hub import repositories  # here and below, because these imports take seconds

        repositories.prepare(repo_id, config.private)
    recorder.record(config.episodes_per_variation or config.episodes, config.workers)
    if config.push_to_hub:
        from dataset_tools.hub.push import push_dataset

        push_dataset(root, repo_id, config.private, config.license)


def checked_settings(config: RecordConfig) -> RecordSettings:
    """The settings in ``config``; ValueError names what is wrong with them."""
    if config.env.type != "ur5":
        raise ValueError(f"env.type is {config.env.type!r}; only 'ur5' has scripted experts")
    each = config.episodes_per_variation
    for name, value in (("episodes", config.episodes), ("episodes_per_variation", each), ("workers", config.workers)):
        if value is not None and value < 1:
            raise ValueError(f"{name} is {value}; it must be at least 1")
    tasks = suites.expand(config.env.task)
    if each is not None:
        tasks = [name for task in tasks for name in suites.variation_names(task)]
    episodes = len(tasks) * (each or config.episodes)
    if config.seed + episodes > SEED_LIMIT:
        raise ValueError(f"seed {config.seed} and {episodes} episodes exceed the {SEED_LIMIT} recording seeds")
    return RecordSettings(
        tasks=tuple(tasks),
        variation=config.env.variation,
        cameras=tuple(config.env.cameras),
        image_size=config.env.image_size,
        fps=config.fps,
        seed=config.seed,
        disturbances=config.env.disturbances,
    )


class Recorder:
    """Records one dataset.

    Args:
        settings: what decides its content.
        make_env: makes a task's environment in a worker process; must be picklable.
        place: where it is recorded.
        repo_id: its name.
    """

    def __init__(
        self, settings: RecordSettings, make_env: Callable[[str], Any], place: RecordPlace, repo_id: str
    ) -> None:
        self._settings, self._make_env, self._place, self._repo_id = settings, make_env, place, repo_id
        self._console = Console(highlight=False)

    def record(self, episodes: int, workers: int) -> None:
        """Record until the dataset holds ``episodes`` successes of every task, unless it already does."""
        started = time.monotonic()
        finished = self._place.finished(episodes * len(self._settings.tasks))
        if finished is not None:
            self._say(f"already recorded: {summary_line(finished)}")
        else:
            made = self._make(episodes, workers)
            self._say(f"{summary_line(recording_report(self._settings, made))} in {time.monotonic() - started:.0f} s")
        self._say(f"dataset {self._repo_id} in {self._place.root}")

    def _say(self, line: str) -> None:
        self._console.print(line, soft_wrap=True)

    def _make(self, episodes: int, workers: int) -> list[Outcome]:
        with self._place.opened() as parts:
            outcomes = read_outcomes(parts)
            try:
                self._attempt(parts, outcomes, episodes, workers)
            except KeyboardInterrupt:
                self._say("stopped; finished episodes are kept and the same command goes on from there")
                raise
            made = made_attempts(outcomes, episodes, len(self._settings.tasks))
            self._place.commit(partial(self._write, parts, made))
        return made

    def _attempt(self, parts: Path, outcomes: dict[int, Outcome], episodes: int, workers: int) -> None:
        setup = WorkerSetup(
            directory=parts,
            tasks=self._settings.tasks,
            make_env=self._make_env,
            cameras=self._settings.cameras,
            stride=self._settings.stride,
            seed=self._settings.seed,
        )
        # LeRobot takes long to import and is needed only at the end.
        threading.Thread(target=importlib.import_module, args=("dataset_tools.assembly",), daemon=True).start()
        tasks = self._settings.tasks
        total = episodes * len(tasks)
        with progress_bar(self._console) as progress:
            bar = progress.add_task(tasks[0] if len(tasks) == 1 else f"{len(tasks)} tasks", total=total)
            progress.update(bar, completed=total - len(missing_attempts(outcomes, episodes, len(tasks))))
            for _ in make_attempts(setup, workers, outcomes, episodes):
                progress.update(bar, completed=total - len(missing_attempts(outcomes, episodes, len(tasks))))

    def _write(self, parts: Path, made: list[Outcome], root: Path) -> None:
        from dataset_tools.assembly import assemble

        features = dense_features(self._settings.cameras, self._settings.image_size)
        kept = [outcome for outcome in made if outcome.success]
        assemble(parts, kept, features, self._settings.fps, self._repo_id, root)
        write_json(root / RECORDING_FILE, recording_report(self._settings, made))

"""``histmv view``: watch the scripted expert of a task, in a window or as a video."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from dataset_tools.eval_settings import REPORTED_SEEDS
from dataset_tools.record import RecordEnvConfig
from dataset_tools.video import VideoWriter
from lerobot_histmv.envs import UR5Env, make
from lerobot_histmv.envs.tasks import suites
from lerobot_histmv.motion import TICK

END_FRAMES = 20
"""The last picture of a video stays for a second."""
LOOK_AT = (0.4, 0.0, 0.1)
"""What the window shows first [m] ..."""
LOOK_FROM = (1.6, 150.0, -30.0)
"""... and from where: distance [m], azimuth and elevation [degrees]."""


def has_display() -> bool:
    """Whether a window can be opened."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@dataclass
class ViewConfig:
    """Watch the expert of a task: histmv view --env.task=turn_tap.

    Of several tasks, or a suite, one is shown after the other.
    """

    # the task and its options, as for `histmv record`
    env: RecordEnvConfig = field(default_factory=lambda: RecordEnvConfig(image_size=256))
    # scene
    seed: int = REPORTED_SEEDS
    # scenes to show, one after the other
    episodes: int = 1
    # open an interactive window; without one, videos are written
    window: bool = field(default_factory=has_display)
    # folder of the videos, one per task, with the cameras side by side
    output: Path = Path("outputs/view")


def run(config: ViewConfig) -> None:
    """Show or film the experts.

    Raises:
        ValueError: an option is not accepted.
    """
    if config.episodes < 1:
        raise ValueError(f"episodes is {config.episodes}; it must be at least 1")
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}; it must be at least 0")
    for task in suites.expand(config.env.task):
        view(task, config, Console(highlight=False))


def view(task: str, config: ViewConfig, console: Console) -> None:
    """Show or film the expert of one task."""
    options = config.env
    env = make(
        task,
        cameras=tuple(options.cameras),
        image_size=options.image_size,
        render_size=options.image_size,
        variation=options.variation,
        disturbances=options.disturbances,
    )
    path = config.output / f"{task}_{config.seed}.mp4"
    with window(env) if config.window else film(env, path) as show:
        for seed in range(config.seed, config.seed + config.episodes):
            _, info = env.reset(seed=seed)
            with env.stage.watching(show):
                for motion in env.expert():
                    env.execute(motion)
            outcome = "success" if env.is_success() else env.failure()
            console.print(f"{task}, scene {seed}: {info['instruction']}: {outcome}", soft_wrap=True)
        if config.window:
            console.print("close the window to go on")
    env.close()
    if not config.window:
        console.print(f"video: {path}", soft_wrap=True)


@contextmanager
def film(env: UR5Env, path: Path) -> Iterator[Callable[[], None]]:
    """A function that adds what the cameras see to the video."""
    with VideoWriter(path, fps=round(1 / TICK)) as video:

        def show() -> None:
            video.add(np.hstack(list(env.observe()["pixels"].values())))

        yield show
        for _ in range(END_FRAMES):
            show()


@contextmanager
def window(env: UR5Env) -> Iterator[Callable[[], None]]:
    """A function that shows the scene in MuJoCo's viewer in real time; it stays open until someone closes it."""
    import mujoco.viewer

    env.reset(seed=0)
    simulation = env.stage.simulation
    model, data = simulation.model, simulation.data
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        viewer.cam.lookat[:] = LOOK_AT
        viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = LOOK_FROM

        def show() -> None:
            if not viewer.is_running():
                raise KeyboardInterrupt
            viewer.sync()
            time.sleep(TICK)

        yield show
        while viewer.is_running():
            time.sleep(TICK)

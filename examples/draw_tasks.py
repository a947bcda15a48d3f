"""Pictures and films of the tasks, and the page that shows them.

    python examples/draw_tasks.py [turn_tap stack_cups ...]

Writes ``docs/images/tasks/<task>.png`` (the start of an episode from every camera) and ``.webp`` (the expert, from the
front), the overview ``docs/images/scenes.png``, and the list of tasks at the end of ``docs/tasks.md``, from the
docstrings.
"""

import inspect
import sys
from itertools import batched
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from lerobot_histmv.envs import TASKS, UR5Env, make
from lerobot_histmv.envs.tasks.suites import SUITES

PAGE = Path(__file__).parents[1] / "docs" / "tasks.md"
PICTURES = PAGE.parent / "images" / "tasks"
OVERVIEW = PAGE.parent / "images" / "scenes.png"
COLUMNS = 6
HEADING = "## The tasks\n"
INTRODUCTION = "Seen from front, left shoulder and wrist at the start of an episode; then what the expert does.\n"
SEED = 200_000
SIZE = 192
FILM_FPS = 10
FILM_EVERY = 2
"""The simulation runs at 20 ticks per second."""


def draw(env: UR5Env) -> None:
    """Start and film of one episode."""
    observation, _ = env.reset(seed=SEED)
    start = np.hstack(list(observation["pixels"].values()))
    Image.fromarray(start).save(PICTURES / f"{env.task}.png", optimize=True)
    frames = []
    with env.stage.watching(lambda: frames.append(env.render())):
        for motion in env.expert():
            env.execute(motion)
    first, *others = [Image.fromarray(frame) for frame in [*frames[::FILM_EVERY], *frames[-1:] * FILM_FPS]]
    film = PICTURES / f"{env.task}.webp"
    first.save(film, save_all=True, append_images=others, duration=1000 // FILM_FPS, loop=0, quality=40, method=4)


def overview() -> Image.Image:
    """The left shoulder's view of the single tasks, side by side."""
    sheets = [Image.open(PICTURES / f"{task}.png").convert("RGB") for task in SUITES["all"]]
    views = [np.asarray(sheet.crop((SIZE, 0, 2 * SIZE, SIZE))) for sheet in sheets]
    rows = [np.hstack(row) for row in batched(views, COLUMNS)]
    return Image.fromarray(np.vstack(rows))


def section(task: str) -> str:
    """A task's part of the page."""
    title = f"### `{task}`\n"
    pictures = f"![{task} from three cameras](images/tasks/{task}.png) ![the expert](images/tasks/{task}.webp)\n"
    return "\n".join([title, pictures, f"{inspect.getdoc(TASKS[task])}\n"])


def page() -> str:
    """The page with its list of tasks renewed."""
    before, _, _ = PAGE.read_text(encoding="utf-8").partition(HEADING)
    return "\n".join([before + HEADING, INTRODUCTION, *map(section, TASKS)])


def main(tasks: list[str]) -> None:
    """Draw the given tasks; write the page of all."""
    PICTURES.mkdir(exist_ok=True)
    for task in tqdm(tasks, unit="task"):
        env = make(task, image_size=SIZE, render_size=SIZE)
        draw(env)
        env.close()
    overview().save(OVERVIEW, optimize=True)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:] or list(TASKS))

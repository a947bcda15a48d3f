"""Draws the start of one episode of each task from every camera.

``python examples/draw_scenes.py docs/images/scenes.png``
"""

import sys

import numpy as np
from PIL import Image

from lerobot_histmv import envs

TASKS = ("reach_target", "push_buttons", "pick_and_lift")
SEED = 200_000
SIZE = 256


def main(path: str) -> None:
    """One row per task, one column per camera."""
    rows = []
    for task in TASKS:
        env = envs.make(task, image_size=SIZE)
        observation, _ = env.reset(seed=SEED)
        rows.append(np.hstack(list(observation["pixels"].values())))
        env.close()
    Image.fromarray(np.vstack(rows)).save(path, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])

"""The disturbances that cameras see, side by side: ``docs/images/disturbances.png``.

    python examples/draw_disturbances.py

Top: colour of the left shoulder camera. Bottom: its depth, black where there is none.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from lerobot_histmv.envs import make
from lerobot_histmv.envs.disturbances import Disturbances

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "disturbances.png"
TASK, CAMERA, SEED = "stack_cups", "left_shoulder", 200_000
SHOWN = (
    {},
    {"lighting": 1},
    {"lighting": 3},
    {"rgb_noise": 1},
    {"rgb_noise": 3},
    {"depth": 1},
    {"depth": 3},
    {"occluder": 1},
    {"dead_camera": 1},
    {"distractors": 4},
)
NEAR, FAR = 500, 1100
"""Range of depth [mm] that is coloured."""


def main() -> None:
    """Draw them all in the scene of one seed."""
    figure, axes = plt.subplots(2, len(SHOWN), figsize=(1.6 * len(SHOWN), 3.5), layout="constrained")
    for (top, bottom), strengths in zip(axes.T, SHOWN, strict=True):
        env = make(TASK, cameras=(CAMERA,), disturbances=Disturbances(**strengths))
        observation, _ = env.reset(seed=SEED)
        env.close()
        depth = observation[f"{CAMERA}_depth"][..., 0]
        top.imshow(observation["pixels"][CAMERA])
        bottom.imshow(np.ma.masked_equal(depth, 0), cmap="viridis_r", vmin=NEAR, vmax=FAR)
        bottom.set_facecolor("black")
        top.set_title("\n".join(f"{name}={strength}" for name, strength in strengths.items()) or "clean", fontsize=9)
        for axis in (top, bottom):
            axis.set(xticks=[], yticks=[])
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()

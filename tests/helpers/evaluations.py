"""Results of evaluations, as ``histmv eval`` writes them, of scenes that nobody simulated."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fake_ur5 import CAMERAS
from helpers.keyframed import SIZE
from tiny_policy import TASK

from dataset_tools.eval_checkpoint import PolicySource
from dataset_tools.eval_results import INFO_FILE, Episode, evaluation_info
from dataset_tools.eval_settings import EvaluateConfig, ScenesConfig
from dataset_tools.evaluate import Evaluation
from lerobot_histmv.envs.configuration_ur5 import UR5EnvConfig

TASKS = ("reach_target.red", "turn_tap.left")
SEEDS = range(200_019, 200_022)


def evaluated(folder: Path, checkpoint: Path, overrides: Sequence[str] = (), **env: Any) -> Path:
    """An evaluation of a checkpoint for images of ``SIZE`` on two tasks, in which the second seed fails."""
    config = EvaluateConfig(
        env=UR5EnvConfig(task=",".join(TASKS), cameras=list(CAMERAS), image_size=SIZE, **env),
        policy=PolicySource(str(checkpoint), list(overrides)),
        eval=ScenesConfig(n_episodes=len(SEEDS)),
        seed=SEEDS[0],
        output_dir=folder,
    )
    finished = {
        (task, 0): [
            Episode(task, seed, seed != SEEDS[1], "time" if seed == SEEDS[1] else "", 3, 1.0, 1.0, TASK, 17.0, 0.5)
            for seed in SEEDS
        ]
        for task in TASKS
    }
    folder.mkdir()
    info = evaluation_info(finished, folder, Evaluation(config).provenance())
    (folder / INFO_FILE).write_text(json.dumps(info))
    return folder

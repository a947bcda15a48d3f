"""LeRobot's own commands, unchanged: train on a dataset from the Hub, push the policy, evaluate it by its name."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
import yaml
from helpers.episodes import JOINTS, image_feature, vector_feature, write
from helpers.hub_client import environment
from helpers.hub_server import Hub, serve
from huggingface_hub import ModelCard
from tiny_policy import CAMERAS
from tiny_scene import SEEN, cameras_around, tiny_network

from lerobot_histmv import keys

SIZE = 32
STEPS = 2


def keyframed(root: Path) -> Path:
    """Two episodes of two rows, noise in the size that the environment is asked for."""
    features: dict[str, Any] = {
        keys.STATE: vector_feature((*keys.POSE_NAMES, *JOINTS)),
        keys.ACTION: vector_feature(keys.POSE_NAMES),
        keys.INTRINSICS: vector_feature(keys.intrinsics_names(CAMERAS)),
        keys.EXTRINSICS: vector_feature(keys.extrinsics_names(CAMERAS)),
    }
    for camera in CAMERAS:
        features[keys.rgb_key(camera)] = image_feature(3, size=(SIZE, SIZE))
        depth = {**image_feature(1, size=(SIZE, SIZE)), "info": {"is_depth_map": True}}
        features[keys.depth_key(camera)] = depth
    chance = np.random.default_rng(0)
    intrinsics, extrinsics = (values.numpy().ravel() for values in cameras_around(len(CAMERAS)))
    pose = np.float32([*SEEN, 1, 0, 0, 0, 1])
    frame: dict[str, Any] = {keys.STATE: np.append(pose, np.zeros(6, np.float32)), keys.ACTION: pose}
    frame |= {keys.INTRINSICS: intrinsics, keys.EXTRINSICS: extrinsics}
    for camera in CAMERAS:
        frame[keys.rgb_key(camera)] = chance.integers(256, size=(SIZE, SIZE, 3), dtype=np.uint8)
        frame[keys.depth_key(camera)] = chance.integers(300, 700, size=(SIZE, SIZE, 1), dtype=np.uint16)
    return write(root, [[frame] * 2] * 2, features)


def command(hub: Hub, home: Path, name: str, *words: str) -> str:
    """What a console script prints; it must succeed."""
    run = [Path(sys.executable).parent / name, *words]
    variables = environment(hub.url, home, "token-of-ann")
    result = subprocess.run(run, capture_output=True, text=True, env=variables, cwd=home)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


@pytest.mark.slow
def test_train_on_pulled_data_push_the_policy_and_evaluate_it_by_name(tmp_path: Path) -> None:
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    for folder in (here, elsewhere):
        folder.mkdir()
    settings = {
        "policy": {"type": "histmv", "device": "cpu", "network": draccus.encode(tiny_network())},
        "dataset": {"repo_id": "ann/keys", "depth_output_unit": "mm", "use_imagenet_stats": False},
        "steps": STEPS,
        "save_freq": STEPS,
        "batch_size": 2,
        "num_workers": 0,
        "env_eval_freq": 0,
        "log_freq": 1,
    }
    (here / "train.yaml").write_text(yaml.safe_dump(settings))
    with serve(ann="token-of-ann") as hub:
        command(hub, here, "histmv", "push", f"--root={keyframed(tmp_path / 'keys')}", "--repo_id=ann/keys")
        push = ["--policy.push_to_hub=true", "--policy.repo_id=ann/policy", "--policy.private=true"]
        said = command(hub, elsewhere, "lerobot-train", f"--config_path={here}/train.yaml", *push, "--output_dir=train")
        assert f"Model pushed to {hub.url}/ann/policy" in said
        repo = hub.repo("model", "ann/policy")
        assert repo.private
        files = {path: file.content for path, file in repo.tree("main").items()}
        saved = elsewhere / "train/checkpoints/last/pretrained_model"
        assert {path.name: files[path.name] for path in saved.iterdir()} == {
            path.name: path.read_bytes() for path in saved.iterdir()
        }
        card = ModelCard(files["README.md"].decode())
        assert card.data["datasets"] == ["ann/keys"]
        assert f"{STEPS}, batches of 2" in card.text
        env = ["--env.type=ur5", "--env.task=reach_target", "--env.cameras=[front,wrist]", f"--env.image_size={SIZE}"]
        few = ["--eval.n_episodes=1", "--eval.batch_size=1", "--output_dir=eval", "--policy.device=cpu"]
        command(hub, here, "lerobot-eval", "--policy.path=ann/policy", *env, *few)
    assert json.loads((here / "eval/eval_info.json").read_text())["overall"]["n_episodes"] == 1

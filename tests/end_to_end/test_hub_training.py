"""LeRobot's own commands, unchanged: train on a dataset from the Hub, push the policy, evaluate it by its name."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from helpers.hub_client import environment
from helpers.hub_server import Hub, serve
from helpers.keyframed import SIZE, keyframed, training
from huggingface_hub import ModelCard

STEPS = 2


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
    settings = training("ann/keys", steps=STEPS, save_freq=STEPS, batch_size=2)
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

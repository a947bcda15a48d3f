"""``lerobot-train`` goes on where it was stopped, on one process and on two, and from either with the other."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from helpers.keyframed import keyframed, training
from helpers.ranks import in_ranks, lerobot_train
from safetensors.torch import load_file

LENGTHS = (2, 3, 2)
STEPS, STOPPED = 9, 5
"""Seven rows in batches of two are four steps of one process, or two of two processes whose last one takes rows from
the epoch's beginning. Five steps stop both in the middle of a later epoch, nine end both in one after that."""

WEIGHTS, TRAINING = "pretrained_model", "training_state"
SCHEDULE = f"{TRAINING}/scheduler_state.json"

Train = Callable[[int], Path]


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Train:
    """Output folder of a training without interruption on so many processes."""
    folder = tmp_path_factory.mktemp("resume")
    settings = training("local/keys", steps=STEPS, save_freq=STOPPED, batch_size=2, seed=5)
    settings["dataset"]["root"] = str(keyframed(folder / "keys", LENGTHS))
    settings["policy"]["push_to_hub"] = False
    (folder / "train.yaml").write_text(yaml.safe_dump(settings))

    def run(processes: int) -> Path:
        output = folder / f"straight_{processes}"
        if not output.is_dir():
            words = [f"--config_path={folder}/train.yaml", f"--output_dir={output}"]
            in_ranks(processes, folder / f"straight_{processes}.log", lerobot_train, words)
        return output

    return run


def train_and_note(rank: int, words: list[str], folder: Path) -> None:
    """``lerobot-train``; just before its first step each rank writes what it holds into ``folder``."""
    from lerobot.optim import save_optimizer_state, save_scheduler_state
    from lerobot.scripts import lerobot_train as script

    update = script.update_policy

    def first_update(metrics: Any, policy: Any, batch: Any, optimizer: Any, *arguments: Any, **options: Any) -> Any:
        script.update_policy = update
        training = folder / f"{rank}/{TRAINING}"
        training.mkdir(parents=True)
        options["accelerator"].unwrap_model(policy).save_pretrained(folder / f"{rank}/{WEIGHTS}")
        save_optimizer_state(optimizer, training)
        save_scheduler_state(options["lr_scheduler"], training)
        return update(metrics, policy, batch, optimizer, *arguments, **options)

    script.update_policy = first_update
    lerobot_train(rank, words)


def resumed(straight: Path, processes: int, output: Path) -> str:
    """Goes on from the earlier checkpoint of ``straight`` in new processes; what they log."""
    first = checkpoint(straight, STOPPED)
    shutil.copytree(first, output / "checkpoints" / first.name)
    (output / "checkpoints/last").symlink_to(first.name)
    config = output / "checkpoints/last/pretrained_model/train_config.json"
    log = output / "log.txt"
    words = [f"--config_path={config}", "--resume=true", f"--output_dir={output}"]
    in_ranks(processes, log, train_and_note, words, output / "resumed")
    return log.read_text()


def checkpoint(output: Path, step: int) -> Path:
    return output / f"checkpoints/{step:06d}"


def state(folder: Path) -> dict[str, torch.Tensor]:
    """Weights, and the optimizer's averages, of a checkpoint."""
    files = (f"{WEIGHTS}/model.safetensors", f"{TRAINING}/optimizer_state.safetensors")
    return {f"{file}: {name}": value for file in files for name, value in load_file(folder / file).items()}


def differing(found: Path, expected: Path) -> list[str]:
    """Names of the tensors that two checkpoints do not have in common, bit for bit."""
    one, other = state(found), state(expected)
    assert one.keys() == other.keys()
    return [name for name, value in one.items() if not value.equal(other[name])]


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_resumed_training_ends_bit_for_bit_as_one_without_interruption(
    train: Train, processes: int, tmp_path: Path
) -> None:
    straight = train(processes)
    resumed(straight, processes, tmp_path)
    assert differing(checkpoint(tmp_path, STEPS), checkpoint(straight, STEPS)) == []


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1)])
def test_checkpoints_load_on_another_number_of_processes(train: Train, before: int, after: int, tmp_path: Path) -> None:
    """Every rank begins with the weights, the optimizer's averages and the learning rate that were stored."""
    stored = checkpoint(train(before), STOPPED)
    said = resumed(train(before), after, tmp_path)
    assert f"Effective batch size: 2 x {after} = {2 * after}" in said
    for rank in range(after):
        loaded = tmp_path / f"resumed/{rank}"
        assert differing(loaded, stored) == []
        assert (loaded / SCHEDULE).read_text() == (stored / SCHEDULE).read_text()
    assert differing(checkpoint(tmp_path, STEPS), stored) != [], "and learns on"

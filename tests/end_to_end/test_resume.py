"""``lerobot-train`` goes on where it was stopped, on one process and on two, and from either with the other."""

import json
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from helpers.keyframed import keyframed, training
from helpers.ranks import in_ranks, lerobot_train, lerobot_train_killed
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.random_utils import set_seed
from safetensors.torch import load_file

from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

LENGTHS = (2, 3, 2)
STEPS, STOPPED = 9, 5
"""Seven rows in batches of two are four steps of one process, or two of two processes whose last one takes rows from
the epoch's beginning. Five steps stop both in the middle of a later epoch, nine end both in one after that."""

WEIGHTS, OPTIMIZER = "pretrained_model/model.safetensors", "training_state/optimizer_state.safetensors"
GROUPS = "training_state/optimizer_param_groups.json"
ROUNDING = 0.9999
MOST_RATES = 1.1
"""Learning rates that Adam moves a weight by in a step, at most: 1.04 after nine steps (Cauchy-Schwarz), and decay."""

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


def leave_the_earlier_checkpoint_of(straight: Path, output: Path) -> None:
    """``output`` is as the uninterrupted training's folder was before its last steps."""
    first = straight / f"checkpoints/{STOPPED:06d}"
    shutil.copytree(first, output / "checkpoints" / first.name)
    (output / "checkpoints/last").symlink_to(first.name)


def kill_one_like(straight: Path, output: Path) -> None:
    """``output`` is what a training of one process leaves that is killed after its first checkpoint."""
    words = [f"--config_path={straight.parent}/train.yaml", f"--output_dir={output}"]
    in_ranks(1, straight.parent / "killed.log", lerobot_train_killed, words, end_with=-signal.SIGKILL)
    assert sorted(path.name for path in (output / "checkpoints").iterdir()) == [f"{STOPPED:06d}", "last"]


def resumed(processes: int, output: Path) -> str:
    """Goes on from the last checkpoint in ``output`` in new processes; what they log."""
    config = output / "checkpoints/last/pretrained_model/train_config.json"
    log = output / "log.txt"
    words = [f"--config_path={config}", "--resume=true", f"--output_dir={output}"]
    in_ranks(processes, log, lerobot_train, words)
    return log.read_text()


def state(output: Path, step: int = STEPS) -> dict[str, torch.Tensor]:
    """Weights, and the optimizer's averages and counts, of a checkpoint."""
    folder = output / f"checkpoints/{step:06d}"
    return {name: value for file in (WEIGHTS, OPTIMIZER) for name, value in load_file(folder / file).items()}


def losses(log: str) -> list[str]:
    """The logged losses of the steps after the stop."""
    curve = dict(re.findall(r"step:(\d+) .* loss:(\S+)", log))
    return [curve[str(step)] for step in range(STOPPED + 1, STEPS + 1)]


def rates() -> list[float]:
    """Learning rates of all steps."""
    config = HistMVConfig()
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(()))], lr=config.optimizer_lr)
    schedule, found = config.get_scheduler_preset().build(optimizer, STEPS), []
    for _ in range(STEPS):
        found += schedule.get_last_lr()
        optimizer.step()
        schedule.step()
    return found


def drawn_anew(checkpoint: Path) -> dict[str, torch.Tensor]:
    """The weights that a training with these settings starts with."""
    settings = TrainPipelineConfig.from_pretrained(checkpoint)
    set_seed(settings.seed)
    return HistMVPolicy(settings.policy).state_dict()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("processes", "stop"), [(1, kill_one_like), (2, leave_the_earlier_checkpoint_of)], ids=["killed", "two processes"]
)
def test_resumed_training_ends_bit_for_bit_as_one_without_interruption(
    train: Train, processes: int, stop: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    straight, output = train(processes), tmp_path / "stopped"
    stop(straight, output)
    log = resumed(processes, output)
    assert losses(log) == losses(straight.with_suffix(".log").read_text())
    expected, found = state(straight), state(output)
    assert expected.keys() == found.keys()
    assert [name for name, value in expected.items() if not value.equal(found[name])] == []


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1)])
def test_checkpoints_load_on_another_number_of_processes(train: Train, before: int, after: int, tmp_path: Path) -> None:
    """What a checkpoint holds bounds what few more steps of Adam can make of it, whatever rows they see.

    Weights that were not loaded but drawn anew are further away than both ways together.
    """
    straight = train(before)
    leave_the_earlier_checkpoint_of(straight, tmp_path)
    said = resumed(after, tmp_path)
    assert f"Effective batch size: 2 x {after} = {2 * after}" in said
    stored, found = state(straight, STOPPED), state(tmp_path)
    assert found.keys() == stored.keys()
    most = MOST_RATES * sum(rates()[STOPPED:])
    drawn = drawn_anew(straight / f"checkpoints/{STOPPED:06d}/pretrained_model")
    assert max((stored[name] - value).abs().max() for name, value in drawn.items()) > 2 * most, "else nothing is shown"
    (group,) = json.loads((straight / f"checkpoints/{STOPPED:06d}" / GROUPS).read_text())
    slowest = ROUNDING * group["betas"][1] ** (STEPS - STOPPED)  # the mean of squared gradients cannot fall faster
    for name, value in stored.items():
        if name.endswith("/step"):
            assert found[name] == value + STEPS - STOPPED, name
        elif name.endswith("/exp_avg_sq"):
            assert (found[name] >= slowest * value).all(), name
        elif not name.endswith("/exp_avg"):
            assert (found[name] - value).abs().max() <= most, name

"""What is saved is what is loaded: weights, configuration, processors, also in a fresh process; nothing else fits."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tiny_weights
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from safetensors import safe_open
from tiny_policy import TASK, episode, observation, tiny_config, tiny_policy, window
from tiny_scene import tiny_network

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.model.config import HistoryConfig, NetworkConfig, SemanticsConfig, TextureConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

ROOT = Path(__file__).parents[2]


def act(policy: HistMVPolicy) -> torch.Tensor:
    """Actions of the last of three steps."""
    policy.reset()
    rows = episode(3)
    return [policy.select_action(observation(rows, step)) for step in range(3)][-1]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[HistMVPolicy, Path]:
    """A policy, and the folder of its checkpoint with processors as ``lerobot-train`` writes it."""
    folder = tmp_path_factory.mktemp("checkpoint")
    policy = tiny_policy(seed=5)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config):
        processor.save_pretrained(folder)
    return policy, folder


def test_loaded_policy_acts_identically(saved: tuple[HistMVPolicy, Path]) -> None:
    policy, folder = saved
    torch.manual_seed(11)
    loaded = HistMVPolicy.from_pretrained(folder)
    assert not loaded.training
    assert act(loaded).equal(act(policy))


def test_loaded_configuration_is_equal_and_of_the_registered_type(saved: tuple[HistMVPolicy, Path]) -> None:
    policy, folder = saved
    config = PreTrainedConfig.from_pretrained(folder)
    assert isinstance(config, HistMVConfig)
    assert config == policy.config
    assert get_policy_class(config.type) is HistMVPolicy


def test_checkpoint_states_the_order_of_cameras_and_holds_no_data_of_the_dataset(
    saved: tuple[HistMVPolicy, Path],
) -> None:
    policy, folder = saved
    stored = json.loads((folder / "config.json").read_text())
    assert stored["cameras"] == policy.config.cameras
    assert stored["type"] == "histmv"
    with safe_open(folder / "model.safetensors", "pt") as weights:
        assert set(weights.keys()) == set(policy.state_dict())


def test_loading_a_checkpoint_fetches_no_weights_that_training_began_with(tmp_path: Path) -> None:
    """The checkpoint holds them, trained; a frozen tower is not in it and must keep its source."""
    began = NetworkConfig(
        texture=TextureConfig(backbone="resnet10t", pretrained=True),
        semantics=SemanticsConfig(clip_pretrained="somewhere.pt", train_clip=True),
    )
    config = tiny_config(network=began)
    config._save_pretrained(tmp_path)
    stored = PreTrainedConfig.from_pretrained(tmp_path).network
    assert not stored.texture.pretrained
    assert stored.semantics == SemanticsConfig(train_clip=True)
    assert config.network is began, "the running configuration still says what it began with"
    tiny_config(network=replace(began, semantics=SemanticsConfig(clip_pretrained="kept.pt")))._save_pretrained(tmp_path)
    assert PreTrainedConfig.from_pretrained(tmp_path).network.semantics.clip_pretrained == "kept.pt"


def test_training_continues_from_a_loaded_policy(saved: tuple[HistMVPolicy, Path]) -> None:
    policy, folder = saved
    batch = window(episode(5), 4)
    torch.testing.assert_close(HistMVPolicy.from_pretrained(folder)(batch)[0], policy(batch)[0])


FRESH = """
import sys, json, torch
sys.path.insert(0, sys.argv[2])
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
config = PreTrainedConfig.from_pretrained(sys.argv[1])
before, after = make_pre_post_processors(config, pretrained_path=sys.argv[1])
policy = get_policy_class(config.type).from_pretrained(sys.argv[1])
from tiny_policy import episode, observation
rows = episode(3)
actions = [after(policy.select_action(before(observation(rows, step)))) for step in range(3)]
print(json.dumps([type(step).__name__ for step in before.steps]))
print(json.dumps(actions[-1].tolist()))
"""


@pytest.mark.slow  # a fresh process imports LeRobot again
def test_fresh_process_loads_policy_and_processors_through_lerobot(saved: tuple[HistMVPolicy, Path]) -> None:
    policy, folder = saved
    command = [sys.executable, "-c", FRESH, str(folder), str(ROOT / "tests")]
    result = subprocess.run(command, cwd=ROOT, env=os.environ, capture_output=True, text=True, check=True)
    steps, action = (json.loads(line) for line in result.stdout.splitlines()[-2:])
    assert "CheckInputStep" in steps
    torch.testing.assert_close(torch.tensor(action), act(policy))


def test_loaded_processors_check_the_same_cameras(saved: tuple[HistMVPolicy, Path]) -> None:
    policy, folder = saved
    before, _ = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    batch = observation(episode(1), 0)
    del batch[keys.depth_key("wrist")]
    with pytest.raises(ValueError, match=r"'observation.images.wrist_depth'.*\['front', 'wrist'\]"):
        before(batch)


FROZEN = {
    "clip": lambda path: SemanticsConfig(clip_pretrained=str(tiny_weights.clip_file(path))),
    "r3m": lambda path: SemanticsConfig(image="r3m", r3m_pretrained=str(tiny_weights.r3m_file(path))),
}
"""Image towers that are never trained, with weights in a file."""


@pytest.fixture(scope="module", params=FROZEN)
def frozen(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NetworkConfig]:
    """A file of weights, and a network with the tower that takes them."""
    path = tmp_path_factory.mktemp("weights") / "tower.pt"
    return path, tiny_network(semantics=FROZEN[request.param](path))


def test_a_frozen_tower_is_not_copied_into_checkpoints(frozen: tuple[Path, NetworkConfig], tmp_path: Path) -> None:
    path, network = frozen
    policy = tiny_policy(tiny_config(network=network))
    policy.save_pretrained(tmp_path)
    assert (tmp_path / "model.safetensors").stat().st_size < path.stat().st_size / 2
    torch.manual_seed(11)
    assert act(HistMVPolicy.from_pretrained(tmp_path)).equal(act(policy))


def test_a_checkpoint_whose_frozen_weights_are_gone_says_which_and_what_else_is_accepted(
    frozen: tuple[Path, NetworkConfig], tmp_path: Path
) -> None:
    path, network = frozen
    tiny_policy(tiny_config(network=network)).save_pretrained(tmp_path / "checkpoint")
    path.rename(tmp_path / "elsewhere.pt")
    try:
        with pytest.raises(ValueError, match=rf"semantics\.(clip|r3m)_pretrained='{path}'"):
            HistMVPolicy.from_pretrained(tmp_path / "checkpoint")
    finally:
        (tmp_path / "elsewhere.pt").rename(path)


def test_trained_clip_started_from_a_file_does_belong_to_the_checkpoint(tmp_path: Path) -> None:
    file = tiny_weights.clip_file(tmp_path / "clip.pt")
    trained = tiny_network(semantics=SemanticsConfig(clip_pretrained=str(file), train_clip=True))
    policy = tiny_policy(tiny_config(network=trained))
    with torch.no_grad():
        for parameter in policy.get_optim_params()[0]["params"]:
            parameter.add_(0.01)
    policy.save_pretrained(tmp_path)
    assert act(HistMVPolicy.from_pretrained(tmp_path)).equal(act(policy))


def other_configurations() -> dict[str, Any]:
    network = tiny_network()
    return {
        "wider": replace(network, width=16),
        "another layer": replace(network, history=HistoryConfig(past_steps=2, layers=3, heads=2)),
        "a layer less": replace(network, history=HistoryConfig(past_steps=2, layers=1, heads=2)),
        "longer history": replace(network, history=HistoryConfig(past_steps=3, layers=2, heads=2)),
    }


@pytest.mark.parametrize("difference", other_configurations())
def test_checkpoint_of_another_configuration_is_refused(saved: tuple[HistMVPolicy, Path], difference: str) -> None:
    _, folder = saved
    config = tiny_config(network=other_configurations()[difference])
    with pytest.raises(ValueError, match="checkpoint"):
        HistMVPolicy.from_pretrained(folder, config=config)


def test_truncated_weights_are_refused(saved: tuple[HistMVPolicy, Path], tmp_path: Path) -> None:
    _, folder = saved
    for name in ("config.json", "model.safetensors"):
        content = (folder / name).read_bytes()
        (tmp_path / name).write_bytes(content[: len(content) // 2] if name.endswith("safetensors") else content)
    with pytest.raises(Exception, match=r"(?i)incomplete|invalid|header|truncated"):
        HistMVPolicy.from_pretrained(tmp_path)


def test_instructions_survive_with_their_paraphrases(tmp_path: Path) -> None:
    table = {TASK: [TASK, "lift the cube « rouge »"], 'press "stop"': ['press "stop"']}
    tiny_policy(tiny_config(instructions=table)).save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(config, HistMVConfig)
    assert config.instructions == table


def test_fine_tuning_on_another_dataset_adds_its_instructions(saved: tuple[HistMVPolicy, Path], tmp_path: Path) -> None:
    _, folder = saved
    tasks = SimpleNamespace(index=["press the green button"])
    other = SimpleNamespace(root=tmp_path, tasks=tasks)
    loaded = HistMVPolicy.from_pretrained(folder, dataset_meta=other)
    assert {TASK, "press the green button"} <= set(loaded.config.instructions)

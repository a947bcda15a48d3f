"""Every ablation and the presets beside it: the file trains a network without idle weights, which acts as it learns."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from test_configs import load
from test_policy_acting import LONG, act, whole_window
from tiny_policy import CAMERAS, STILL, episode, policy_features, stack, tiny_policy, window
from tiny_weights import clip_file

from dataset_tools import config_files
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.geometry import canonical
from lerobot_histmv.model.config import NetworkConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

ABLATIONS = [name for name in config_files.names() if name.startswith("ablation/")]
PRESETS = ["train/paper", "train/hiveformer"]
DEFAULT = "train/default"


def read(name: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load(config_files.find(name).read_text())
    return content


def shrunk(network: NetworkConfig, clip: Path) -> NetworkConfig:
    """The same switches in a network of the smallest size; frozen CLIP weights come from a file."""
    named = network.semantics.clip_pretrained is not None
    small = {"clip_model": "tiny", "clip_pretrained": str(clip) if named else None}
    return replace(
        network,
        width=8,
        texture=replace(network.texture, widths=(4, 4, 8, 8), neck=4),
        semantics=replace(network.semantics, **small),
        points=replace(network.points, samples=53, centres=(13, 7), radii=(0.1, 0.3), neighbours=3),
        history=replace(network.history, past_steps=LONG - 1, heads=2),
    )


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clip_file(tmp_path_factory.mktemp("clip") / "tiny.pt")


@pytest.fixture(params=[*ABLATIONS, *PRESETS])
def policy(request: pytest.FixtureRequest, clip: Path, monkeypatch: pytest.MonkeyPatch) -> HistMVPolicy:
    config = load(config_files.find(request.param), monkeypatch).policy
    assert isinstance(config, HistMVConfig)
    config.device, config.cameras, config.augment = "cpu", list(CAMERAS), STILL
    config.instructions = {"pick up the red cube": ["pick up the red cube", "lift the red cube"]}
    config.input_features, config.output_features = policy_features(CAMERAS)
    config.network = shrunk(config.network, clip)
    return tiny_policy(config)


def test_one_training_step_teaches_every_weight_and_acting_equals_the_whole_window(policy: HistMVPolicy) -> None:
    rows = episode(LONG, seed=3)
    actions = act(policy, rows, LONG)
    with torch.no_grad():
        _, predicted, views, _ = whole_window(policy, rows, LONG)
    torch.testing.assert_close(actions[:, :3], predicted.position, atol=1e-5, rtol=0)
    quaternions = torch.from_numpy(canonical(predicted.quaternion.numpy())).float()
    torch.testing.assert_close(actions[:, 3:7], quaternions, atol=1e-5, rtol=0)
    decision = policy.last_decision
    assert decision is not None
    assert decision.view.equal(views[-1:, 1])
    assert decision.heat.shape == (1, *policy.config.image_size)

    loss, log = policy.train()(stack([window(rows, end, LONG - 1) for end in (1, 4)]))
    loss.backward()
    assert all(math.isfinite(value) for value in log.values())
    assert [name for name, p in policy.named_parameters() if p.grad is None] == []
    assert ("mutual_information" in log) == (policy.config.network.views.fusion == "attention")
    policy.config.get_optimizer_preset().build(policy.get_optim_params()).step()
    assert all(parameter.isfinite().all() for parameter in policy.parameters())


def test_all_rows_of_the_table_exist() -> None:
    """Paper table 4 has every combination of three modules but that without any."""
    modules = {"mva": ["mva"], "history": ["history"], "st": ["st"]}
    rows = {name.removeprefix("ablation/") for name in ABLATIONS} - {"full", "clip_only", "panet_only"}
    pairs = {"mva_history", "mva_st", "history_st"}
    assert rows == set(modules) | pairs


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_differs_from_the_default_preset_in_its_switches_only(name: str) -> None:
    content, default = read(name), read(DEFAULT)
    network = content["policy"].pop("network", {})
    assert content == default
    modules = name.removeprefix("ablation/").split("_")
    if modules[-1] != "only" and modules != ["full"]:
        assert ("history" in network) == ("history" not in modules)
        assert ("views" in network) == ("mva" not in modules)
        assert ("texture" in network) == ("semantics" in network) == ("st" not in modules)


def test_the_paper_s_preset_is_the_paper_s(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = load(config_files.find("train/paper"), monkeypatch)
    assert isinstance(cfg.policy, HistMVConfig)
    network, loss = cfg.policy.network, cfg.policy.loss
    assert (cfg.batch_size, cfg.steps, cfg.policy.get_optimizer_preset().lr) == (16, 100_000, 5e-4)
    assert len(cfg.policy.cameras) == 3
    assert not network.texture.use_xyz
    assert network.texture.encoder == "panet"
    assert (network.semantics.clip_model, network.semantics.trained) == ("ViT-B-32", False)
    assert (network.views.mi_loss, network.views.act) == ("literal", "weight")
    assert not any(vars(network.decoder).values())
    assert loss.gripper == "mse"
    assert loss.heatmap == loss.choice == loss.paraphrase == 0

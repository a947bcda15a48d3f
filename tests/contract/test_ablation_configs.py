"""Every ablation and the presets beside it: the file trains a network without idle weights, which acts as it learns."""

import math
import re
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
from lerobot_histmv.model.config import HistoryConfig, LossConfig, NetworkConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

ABLATIONS = [name for name in config_files.names() if name.startswith("ablation/")]
PRESETS = ["train/paper", "train/hiveformer"]
DEFAULT = "train/default"
OFF: dict[str, dict[str, dict[str, Any]]] = {
    "mva": {"views": {"fusion": "mean"}},
    "history": {"history": {"enabled": False}},
    "st": {"texture": {"encoder": "backbone"}, "semantics": {"image": "none"}},
}
"""What each column of the documentation's table means when it says off, in the order of the columns."""
OTHERS: dict[str, dict[str, dict[str, Any]]] = {
    "clip_only": {"texture": {"encoder": "none"}},
    "panet_only": {"semantics": {"image": "none"}},
    "one_view": {"views": {"decode": "one"}},
}
"""What the rows without a number change."""
TEXT = (Path(__file__).parents[2] / "docs/ablations.md").read_text()
ROWS = re.findall(r"^\| \d \| (on|off) \| (on|off) \| (on|off) \|.*`ablation/(\w+)` \|$", TEXT, re.MULTILINE)
DOCUMENTED = {
    name: frozenset(module for module, word in zip(OFF, words, strict=True) if word == "off") for *words, name in ROWS
}
"""Modules that each numbered row of the documentation's table switches off."""


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
    assert set(DOCUMENTED) | set(OTHERS) == {name.removeprefix("ablation/") for name in ABLATIONS}
    off = set(DOCUMENTED.values())
    assert len(off) == len(DOCUMENTED) == 2 ** len(OFF) - 1
    assert frozenset(OFF) not in off


def test_names_of_the_files_are_those_of_the_modules_that_are_on() -> None:
    names = {name: frozenset(OFF) - off for name, off in DOCUMENTED.items()}
    assert names.pop("full") == frozenset(OFF)
    assert {name: frozenset(name.split("_")) for name in names} == names


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_is_the_default_preset_without_what_the_documentation_says(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, default = read(name), read(DEFAULT)
    content["policy"].pop("network", None)
    assert content == default, "nothing but switches of the network differs"
    row, expected = name.removeprefix("ablation/"), {}
    for switches in [OTHERS[row]] if row in OTHERS else [OFF[module] for module in DOCUMENTED[row]]:
        expected |= switches
    network, policy = NetworkConfig(), load(config_files.find(name), monkeypatch).policy
    assert isinstance(policy, HistMVConfig)
    changed = {part: replace(getattr(network, part), **values) for part, values in expected.items()}
    assert policy.network == replace(network, **changed)


def test_the_default_preset_has_all_that_ablations_switch_off() -> None:
    network = NetworkConfig()
    assert network.history.enabled
    assert (network.views.fusion, network.views.decode) == ("attention", "all")
    assert (network.texture.encoder, network.semantics.image) == ("panet", "clip")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_take_what_the_paper_leaves_open_from_hiveformer(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the decay: a cosine that ends at 0, as Hiveformer's straight line does."""
    documented = re.search(r"weight decay (\S+), clipping at (\d+), ([\d,]+) steps of warm-up", TEXT)
    assert documented is not None
    cfg = load(config_files.find(name), monkeypatch)
    policy = cfg.policy
    assert isinstance(policy, HistMVConfig)
    optimizer = policy.get_optimizer_preset()
    assert (cfg.batch_size, cfg.steps, optimizer.lr) == (16, 100_000, 5e-4)
    assert (
        (optimizer.weight_decay, optimizer.grad_clip_norm) == (float(documented[1]), float(documented[2])) == (1e-3, 5)
    )
    assert policy.warmup_fraction * cfg.steps == int(documented[3].replace(",", "")) == 2000
    assert policy.final_lr_fraction == 0


def test_the_paper_s_preset_is_the_paper_s(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = load(config_files.find("train/paper"), monkeypatch)
    assert isinstance(cfg.policy, HistMVConfig)
    network, loss = cfg.policy.network, cfg.policy.loss
    assert len(cfg.policy.cameras) == 3
    assert (network.texture.encoder, network.texture.language, network.texture.use_xyz) == ("panet", False, False)
    semantics = network.semantics
    assert (semantics.image, semantics.clip_model, semantics.text) == ("clip", "ViT-B-32", "clip")
    assert (semantics.clip_pretrained, semantics.trained) == ("openai", False)
    views = network.views
    assert (views.fusion, views.decode, views.train_choice) == ("attention", "one", "argmax")
    assert (views.mi_loss, views.mi_gradient, views.act) == ("literal", True, "weight")
    assert network.points.enabled
    history = network.history
    assert (network.width, history.enabled, history.past_steps, history.skip_first) == (64, True, 5, True)
    window = re.search(r"window of up to (\d+) rows, of which each decision sees up\s+to (\d+)", TEXT)
    assert window is not None
    assert [len(cfg.policy.observation_delta_indices), history.memory + 1] == [int(rows) for rows in window.groups()]
    assert set(vars(network.decoder).values()) == {False}
    assert loss == LossConfig(
        action=1.0, mutual_information=0.01, heatmap=0.0, choice=0.0, paraphrase=0.0, gripper="mse", position_unit=1.0
    )
    assert cfg.policy.augment == replace(STILL, pixels=8), "images are shifted, as Hiveformer's are; nothing else moves"


def test_the_peer_has_nothing_of_ours_in_its_network(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = load(config_files.find("train/hiveformer"), monkeypatch)
    assert isinstance(cfg.policy, HistMVConfig)
    network, loss = cfg.policy.network, cfg.policy.loss
    assert (network.views.fusion, network.views.decode) == ("tokens", "all")
    assert (network.texture.encoder, network.texture.language, network.texture.use_xyz) == ("backbone", False, False)
    assert network.semantics.image == "none"
    assert not network.points.enabled
    assert network.width == 32 and set(network.texture.widths) == {32}
    assert network.history == HistoryConfig(past_steps=10, layers=1, heads=8, dropout=0.1, skip_first=False)
    assert set(vars(network.decoder).values()) == {False}
    assert (loss.heatmap, loss.position_unit) == (0, 1)
    assert cfg.policy.augment == replace(STILL, pixels=8)

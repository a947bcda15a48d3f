"""Every YAML file is one that LeRobot's own parser accepts; none carries a setting that would break RGB-D training."""

from pathlib import Path

import pytest
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig

import lerobot_policy_histmv  # noqa: F401
from dataset_tools import config_files

TRAIN = [name for name in config_files.names() if name.startswith(("train/", "ablation/"))]
PEERS = {"peers/act": "act", "peers/act_keyframes": "act", "peers/diffusion": "diffusion"}


def load(path: Path, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> TrainPipelineConfig:
    """The config as `lerobot-train --config_path=path ...` would see it."""

    @parser.wrap()
    def capture(cfg: TrainPipelineConfig) -> TrainPipelineConfig:
        return cfg

    monkeypatch.setattr("sys.argv", ["lerobot-train", f"--config_path={path}", *arguments])
    return capture()


def test_every_yaml_file_is_covered_here() -> None:
    assert {"train/default", "train/demo", "train/paper"} <= set(TRAIN)
    assert set(config_files.names()) == {*TRAIN, *PEERS}, "a new kind of config needs a test that loads it"


@pytest.mark.parametrize("name", TRAIN)
def test_lerobot_train_accepts_the_file(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cfg = load(config_files.find(name), monkeypatch, "--dataset.repo_id=a/b", f"--output_dir={tmp_path / 'new'}")
    cfg.validate()
    assert isinstance(cfg.policy, PreTrainedConfig)
    assert cfg.policy.type == "histmv"
    assert not cfg.policy.push_to_hub, "training must work without an account"
    assert cfg.dataset.repo_id == "a/b"
    assert cfg.dataset.depth_output_unit == "mm"
    assert not cfg.dataset.image_transforms.enable, "LeRobot's transforms move colour but not depth"


@pytest.mark.parametrize(("name", "policy"), PEERS.items())
def test_lerobot_train_accepts_the_peers_without_downloads(
    name: str, policy: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    cfg = load(config_files.find(name), monkeypatch, f"--output_dir={tmp_path / 'new'}")
    cfg.validate()
    assert cfg.policy is not None
    assert cfg.policy.type == policy
    assert cfg.policy.pretrained_backbone_weights is None
    assert not cfg.policy.push_to_hub
    if policy == "diffusion":
        assert (
            cfg.policy.drop_n_last_frames == cfg.policy.horizon - cfg.policy.n_action_steps - cfg.policy.n_obs_steps + 1
        )


def test_the_command_line_wins_over_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = load(config_files.find("train/demo"), monkeypatch, "--steps=7", "--policy.optimizer_lr=0.25")
    assert cfg.steps == 7
    assert cfg.policy is not None
    assert cfg.policy.get_optimizer_preset().lr == 0.25


@pytest.mark.parametrize("line", ["stepz: 3", "policy: {type: histmv, optimizer_lrr: 3}"])
def test_a_misspelt_field_is_refused(
    line: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(f"dataset: {{repo_id: a/b}}\n{line}\n")
    with pytest.raises(SystemExit):
        load(path, monkeypatch)
    assert "are not valid for" in capsys.readouterr().err

"""The archive of a checkpoint: whole, the same every time, at home on any machine; and the commands that lead to it."""

import hashlib
import json
import shutil
import tarfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from fake_ur5 import write_checkpoint
from helpers.episodes import snapshot
from helpers.evaluations import evaluated
from helpers.keyframed import SIZE
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from tiny_policy import episode, observation, tiny_config

from lerobot_histmv.modeling_histmv import HistMVPolicy

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NAME = "histmv_small"


@pytest.fixture(scope="module")
def release() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        import release_asset

        yield release_asset


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """As ``lerobot-train`` leaves it after a resumed training, full of this machine's paths."""
    folder = write_checkpoint(tmp_path / "train" / "pretrained_model", size=(SIZE, SIZE))
    config = json.loads((folder / "config.json").read_text()) | {"pretrained_path": str(folder)}
    (folder / "config.json").write_text(json.dumps(config))
    policy = tiny_config(pretrained_path=folder)
    dataset = DatasetConfig("local/small", root=str(tmp_path / "keyframes"))
    training = TrainPipelineConfig(dataset, policy=policy, output_dir=tmp_path / "train", resume=True, steps=7)
    training.save_pretrained(folder)
    return folder


def unpacked(archive: Path, folder: Path) -> Path:
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    return folder / NAME


def action(folder: Path) -> torch.Tensor:
    """What a saved policy answers to one observation."""
    rows = episode(1)
    pictures = {key: value[..., :SIZE, :SIZE] for key, value in rows.items() if "images" in key}
    policy = HistMVPolicy.from_pretrained(folder).eval()
    with torch.inference_mode():
        return policy.select_action(observation(rows | pictures, 0))


def test_unpacked_policy_acts_like_the_packed_one_and_brings_card_and_licence(
    release: ModuleType, checkpoint: Path, tmp_path: Path
) -> None:
    before, expected = snapshot(checkpoint), action(checkpoint)
    results = evaluated(tmp_path / "evaluation", checkpoint)
    archive = release.pack(checkpoint, results, NAME, tmp_path / "out")
    assert snapshot(checkpoint) == before
    assert archive == tmp_path / "out" / f"{NAME}.tar.gz"
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    assert archive.with_name(f"{NAME}.tar.gz.sha256").read_text() == f"{digest}  {NAME}.tar.gz\n"

    folder = unpacked(archive, tmp_path / "there")
    shutil.rmtree(tmp_path / "train")
    shutil.rmtree(tmp_path / "out" / NAME)
    assert action(folder).equal(expected)
    files = snapshot(folder)
    assert set(files) == {*before, "README.md", "LICENSE"}
    assert b"2 of 3" in files["README.md"]
    assert b"Apache License" in files["LICENSE"]
    texts = {name: content.decode() for name, content in files.items() if not name.endswith(".safetensors")}
    assert {name for name, text in texts.items() if str(tmp_path) in text or str(Path.home()) + "/" in text} == set()
    training = TrainPipelineConfig.from_pretrained(folder)
    assert (training.dataset.root, training.output_dir, training.resume) == (None, None, False)
    assert training.policy.pretrained_path is None
    assert (training.steps, training.dataset.repo_id) == (7, "local/small")


def test_the_same_checkpoint_gives_the_same_archive(release: ModuleType, checkpoint: Path, tmp_path: Path) -> None:
    results = evaluated(tmp_path / "evaluation", checkpoint)
    first = release.pack(checkpoint, results, NAME, tmp_path / "out").read_bytes()
    (tmp_path / "out" / NAME / "left_over.json").write_text("{}")
    (checkpoint / "model.safetensors").touch()
    assert release.pack(checkpoint, results, NAME, tmp_path / "out").read_bytes() == first
    assert release.pack(checkpoint, results, NAME, tmp_path / "other").read_bytes() == first


@pytest.mark.parametrize("path", ["/data/robots/cell.yaml", "/mnt/ann/x"])
def test_texts_that_name_a_place_are_refused(path: str, release: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("https://huggingface.co/datasets/a/b, and/or `again/keyframes`, 3 m/s")
    release.check_places(tmp_path)
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps({"file": path}))
    with pytest.raises(ValueError, match=rf"policy_preprocessor\.json names a place on this machine, {path}"):
        release.check_places(tmp_path)


def option(command: tuple[str, ...], name: str) -> str:
    """Value of ``--name=value`` in a command."""
    (value,) = [word.partition("=")[2] for word in command if word.startswith(f"--{name}=")]
    return value


def test_each_stage_reads_what_the_one_before_wrote_and_can_be_small(release: ModuleType) -> None:
    given = ["--episodes=2", "--steps=3", "--scenes=5", "--preset=train/debug", "--seed=7"]
    args = release.arguments().parse_args(given)
    stages = {stage.name: stage.command for stage in release.stages(args, Path("out"))}
    assert list(stages) == ["record", "keyframe", "train", "evaluation"]
    assert option(stages["keyframe"], "dataset.root") == option(stages["record"], "root")
    assert option(stages["train"], "dataset.root") == option(stages["keyframe"], "output.root")
    assert option(stages["evaluation"], "policy.path").startswith(option(stages["train"], "output_dir"))
    assert option(stages["record"], "env.task") == option(stages["evaluation"], "env.task") == "pick_and_lift"
    assert option(stages["record"], "episodes") == "2"
    assert (option(stages["train"], "steps"), option(stages["train"], "seed")) == ("3", "7")
    assert option(stages["train"], "config_path").endswith("train/debug.yaml")
    assert option(stages["evaluation"], "eval.n_episodes") == "5"

    usual = {stage.name: stage.command for stage in release.stages(release.arguments().parse_args([]), Path("out"))}
    assert option(usual["record"], "episodes") == "50"
    assert option(usual["evaluation"], "eval.n_episodes") == "100"
    assert option(usual["train"], "config_path").endswith("train/default.yaml")
    assert not any(word.startswith("--steps") for word in usual["train"])

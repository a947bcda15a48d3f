"""Stored CLIP vectors are those that the policy computes, spare it the towers, and are taken only by the same ones."""

from pathlib import Path
from typing import Any

import pytest
import test_policy_dataset as sample
import torch
from helpers.gradients import assert_same_gradients
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy, make_pre_post_processors
from tiny_policy import CAMERAS, STILL
from tiny_scene import tiny_network
from tiny_weights import clip_file, r3m_checkpoint, resnet

from dataset_tools import cli
from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.model import semantics
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.r3m import R3mTower
from lerobot_histmv.model.semantics import ClipTowers

root = sample.root


def weights(folder: Path, seed: int) -> Path:
    return clip_file(folder / f"tiny_{seed}.pt", seed)


def cache(source: Path, output: Path, file: Path, *more: str) -> Path:
    names = ["--dataset.repo_id=local/tiny", f"--dataset.root={source}", "--output.repo_id=local/tiny_clip"]
    clip = ["--clip_model=tiny", f"--clip_pretrained={file}"]
    cli.main(["cache-clip", *names, f"--output.root={output}", *clip, *more])
    return output


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return weights(tmp_path_factory.mktemp("weights"), seed=5)


@pytest.fixture(scope="module")
def cached(root: Path, file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cache(root, tmp_path_factory.mktemp("cached") / "data", file)


def frozen(file: Path) -> SemanticsConfig:
    return SemanticsConfig(clip_pretrained=str(file))


def towers(file: Path) -> ClipTowers:
    return ClipTowers(frozen(file))


def policy_and_batch(data: Path, chosen: SemanticsConfig) -> tuple[Any, dict[str, Any]]:
    """A policy in training with these towers, and windows of ``data`` as LeRobot gives them."""
    network = tiny_network(semantics=chosen)
    config = HistMVConfig(device="cpu", push_to_hub=False, network=network, augment=STILL)
    meta = LeRobotDatasetMetadata("local/tiny", root=data)
    torch.manual_seed(0)
    policy = make_policy(config, ds_meta=meta).train()
    deltas = resolve_delta_timestamps(config, meta)
    dataset = LeRobotDataset("local/tiny", root=data, delta_timestamps=deltas, depth_output_unit="mm")
    before, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    return policy, before(torch.utils.data.default_collate([dataset[2], dataset[5]]))


def loss_and_gradients(policy: Any, batch: dict[str, Any]) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    torch.manual_seed(1)
    loss, _ = policy(batch)
    loss.backward()
    return loss, {name: p.grad for name, p in policy.named_parameters() if p.grad is not None}


def assert_same(
    stored: tuple[torch.Tensor, dict[str, torch.Tensor]], plain: tuple[torch.Tensor, dict[str, torch.Tensor]]
) -> None:
    torch.testing.assert_close(stored[0], plain[0])
    assert len(plain[1]) > 1
    assert stored[1].keys() == plain[1].keys()
    assert_same_gradients(list(stored[1].values()), list(plain[1].values()), list(plain[1]))


def test_columns_are_the_vectors_of_the_images_and_the_rest_is_unchanged(root: Path, cached: Path, file: Path) -> None:
    before, after = LeRobotDataset("local/tiny", root=root), LeRobotDataset("local/tiny", root=cached)
    mark = towers(file).fingerprint()
    for row in range(len(before)):
        for camera in CAMERAS:
            expected = towers(file).images(before[row][keys.rgb_key(camera)][None])[0]
            torch.testing.assert_close(after[row][keys.clip_key(mark, camera)], expected, atol=1e-6, rtol=0)
        for key, value in before[row].items():
            assert torch.equal(value, after[row][key]) if isinstance(value, torch.Tensor) else value == after[row][key]


def test_training_never_runs_the_image_tower_and_learns_the_same(
    root: Path, cached: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = loss_and_gradients(*policy_and_batch(root, frozen(file)))

    def forbidden(*_: object) -> None:
        raise AssertionError("the image tower ran")

    monkeypatch.setattr(ClipTowers, "images", forbidden)
    policy, batch = policy_and_batch(cached, frozen(file))
    assert not any(key.startswith(keys.CLIP_PREFIX) for key in policy.config.input_features)
    assert_same(loss_and_gradients(policy, batch), plain)


def test_vectors_of_other_weights_are_not_taken(cached: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, batch = policy_and_batch(cached, frozen(weights(tmp_path, seed=7)))
    ran: list[int] = []
    real = ClipTowers.images
    monkeypatch.setattr(ClipTowers, "images", lambda self, rgb: (ran.append(len(rgb)), real(self, rgb))[1])
    loss_and_gradients(policy, batch)
    assert ran


def test_r3m_s_vectors_are_stored_and_taken_likewise(
    root: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = tmp_path / "r3m.pt"
    torch.save(r3m_checkpoint(resnet(18)), checkpoint)
    chosen = SemanticsConfig(image="r3m", r3m_pretrained=str(checkpoint))
    data = cache(root, tmp_path / "data", file, "--image=r3m", f"--r3m_pretrained={checkpoint}")
    plain = loss_and_gradients(*policy_and_batch(root, chosen))
    monkeypatch.setattr(R3mTower, "images", None)
    assert_same(loss_and_gradients(*policy_and_batch(data, chosen)), plain)


def test_an_image_tower_that_does_not_exist_is_refused(
    root: Path, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, message in (("none", "choose clip or r3m"), ("dino", "semantics.image='dino'")):
        with pytest.raises(SystemExit):
            cache(root, tmp_path / "data", file, f"--image={name}")
        assert message in capsys.readouterr().err


def test_trained_towers_take_none(cached: Path) -> None:
    assert semantics.Semantics(SemanticsConfig()).stored_as is None


def test_what_is_there_already_and_unknown_weights_are_told(
    cached: Path, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for clip, message in ((file, "holds these vectors already"), (tmp_path / "none.pt", "cannot load")):
        with pytest.raises(SystemExit):
            cache(cached, tmp_path / "again", clip)
        assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    more = cache(cached, tmp_path / "two", weights(tmp_path, seed=7))
    assert sum(key.startswith(keys.CLIP_PREFIX) for key in LeRobotDatasetMetadata("x", root=more).features) == 4

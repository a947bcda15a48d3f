"""R3M's ResNet as global image encoder (Nair et al. 2022): what paper table 1 puts in CLIP's place."""

from pathlib import Path

import timm
import torch
from jaxtyping import Float
from timm.data import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.image_tower import UNREADABLE, ImageTower

PREFIX = "module.convnet."
"""What the names of the ResNet's weights begin with in a published checkpoint; all others are of its language part."""
SIDE = 224
BLOCKS = {(2, False): "resnet18", (6, False): "resnet34", (6, True): "resnet50"}
"""Architecture by the number of blocks in the third stage and whether they are bottlenecks."""


def read_r3m(path: str) -> dict[str, Tensor]:
    """The ResNet's weights from an R3M checkpoint, by their names in torchvision. The file cannot run code.

    Raises:
        ValueError: there is no file, or it is not an R3M checkpoint.
    """
    try:
        stored = torch.load(Path(path), map_location="cpu", weights_only=True)["r3m"]
        weights = {name.removeprefix(PREFIX): stored[name] for name in stored if name.startswith(PREFIX)}
    except (*UNREADABLE, KeyError, TypeError, IndexError) as error:
        reason = "it has no entry 'r3m'" if isinstance(error, KeyError) else error
        raise ValueError(f"cannot read semantics.r3m_pretrained={path!r} as an R3M checkpoint: {reason}") from error
    # Some copies keep the classifier, which the published network replaces by nothing.
    return {name: values for name, values in weights.items() if not name.startswith("fc.")}


def architecture(weights: dict[str, Tensor], path: str) -> str:
    """Name of the ResNet that has these weights, as timm calls it."""
    blocks = {name.split(".")[1] for name in weights if name.startswith("layer3.")}
    name = BLOCKS.get((len(blocks), "layer3.0.conv3.weight" in weights))
    if name is None:
        raise ValueError(
            f"semantics.r3m_pretrained={path!r} holds none of R3M's networks {sorted(BLOCKS.values())}: the third "
            f"stage of its {PREFIX}* weights has {len(blocks)} blocks"
        )
    return name


class R3mTower(ImageTower):
    """Frozen ResNet of an R3M checkpoint; batch normalisation keeps its stored statistics.

    R3M crops images that are not of its size; here the whole view is resized, since its edges matter to a robot.

    Args:
        path: checkpoint in the published layout.

    Raises:
        ValueError: see ``read_r3m`` and ``architecture``; or weights are missing.
    """

    trained = False

    def __init__(self, path: str) -> None:
        weights = read_r3m(path)
        name = architecture(weights, path)
        convnet: nn.Module = timm.create_model(name, num_classes=0)
        width = convnet.num_features
        assert isinstance(width, int)
        super().__init__((SIDE, SIDE), IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD, width)
        try:
            convnet.load_state_dict(weights)
        except RuntimeError as error:
            raise ValueError(f"semantics.r3m_pretrained={path!r} is not R3M's {name}: {error}") from error
        self.convnet = convnet.requires_grad_(False).eval()

    @property
    def network(self) -> nn.Module:
        """The ResNet."""
        return self.convnet

    def train(self, mode: bool = True) -> "R3mTower":
        """Stays in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def images(self, rgb: Float[Tensor, "n 3 y x"]) -> Float[Tensor, "n c"]:
        """Global vectors of colours in [0, 1], of unit length."""
        return functional.normalize(self.convnet(self.prepared(rgb)).float(), dim=-1)

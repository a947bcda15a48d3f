"""Weight files that tests make: CLIP's tiny architecture, R3M's published layout, and one that holds code instead."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import open_clip
import torch
import torchvision
from torch import nn

from lerobot_histmv.model import semantics


def clip_of(seed: int = 5, **changes: Any) -> open_clip.CLIP:
    """A seeded CLIP of the tiny architecture."""
    torch.manual_seed(seed)
    return open_clip.CLIP(**semantics.TINY, **changes)


def clip_file(path: Path, seed: int = 5) -> Path:
    """Weights of the tiny architecture as open_clip writes them: the state dictionary."""
    torch.save(clip_of(seed).state_dict(), path)
    return path


def resnet(depth: int) -> nn.Module:
    """torchvision's seeded network without its classifier; its statistics are such as only training makes."""
    torch.manual_seed(depth)
    network: nn.Module = getattr(torchvision.models, f"resnet{depth}")(weights=None)
    network.fc = nn.Identity()
    for name, statistic in network.named_buffers():
        if name.endswith("running_mean"):
            statistic.normal_(std=0.1)
    return network.eval()


def r3m_checkpoint(convnet: nn.Module) -> dict[str, Any]:
    """The layout of R3M's snapshots: names of data-parallel training, a language model beside the ResNet."""
    weights = {f"module.convnet.{name}": values for name, values in convnet.state_dict().items()}
    language = {"module.lang_enc.model.embeddings.weight": torch.ones(3), "module.lang_rew.pred.0.bias": torch.ones(2)}
    return {"r3m": weights | language, "global_step": 7}


def r3m_file(path: Path, depth: int = 18) -> Path:
    """A seeded R3M checkpoint."""
    torch.save(r3m_checkpoint(resnet(depth)), path)
    return path


class TouchWhenUnpickled:
    """Stands for any code in a pickle: unpickling creates a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def code_file(path: Path, entry: str, executed: Path) -> None:
    """A checkpoint whose ``entry`` creates the file ``executed`` if anything unpickles it."""
    path.write_bytes(pickle.dumps({entry: TouchWhenUnpickled(executed)}, protocol=2))

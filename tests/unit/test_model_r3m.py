"""R3M's ResNet: its published checkpoint gives torchvision's network, frozen; a file is data, never code."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tiny_weights import code_file, r3m_checkpoint, resnet
from torch import Tensor, nn
from torch.nn import functional

from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.r3m import R3mTower
from lerobot_histmv.model.semantics import Semantics

CPU = torch.device("cpu")
MEAN, STD = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])


@pytest.fixture(scope="module")
def smallest(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, nn.Module]:
    path, network = tmp_path_factory.mktemp("r3m") / "model.pt", resnet(18)
    torch.save(r3m_checkpoint(network), path)
    return path, network


def views(side: int = 224, k: int = 2) -> Tensor:
    return torch.rand(1, k, 3, side, side, generator=torch.Generator().manual_seed(0))


@torch.no_grad()
def test_vectors_are_those_of_the_published_network(smallest: tuple[Path, nn.Module]) -> None:
    """R3M takes 0..255, divides by 255 and standardises: colours here are in [0, 1] already."""
    path, network = smallest
    rgb = views()[0]
    expected = network((rgb - MEAN[:, None, None]) / STD[:, None, None])
    found = R3mTower(str(path)).train().images(rgb)
    torch.testing.assert_close(found, functional.normalize(expected, dim=-1), atol=1e-5, rtol=0)
    assert found.shape == (2, 512)


@pytest.mark.parametrize(("depth", "width"), [(34, 512), (50, 2048)])
def test_depth_is_read_from_the_file(depth: int, width: int, tmp_path: Path) -> None:
    torch.save(r3m_checkpoint(resnet(depth)), tmp_path / "model.pt")
    assert R3mTower(str(tmp_path / "model.pt")).width == width


def test_it_takes_the_place_of_clip_s_image_tower_alone(smallest: tuple[Path, nn.Module]) -> None:
    path, _ = smallest
    encoders = Semantics(SemanticsConfig(image="r3m", r3m_pretrained=str(path)))
    images = encoders.images(views(side=48, k=3))
    assert images.shape == (1, 3, encoders.image_width)
    assert not images.requires_grad
    assert encoders.text(["press the red button"], CPU).requires_grad, "the text tower is still trained"
    assert not any("visual" in name or "convnet" in name for name in encoders.state_dict())
    assert encoders.image_width == 512
    assert encoders.stored_as == R3mTower(str(path)).fingerprint()


def test_fingerprint_tells_weights_apart_and_only_them(smallest: tuple[Path, nn.Module], tmp_path: Path) -> None:
    path, network = smallest
    weights = r3m_checkpoint(network)
    torch.save({"r3m": weights["r3m"]}, tmp_path / "same.pt")
    weights["r3m"]["module.convnet.conv1.weight"] = weights["r3m"]["module.convnet.conv1.weight"] + 1
    torch.save(weights, tmp_path / "other.pt")
    names = [str(path), str(tmp_path / "same.pt"), str(tmp_path / "other.pt")]
    first, same, other = (R3mTower(name).fingerprint() for name in names)
    assert first == same != other


def cut_off(path: Path) -> None:
    torch.save(r3m_checkpoint(resnet(18)), path)
    path.write_bytes(path.read_bytes()[:9999])


def broken_files() -> dict[str, Callable[[Path], object]]:
    return {
        "missing": lambda _: None,
        "empty": lambda path: path.touch(),
        "another layout": lambda path: torch.save({"state_dict": {}}, path),
        "a list": lambda path: torch.save([1, 2], path),
        "cut off": lambda path: (
            torch.save(r3m_checkpoint(resnet(18)), path),
            path.write_bytes(path.read_bytes()[:9999]),
        ),
        "code": lambda path: code_file(path, "r3m", path.with_name("executed")),
    }


@pytest.mark.parametrize("kind", broken_files())
def test_files_that_are_no_checkpoint_are_refused_by_name_and_execute_nothing(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    broken_files()[kind](path)
    with pytest.raises(ValueError, match=r"semantics\.r3m_pretrained='.*model\.pt' as an R3M checkpoint"):
        R3mTower(str(path))
    assert not (tmp_path / "executed").exists()


def test_weights_of_another_network_are_refused(smallest: tuple[Path, nn.Module], tmp_path: Path) -> None:
    weights = r3m_checkpoint(resnet(18))
    missing = {"r3m": {name: w for name, w in weights["r3m"].items() if "layer2.1" not in name}}
    transformer = {"r3m": {"module.convnet.encoder.layer.0.weight": torch.ones(2)}}
    for content, message in ((missing, "is not R3M's resnet18"), (transformer, "holds none of R3M's networks")):
        torch.save(content, tmp_path / "model.pt")
        with pytest.raises(ValueError, match=rf"semantics\.r3m_pretrained='.*model\.pt' {message}"):
            R3mTower(str(tmp_path / "model.pt"))

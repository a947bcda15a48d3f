"""``histmv cache-clip``: a dataset again, with a frozen tower's vector of every colour image as further columns."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float32, UInt8
from rich.console import Console
from rich.progress import Progress

from dataset_tools.calibrate.added_columns import write_with_columns
from dataset_tools.frames import camera_frames
from dataset_tools.inspect.cameras import cameras_of
from dataset_tools.output_place import OutputPlace, WholeDataset
from dataset_tools.source import Source, open_dataset
from dataset_tools.workplace import Workplace
from lerobot_histmv import keys
from lerobot_histmv.model.config import SemanticsConfig
from lerobot_histmv.model.image_tower import ImageTower
from lerobot_histmv.model.semantics import image_tower

BATCH = 32
"""Images per call of the tower."""


@dataclass
class CacheClipConfig:
    """Write a keyframed dataset again, with the vector that a frozen CLIP (or R3M) gives of every colour image.

        histmv cache-clip --dataset.repo_id=me/keys --output.repo_id=me/keys_clip --clip_model=ViT-B-32

    Training with the same --policy.network.semantics.* then never runs the tower on images. The columns'
    names hold a fingerprint of weights and preprocessing: a policy with others does not take them and runs its own. The
    vectors are those of the images as recorded; augmentation does not reach them.
    """

    dataset: WholeDataset
    output: OutputPlace
    # Which tower encodes, as in --policy.network.semantics.image: clip or r3m.
    image: str = "clip"
    # Checkpoint file of image=r3m.
    r3m_pretrained: str | None = None
    # Model by open_clip's name, or tiny.
    clip_model: str = "ViT-B-32"
    # open_clip's tag, or a local weights file.
    clip_pretrained: str = "openai"
    # Compute in bfloat16, as a policy with semantics.bfloat16 does: its vectors are others, if only by a little.
    bfloat16: bool = False
    # Where CLIP runs, such as cuda.
    device: str = "cpu"
    # Replace an existing output dataset.
    overwrite: bool = False


def run(config: CacheClipConfig) -> None:
    """Encode every image, then write the dataset; it appears whole or not at all.

    Raises:
        ValueError: see ``source``, ``frames``, ``semantics.create_clip`` and ``r3m``; or the dataset has these vectors
            already.
    """
    console = Console(highlight=False)
    root = config.output.folder()
    given = config.dataset
    source = open_dataset(given.repo_id, given.root, None, given.revision)
    if root == source.root.resolve():
        raise ValueError(f"--output.root is the dataset itself ({root}); give another folder")
    told = SemanticsConfig(
        image=config.image,
        r3m_pretrained=config.r3m_pretrained,
        clip_model=config.clip_model,
        clip_pretrained=config.clip_pretrained,
        bfloat16=config.bfloat16,
    )
    place = Workplace(root, {"source": str(source.root), **asdict(told)}, config.overwrite, "encoded")
    place.check_free()
    towers = image_tower(told)
    if towers is None:
        raise ValueError(f"--image={config.image} encodes nothing; choose clip or r3m")
    towers = towers.to(config.device).eval()
    wanted = {keys.clip_key(towers.fingerprint(), camera): keys.rgb_key(camera) for camera in cameras_of(source)}
    if not wanted:
        raise ValueError(f"{source.root} has no colour images; its features are {', '.join(source.features)}")
    if there := sorted(wanted.keys() & source.features.keys()):
        raise ValueError(f"{source.root} holds these vectors already: {', '.join(there)}")
    with place.opened(), Progress(console=console) as progress:
        bar = progress.add_task("encoding images", total=len(source.episodes))
        columns = {}
        for episode in source.episodes:
            columns[episode] = dict(vectors(source, episode, wanted, towers, config.device))
            progress.advance(bar)
        names = [str(entry) for entry in range(towers.width)]
        features = {key: {"dtype": "float32", "shape": (towers.width,), "names": names} for key in wanted}
        place.commit(lambda path: write_with_columns(source, features, columns, path))
    console.print(
        f"{len(wanted)} vectors of {towers.width} numbers for each of {source.meta.total_frames} rows\n"
        f"dataset {config.output.repo_id} in {root}",
        soft_wrap=True,
    )


def vectors(
    source: Source, episode: int, wanted: dict[str, str], towers: ImageTower, device: str
) -> Iterator[tuple[str, Float32[np.ndarray, "n c"]]]:
    """Vectors of every camera's images in an episode, by the key that they get."""
    frames = range(source.length(episode))
    stored = [key for key in wanted.values() if source.features[key]["dtype"] == "image"]
    table = source.table(episode, [*stored, "timestamp"])
    for key, image in wanted.items():
        yield key, encoded(camera_frames(source, episode, image, frames, table).pixels, towers, device)


@torch.no_grad()
def encoded(pixels: UInt8[np.ndarray, "n y x 3"], towers: ImageTower, device: str) -> Float32[np.ndarray, "n c"]:
    """Vectors of colour images, as the policy computes them of LeRobot's tensors."""
    parts = []
    for batch in torch.from_numpy(pixels).split(BATCH):
        rgb = rearrange(batch, "n y x c -> n c y x").to(device, torch.float32) / 255
        parts.append(towers.images(rgb).cpu().numpy())
    return np.concatenate(parts)

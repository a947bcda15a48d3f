"""A large dataset in pieces: each is keyframed by the plain command into a dataset of its own, then all are merged."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from dataset_tools.keyframe import KeyframeConfig, keyframe_dataset


@dataclass(frozen=True)
class KeyframePiece:
    """One task of the engine; finished pieces are left as they are, started ones are continued.

    Attributes:
        config: options of the whole dataset, all of them told: nothing is guessed from a piece alone.
        episodes: of the whole dataset.
        folder: where the pieces lie.
    """

    config: KeyframeConfig = field(repr=False)  # the engine writes its tasks into every log
    episodes: tuple[int, ...] = field(repr=False)
    folder: Path

    def __call__(self, data: object, rank: int, world_size: int) -> None:
        """Keyframe piece ``rank`` of ``world_size``.

        Raises:
            ValueError: see ``keyframe.keyframe_dataset``.
        """
        root = piece(self.folder, rank)
        if not (root / "meta/info.json").is_file():  # it appears whole
            episodes = split(self.episodes, world_size)[rank]
            keyframe_dataset(piece_config(self.config, episodes, root), Console(quiet=True))


def piece(folder: Path, rank: int) -> Path:
    """Where a piece lies."""
    return folder / f"piece-{rank:06d}"


def split(episodes: Sequence[int], pieces: int) -> list[list[int]]:
    """Neighbouring episodes, as evenly as possible."""
    return [part.tolist() for part in np.array_split(np.array(episodes, dtype=np.int64), pieces)]


def piece_config(config: KeyframeConfig, episodes: list[int], root: Path) -> KeyframeConfig:
    """Options of one piece."""
    return replace(
        config,
        dataset=replace(config.dataset, episodes=episodes),
        output=replace(config.output, root=root, push_to_hub=False),
        keep={episode: frames for episode, frames in config.keep.items() if episode in episodes},
        workers=1,
        overwrite=False,
    )

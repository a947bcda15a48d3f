"""The card of a dataset or checkpoint, README.md: what was made is written anew, what people wrote stays."""

import re
from collections.abc import Sequence
from pathlib import Path

from huggingface_hub import DatasetCard, ModelCard, RepoCard
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.utils import create_lerobot_dataset_card

from dataset_tools.hub.card_text import sections
from lerobot_histmv import keys

CARD_FILE = "README.md"
LICENSE = "apache-2.0"
"""Of a new card, unless another is given; the same as LeRobot's and this project's own."""
BEGIN, END = "<!-- written by histmv: begin -->", "<!-- written by histmv: end; text outside of these two stays -->"


def dataset_card(root: Path, meta: LeRobotDatasetMetadata, license: str | None) -> DatasetCard:
    """Card of a dense, a keyframed or any other LeRobot dataset.

    Args:
        root: the dataset; ``README.md`` there may hold text and front matter of people.
        meta: its metadata, under the name that it has on the Hub.
        license: the Hub's name of a licence; by default that of ``README.md``, else ``LICENSE``.
    """
    tags = ["histmv", *_kinds(root, meta)]
    made = create_lerobot_dataset_card(tags=tags, license=LICENSE)
    card = DatasetCard(_document(made, "\n\n".join(sections(root, meta))))
    return refreshed(card, root / CARD_FILE, license)


def refreshed[Card: (DatasetCard, ModelCard)](card: Card, path: Path, license: str | None) -> Card:
    """The new ``card`` with what people wrote into the one at ``path``, if there is any.

    Their front matter goes first, tags and data sets of both are kept; of their text, all but the part between the
    marks. ``license`` goes before both.
    """
    text = f"{BEGIN}\n{card.text.strip()}\n{END}"
    if path.is_file():
        old = type(card).load(path, ignore_metadata_errors=True)
        data = {**card.data.to_dict(), **old.data.to_dict()}
        data["tags"] = _joined(card.data.get("tags"), old.data.get("tags"))
        for name, value in data.items():
            card.data[name] = value
        mine = re.compile(f"{re.escape(BEGIN)}.*{re.escape(END)}", re.DOTALL)
        kept = mine.sub(lambda _: text, old.text) if mine.search(old.text) else f"{old.text.strip()}\n\n{text}"
        text = kept.strip()
    if license:
        card.data["license"] = license
    return type(card)(_document(card, text))


def _document(card: RepoCard, text: str) -> str:
    return f"---\n{card.data.to_yaml()}\n---\n\n{text}\n"


def _joined(*lists: Sequence[str] | None) -> list[str]:
    return list(dict.fromkeys(entry for entries in lists for entry in entries or ()))


def _kinds(root: Path, meta: LeRobotDatasetMetadata) -> list[str]:
    kinds = {
        "keyframes": (root / keys.KEYFRAMING_FILE).is_file(),
        "rgb-d": bool(meta.depth_keys),
        "camera-calibration": keys.INTRINSICS in meta.features,
    }
    return [kind for kind, true in kinds.items() if true]

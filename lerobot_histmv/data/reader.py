"""LeRobot's dataset reader over decoded columns: the same samples bit for bit, without decoding frames again."""

import logging
import math
from collections.abc import Iterator
from typing import Any

import datasets
import torch
from lerobot.configs import DEPTH_METER_UNIT
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.depth_utils import MM_PER_METRE
from lerobot.datasets.language import is_language_column
from torch import Tensor

from lerobot_histmv.data.columns import Chunk, Columns, decode
from lerobot_histmv.data.frame_cache import cache_name, open_or_build, size_limit

logger = logging.getLogger(__name__)


class FrameReader(DatasetReader):
    """Reads columns from the frame cache; videos, text and images too many for the cache come from LeRobot's table.

    Stock LeRobot decodes every image of every needed row once per delta key. A subclass, not a patched method, so that
    spawned loader workers get it too: they map the files that the main process has written.
    """

    _columns: Columns
    _cache_name: str
    _images: list[str]
    """Stored columns of images."""
    _numbers: list[str]
    """Stored columns of numbers."""
    _live: datasets.Dataset | None
    """The columns that are not stored."""

    @classmethod
    def from_reader(cls, reader: DatasetReader) -> "FrameReader":
        """A reader of what ``reader``, whose table must be loaded, reads; decodes all its frames if no cache has them.

        Raises:
            ValueError: a frame cannot be decoded.
        """
        assert reader.hf_dataset is not None
        new = cls.__new__(cls)
        new.__dict__.update(reader.__dict__)
        new._choose_columns()
        new._cache_name = cache_name(new.root, new.hf_dataset, new.episodes, new._numbers + new._images)
        new._columns = new._open()
        return new

    @property
    def columns(self) -> Columns:
        """The stored columns of the selected episodes."""
        return self._columns

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_columns"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._columns = self._open()

    def get_item(self, idx: int) -> dict[str, Any]:
        """The sample of row ``idx`` of the selected episodes, made in the steps of ``DatasetReader.get_item``."""
        episode, index = (self._columns.read(key, idx).item() for key in ("episode_index", "index"))
        query, padding = (None, {}) if self.delta_indices is None else self._get_query_indices(index, episode)
        known = {} if self._live is None else self._live[idx]
        known |= {} if query is None else self._query_hf_dataset(query)
        names = self.hf_dataset.column_names
        item = {key: known[key] if key in known else self._columns.read(key, idx) for key in names} | padding
        if self._meta.video_keys:
            item = self._query_videos(self._get_query_timestamps(item["timestamp"].item(), query), episode) | item
        if self._image_transforms is not None:
            for key in self._meta.camera_keys:
                if key not in self._meta.depth_keys:
                    item[key] = self._image_transforms(item[key])
        for key, unit in self._image_depth_units.items():
            if unit is not None and unit != self._depth_output_unit:
                item[key] = item[key] * MM_PER_METRE if unit == DEPTH_METER_UNIT else item[key] / MM_PER_METRE
        item["task"] = self._meta.tasks.iloc[item["task_index"].item()].name
        return item

    def _query_hf_dataset(self, query_indices: dict[str, list[int]]) -> dict[str, Tensor]:
        queries = {
            key: self._table_rows(rows) for key, rows in query_indices.items() if key not in self._meta.video_keys
        }
        found = {key: self._columns.read(key, rows) for key, rows in queries.items() if key in self._columns}
        live = {key: rows for key, rows in queries.items() if key not in found}
        if live and self._live is not None:
            unique = sorted({row for rows in live.values() for row in rows})
            fetched = self._live[unique]
            found |= {key: torch.stack([fetched[key][unique.index(row)] for row in rows]) for key, rows in live.items()}
        return found

    def _table_rows(self, indices: list[int]) -> list[int]:
        """Rows of the loaded table that hold the dataset's frames ``indices``."""
        rows = self._absolute_to_relative_idx
        return indices if rows is None else [rows[index] for index in indices]

    def _choose_columns(self) -> None:
        """Split the table's columns into stored and live ones: text, and all images if the cache cannot hold them."""
        names, features = self.hf_dataset.column_names, self._meta.features
        images = [key for key in names if key in self._meta.image_keys]
        text = [key for key in names if is_language_column(key) or features[key]["dtype"] == "string"]
        size = len(self.hf_dataset) * sum(self._frame_bytes(key) for key in images)
        fits = size <= size_limit()
        if not fits:
            limit = size_limit() / 1e9
            sizes = f"{size / 1e9:.1f} GB, but HISTMV_CACHE_GB={limit:g}"
            logger.warning("decoded frames of %s take %s: they are decoded again and again", self.root, sizes)
        self._images = images if fits else []
        self._numbers = [key for key in names if key not in images and key not in text]
        live = text if fits else text + images
        self._live = self.hf_dataset.select_columns(live) if live else None

    def _frame_bytes(self, key: str) -> int:
        """Upper bound of a decoded frame's size: colours are stored as uint8, depth as uint16 or float32."""
        return math.prod(self._meta.features[key]["shape"]) * (4 if key in self._meta.depth_keys else 1)

    def _open(self) -> Columns:
        keys = self._numbers + self._images
        return open_or_build(self._cache_name, keys, len(self.hf_dataset), self._decode)

    def _decode(self) -> Iterator[Chunk]:
        return decode(self.hf_dataset, self._images, self._numbers)

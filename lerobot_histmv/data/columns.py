"""The columns of a dataset as plain arrays: every frame decoded once, any rows read back just as LeRobot gives them."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import torch
from jaxtyping import Shaped
from lerobot.datasets.io_utils import UINT16_PIL_MODES, pil_to_chw_tensor
from PIL import Image
from torch import Tensor
from tqdm import tqdm

Chunk = dict[str, np.ndarray]
"""The same consecutive rows of several columns."""
CHUNK_ROWS = 64
SILENT_SECONDS = 2.0
"""A decoding that takes longer shows a progress bar."""


def frame_array(image: Image.Image) -> Shaped[np.ndarray, "c h w"]:
    """The pixels of ``image`` as stored: uint8 colours, uint16 depth; rare modes as LeRobot's tensor has them."""
    pixels = np.asarray(image)
    if image.mode in UINT16_PIL_MODES:
        return pixels.astype(np.uint16)[None]
    if pixels.dtype == np.uint8:
        return np.moveaxis(pixels[..., None] if pixels.ndim == 2 else pixels, -1, 0)
    return pil_to_chw_tensor(image).numpy()


def as_tensor(values: Shaped[np.ndarray, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """The tensor LeRobot makes of stored values: uint8 colours become float32 in [0, 1], uint16 depth float32."""
    if values.dtype == np.uint8:
        return torch.from_numpy(values).to(torch.float32).div_(255)
    return torch.from_numpy(values.astype(np.float32) if values.dtype == np.uint16 else values)


def decode(table: datasets.Dataset, images: Sequence[str], others: Sequence[str]) -> Iterator[Chunk]:
    """Yield the columns ``images`` and ``others`` of ``table`` in chunks of consecutive rows.

    Args:
        table: LeRobot's table, with its transform to tensors set.
        images: columns of encoded images; each row becomes (c, h, w) by ``frame_array``.
        others: columns of numbers; each row becomes what the table's transform makes of it.

    Raises:
        ValueError: an image cannot be decoded.
    """
    encoded = table.with_format(None).select_columns(list(images))
    for key in images:
        encoded = encoded.cast_column(key, datasets.Image(decode=False))
    numbers = table.select_columns(list(others))
    with tqdm(total=len(table), desc="Decoding frames", unit="row", delay=SILENT_SECONDS, leave=False) as bar:
        for start in range(0, len(table), CHUNK_ROWS):
            rows = slice(start, min(start + CHUNK_ROWS, len(table)))
            chunk = {key: torch.stack(values).numpy() for key, values in numbers[rows].items()}
            for key, values in (encoded[rows] if images else {}).items():
                chunk[key] = np.stack([_decode_image(value, key, start + i) for i, value in enumerate(values)])
            yield chunk
            bar.update(rows.stop - start)


def _decode_image(value: dict[str, Any], key: str, row: int) -> Shaped[np.ndarray, "c h w"]:
    try:
        return frame_array(datasets.Image().decode_example(value))
    except (OSError, SyntaxError, ValueError, TypeError) as error:
        raise ValueError(f"{key} of row {row} cannot be decoded ({error}); the dataset is damaged") from error


class Columns:
    """Columns of equal length, in memory or memory-mapped from ``.npy`` files.

    Args:
        arrays: one array per key, rows first.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        self.arrays = dict(arrays)

    def __contains__(self, key: str) -> bool:
        return key in self.arrays

    def read(self, key: str, rows: int | list[int]) -> Tensor:
        """A copy of one row, or of several stacked, as LeRobot gives them."""
        return as_tensor(np.asarray(np.take(self.arrays[key], rows, axis=0)))

    @classmethod
    def in_memory(cls, chunks: Iterator[Chunk]) -> "Columns":
        """Gather ``chunks`` in this process's memory."""
        parts = list(chunks)
        return cls({key: np.concatenate([part[key] for part in parts]) for key in parts[0]})

    @classmethod
    def mapped(cls, folder: Path, keys: Sequence[str], rows: int) -> "Columns":
        """Map the files that ``write`` left in ``folder``.

        Raises:
            OSError, ValueError: a file is missing, too short or of another length.
        """
        arrays = {key: np.asarray(np.load(folder / f"{key}.npy", mmap_mode="r")) for key in keys}
        for key, array in arrays.items():
            if len(array) != rows:
                raise ValueError(f"{folder / key}.npy has {len(array)} rows; it must have {rows}")
        return cls(arrays)


def write(chunks: Iterator[Chunk], folder: Path, rows: int) -> None:
    """Write ``chunks``, ``rows`` rows in sum, to one ``.npy`` file per key.

    Plain writes, since a full disk raises OSError there but kills the process through a writable memory map.
    """
    with contextlib.ExitStack() as stack:
        files: dict[str, Any] = {}
        for chunk in chunks:
            for key, values in chunk.items():
                if key not in files:
                    files[key] = stack.enter_context((folder / f"{key}.npy").open("wb"))
                    shape = (rows, *values.shape[1:])
                    header = {"descr": values.dtype.str, "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(files[key], header)
                files[key].write(np.ascontiguousarray(values))

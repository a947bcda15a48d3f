"""Ways to spoil a dataset, for ``histmv doctor`` to find: each takes its folder and changes the files in it."""

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from helpers.episodes import edit_column, edit_info, write
from helpers.scene import LENGTHS, RIG, STILL, Rig, episode, scene_features
from PIL import Image

from lerobot_histmv import keys

FRONT, FRONT_DEPTH = keys.rgb_key("front"), keys.depth_key("front")
FRONT_POSE, WRIST_POSE = slice(0, 12), slice(24, 36)
Spoil = Callable[[Path], Any]


def numbers(feature: str, change: Callable[[np.ndarray], Any]) -> Spoil:
    """Change a vector column, (rows, size), in place."""

    def spoil(root: Path) -> None:
        def edit(rows: list[Any]) -> None:
            values = np.array(rows)
            change(values)
            rows[:] = values.tolist()

        edit_column(root, feature, edit)

    return spoil


def tool(change: Callable[[np.ndarray], Any]) -> Spoil:
    """Change state and action alike."""

    def spoil(root: Path) -> None:
        for feature in (keys.STATE, keys.ACTION):
            numbers(feature, change)(root)

    return spoil


def pictures(key: str, change: Callable[[bytes], bytes], rows: slice = slice(None)) -> Spoil:
    """Change stored image files of some rows."""

    def edit(cells: list[Any]) -> None:
        for cell in cells[rows]:
            cell["bytes"] = change(cell["bytes"])

    return lambda root: edit_column(root, key, edit)


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def stored(file: bytes) -> bytes:
        return encoded(Image.fromarray(change(np.asarray(Image.open(io.BytesIO(file))))), "TIFF")

    return pictures(FRONT_DEPTH, stored)


def encoded(image: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind)
    return buffer.getvalue()


def feature(key: str, **changes: Any) -> Spoil:
    return lambda root: edit_info(root, lambda info: info["features"][key].update(changes))


def without(*features: str) -> Spoil:
    return lambda root: edit_info(root, lambda info: [info["features"].pop(key) for key in features])


def renamed(key: str, old: str, new: str) -> Spoil:
    def change(info: dict[str, Any]) -> None:
        info["features"][key]["names"] = [name.replace(old, new) for name in info["features"][key]["names"]]

    return lambda root: edit_info(root, change)


def again(make: Callable[[Path], Any]) -> Spoil:
    """Write another dataset in place of the healthy one."""

    def spoil(root: Path) -> None:
        shutil.rmtree(root)
        make(root)

    return spoil


def frames(*chosen: list[int]) -> Spoil:
    """Episodes that consist of these frames of the same motion."""
    motion = episode(RIG, 23, 2)
    return again(lambda root: write(root, [[motion[i] for i in one] for one in chosen], scene_features()))


def both(*spoils: Spoil) -> Spoil:
    return lambda root: [spoil(root) for spoil in spoils]


def data_file(root: Path) -> Path:
    return root / "data/chunk-000/file-000.parquet"


def cut_off(root: Path) -> None:
    data_file(root).write_bytes(data_file(root).read_bytes()[:-99])


def corrupt_pages(root: Path) -> None:
    """Damage a page of the state, where the file's footer still is whole."""
    column = next(
        chunk
        for i in range(pq.read_metadata(data_file(root)).row_group(0).num_columns)
        if (chunk := pq.read_metadata(data_file(root)).row_group(0).column(i)).path_in_schema.startswith(keys.STATE)
    )
    content = bytearray(data_file(root).read_bytes())
    begin = column.dictionary_page_offset or column.data_page_offset
    content[begin : begin + 40] = b"\xff" * 40
    data_file(root).write_bytes(content)


def lose_row(root: Path) -> None:
    table = pq.read_table(data_file(root))
    pq.write_table(table.take([i for i in range(len(table)) if i != 5]), data_file(root))


def lose_text(root: Path) -> None:
    tasks = pd.read_parquet(root / "meta/tasks.parquet")
    tasks.index = pd.Index([" "] * len(tasks), name=tasks.index.name)
    tasks.to_parquet(root / "meta/tasks.parquet")


def late(stamps: np.ndarray) -> None:
    stamps[6 : LENGTHS[0]] += 0.3


def flip_odd(values: np.ndarray) -> None:
    values[1::2, 3:7] *= -1


def as_xyzw(values: np.ndarray) -> None:
    values[:, 3:7] = np.roll(values[:, 3:7], -1, axis=1)


def hold(entries: slice) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[:, entries] = values[0, entries]

    return change


def scaled(start: int, stop: int, factor: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[:, start:stop] *= factor

    return change


def shifted(entry: int, by: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[:, entry] += by

    return change


def spoilt_at(row: int, entry: int, value: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[row, entry] = value

    return change


def nearly_blind(image: np.ndarray) -> np.ndarray:
    return np.where(np.arange(image.size).reshape(image.shape) % 50 == 0, image, 0).astype(image.dtype)


def freeze(root: Path) -> None:
    def edit(cells: list[Any]) -> None:
        cells[1 : LENGTHS[0]] = [cells[0]] * (LENGTHS[0] - 1)

    edit_column(root, FRONT, edit)


def other_size(root: Path) -> None:
    depth(lambda image: image[::2, ::2].copy())(root)
    feature(FRONT_DEPTH, shape=[15, 19, 1])(root)


def depth_video(root: Path) -> None:
    rig = Rig(STILL, size=(64, 96))
    features = scene_features(rig)
    features[FRONT_DEPTH]["dtype"] = "video"
    write(root, [episode(rig, 5, 0)], features)

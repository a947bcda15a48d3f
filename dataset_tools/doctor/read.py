"""Reading a dataset for ``histmv doctor``: what cannot be read becomes a finding, and the rest is read on."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float, Int64, UInt8

from dataset_tools.columns import vectors
from dataset_tools.doctor.findings import Finding
from dataset_tools.doctor.images import depth_not_finite, lossy_file
from dataset_tools.doctor.layout import Layout
from dataset_tools.frames import MM_PER, camera_frames, stored_depth
from dataset_tools.source import Source

_COUNTERS = ("timestamp", "frame_index", "episode_index", "task_index")


@dataclass(frozen=True, eq=False)
class EpisodeRows:
    """Numbers of one episode.

    Attributes:
        episode: which.
        vectors: numeric features by key; what is missing is NaN.
        timestamp: [s].
        frame_index: as stored.
        task_index: as stored.
    """

    episode: int
    vectors: Mapping[str, Float[np.ndarray, "n _"]]
    timestamp: Float[np.ndarray, " n"]
    frame_index: Int64[np.ndarray, " n"]
    task_index: Int64[np.ndarray, " n"]

    def extrinsics(self, layout: Layout, camera: str) -> Float[np.ndarray, "n 3 4"]:
        """``T_world_cam`` of a camera."""
        return layout.extrinsics[camera].of(self.vectors).reshape(-1, 3, 4)


@dataclass(eq=False)
class Pictures:
    """Decoded images of one camera at some frames of an episode.

    Attributes:
        rgb: colour by frame.
        depth: [m] by frame, as far as its unit is understood rightly.
        unit: that unit, m or mm.
    """

    rgb: dict[int, UInt8[np.ndarray, "y x 3"]] = field(default_factory=dict)
    depth: dict[int, Float[np.ndarray, "y x"]] = field(default_factory=dict)
    unit: str = ""


def episode_rows(source: Source) -> Iterator[tuple[int, EpisodeRows | Finding]]:
    """The numbers of every episode, each data file read once."""
    by_file: dict[Path, list[int]] = defaultdict(list)
    for episode in source.episodes:
        by_file[Path(source.meta.get_data_file_path(episode))].append(episode)
    for path, episodes in by_file.items():
        names = list(vectors(source.features))
        try:
            table = pq.read_table(source.root / path, columns=[*names, *_COUNTERS])
            arrays = {name: matrix(table.column(name), source.features[name]["shape"][0]) for name in names}
            counters = {name: matrix(table.column(name), 1)[:, 0] for name in _COUNTERS}
        except (OSError, KeyError, pa.ArrowException) as error:
            message = f"cannot read the numbers in {path}: {error}"
            yield from ((episode, Finding.of("damaged", message, episode)) for episode in episodes)
            continue
        for episode in episodes:
            rows = np.flatnonzero(counters["episode_index"] == episode)
            frame, task = (np.nan_to_num(counters[name][rows], nan=-1).astype(np.int64) for name in _COUNTERS[1::2])
            own = {name: array[rows] for name, array in arrays.items()}
            yield episode, EpisodeRows(episode, own, counters["timestamp"][rows], frame, task)


def matrix(column: pa.ChunkedArray, size: int) -> Float[np.ndarray, "n size"]:
    """A column of numbers, or of lists of ``size`` numbers; NaN where numbers or whole lists are missing."""
    found = np.full((len(column), size), np.nan)
    if not pa.types.is_nested(column.type):
        found[:, 0] = column.cast(pa.float64()).to_numpy()
        return found
    whole = pc.equal(pc.list_value_length(column), size).fill_null(False)
    numbers = pc.list_flatten(column.filter(whole)).cast(pa.float64()).to_numpy()
    found[whole.to_numpy()] = numbers.reshape(-1, size)
    return found


def pictures(
    source: Source, layout: Layout, episode: int, frames: Sequence[int]
) -> tuple[dict[str, Pictures], list[Finding]]:
    """Decoded colour and depth of every camera at rising ``frames``, and what could not be decoded."""
    images = [*layout.rgb.values(), *layout.depth.values()]
    stored = [key for key in images if source.features[key]["dtype"] == "image"]
    try:
        table = source.table(episode, [*stored, "timestamp"], frames)
    except ValueError as error:
        return {}, [Finding.of("damaged", str(error), episode)]
    found: dict[str, Pictures] = {camera: Pictures() for camera in layout.sizes}
    findings = []
    for camera, (i, frame) in product(layout.sizes, enumerate(frames)):
        try:
            findings += _read(source, layout, camera, episode, frame, table.slice(i, 1), found[camera])
        except Exception as error:  # decoders raise whatever they like on damaged bytes
            message = f"{type(error).__name__}: {error}"
            findings.append(Finding.of("image_undecodable", message, episode, frame, camera))
    return found, findings


def _read(
    source: Source, layout: Layout, camera: str, episode: int, frame: int, row: pa.Table, into: Pictures
) -> list[Finding]:
    """Put a camera's images at one frame into ``into``; what is wrong with how they are stored."""
    found = []
    if camera in layout.rgb:
        image = camera_frames(source, episode, layout.rgb[camera], [frame], row)
        into.rgb[frame] = image.pixels[0]
        found = lossy_file(image.files[0], camera)
    if camera in layout.depth:
        raw, into.unit = stored_depth(source, episode, layout.depth[camera], [frame], row)
        found += depth_not_finite(raw[0], camera, episode, frame)
        into.depth[frame] = raw[0] * MM_PER[into.unit] / MM_PER["m"]
    return found

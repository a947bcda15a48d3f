"""Camera frames of kept rows: stored image files are copied as they are, video and depth in metres converted."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Shaped, UInt8, UInt16
from lerobot.configs.video import DepthEncoderConfig
from lerobot.datasets.depth_utils import dequantize_depth
from lerobot.datasets.video_utils import decode_video_frames
from PIL import Image

from dataset_tools.images import encode_depth, encode_rgb
from dataset_tools.source import Source

_LARGEST_MM = np.iinfo(np.uint16).max
MM_PER = {"m": 1000.0, "mm": 1.0}
"""Units of stored depth."""
_TOLERANCE_S = 1e-3


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """Frames of one camera.

    Attributes:
        files: one image file per frame: RGB as PNG (or as it was stored), depth as TIFF uint16 mm.
        pixels: the same, decoded.
    """

    files: list[bytes]
    pixels: UInt8[np.ndarray, "n y x 3"] | UInt16[np.ndarray, "n y x 1"]


def camera_frames(source: Source, episode: int, key: str, frames: Sequence[int], stored: pa.Table) -> CameraFrames:
    """Frames of one camera.

    Args:
        source: the dataset.
        episode: which episode.
        key: which camera.
        frames: which frames, strictly rising.
        stored: the episode's table at these frames, with ``timestamp`` and, unless it is a video, ``key``.

    Raises:
        ValueError: frames that cannot be read, or depth that is not a number; the message names episode, frame and key.
    """
    if key in source.depth_keys:
        return _depth(source, episode, key, frames, stored)
    if source.features[key]["dtype"] == "video":
        pixels = np.moveaxis(_decoded(source, episode, key, frames, stored), 1, -1)
        return CameraFrames([encode_rgb(image) for image in pixels], pixels)
    files = _files(stored, episode, key)
    return CameraFrames(files, np.stack([np.asarray(Image.open(io.BytesIO(file)).convert("RGB")) for file in files]))


def millimetres(depth: Float[np.ndarray, "y x"], unit: str, where: str) -> UInt16[np.ndarray, "y x"]:
    """Depth as uint16 mm; what does not fit (beyond 65.5 m) becomes 0, which means no measurement.

    Raises:
        ValueError: a value is NaN, infinite or negative; the message begins with ``where``.
    """
    valid = np.isfinite(depth) & (depth >= 0)
    if not valid.all():
        raise ValueError(f"{where} holds {depth[~valid][0]}; depth must be finite, with 0 where nothing was measured")
    scaled = np.rint(depth * MM_PER[unit])
    return np.where(scaled > _LARGEST_MM, 0, scaled).astype(np.uint16)


def stored_depth(
    source: Source, episode: int, key: str, frames: Sequence[int], stored: pa.Table
) -> tuple[Shaped[np.ndarray, "n y x"], str]:
    """Depth images as they are stored and the unit, m or mm, that they are declared or understood to be in.

    Args and errors as of ``camera_frames``.
    """
    info = source.features[key].get("info") or {}
    if source.features[key]["dtype"] == "video":
        return _dequantized(_decoded(source, episode, key, frames, stored), info), "m"
    raw = np.stack([np.asarray(Image.open(io.BytesIO(file))) for file in _files(stored, episode, key)])
    return raw, info.get("depth_unit") or ("mm" if np.issubdtype(raw.dtype, np.integer) else "m")


def _depth(source: Source, episode: int, key: str, frames: Sequence[int], stored: pa.Table) -> CameraFrames:
    raw, unit = stored_depth(source, episode, key, frames, stored)
    if raw.dtype == np.uint16 and unit == "mm":
        return CameraFrames(_files(stored, episode, key), raw[..., None])
    depth = [
        millimetres(image.astype(np.float64), unit, f"episode {episode}, frame {frame}: {key}")
        for image, frame in zip(raw, frames, strict=True)
    ]
    return CameraFrames([encode_depth(image[..., None]) for image in depth], np.stack(depth)[..., None])


def _files(stored: pa.Table, episode: int, key: str) -> list[bytes]:
    files = [cell["bytes"] for cell in stored.column(key).to_pylist()]
    if not all(files):
        raise ValueError(f"episode {episode}: {key} has frames whose image is not embedded in the data files")
    return files


def _dequantized(codes: np.ndarray, info: dict[str, object]) -> Float[np.ndarray, "n y x"]:
    """Depth [m] of video codes; the smallest code, which stands for pixels without a measurement too, becomes 0."""
    encoder = DepthEncoderConfig.from_video_info(info)
    metres = dequantize_depth(
        codes,
        depth_min=encoder.depth_min,
        depth_max=encoder.depth_max,
        shift=encoder.shift,
        use_log=encoder.use_log,
        output_unit="m",
        output_tensor=False,
    )
    return np.where(codes > 0, metres, 0).reshape(len(codes), *codes.shape[-2:])


def _decoded(source: Source, episode: int, key: str, frames: Sequence[int], stored: pa.Table) -> np.ndarray:
    """Raw frames (n, channels, y, x) of a video: uint8 RGB, or 12-bit depth codes."""
    begin = source.meta.episodes[episode][f"videos/{key}/from_timestamp"]
    stamps = [begin + stamp for stamp in stored.column("timestamp").to_pylist()]
    path = source.root / source.meta.get_video_file_path(episode, key)
    is_depth = key in source.depth_keys
    try:
        decoded = decode_video_frames(path, stamps, _TOLERANCE_S, "pyav", return_uint8=not is_depth, is_depth=is_depth)
    except Exception as error:
        raise ValueError(f"episode {episode}: cannot read frames {list(frames)} of {key} in {path}: {error}") from error
    return decoded.numpy()

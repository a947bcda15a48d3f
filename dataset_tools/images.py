"""Camera images as bytes for a parquet cell, and their statistics as LeRobot defines them, both fast.

LeRobot compresses at level 6 and sorts every pixel into 5000 histogram bins; that is nine tenths of its writing time.
Integer pixels need neither: a light compression holds the same pixels, and counting how often each value occurs gives
the same statistics.
"""

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8, UInt16

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_QUANTILE_BINS = 5000
_MIN_SAMPLES, _MAX_SAMPLES, _SAMPLING_POWER = 100, 10_000, 0.75
_FULL_SIZE_BELOW, _REDUCED_SIZE = 300, 150
_TIFF_UNCOMPRESSED = (cv2.IMWRITE_TIFF_COMPRESSION, 1)

Images = UInt8[np.ndarray, "n y x 3"] | UInt16[np.ndarray, "n y x 1"]


def encode_rgb(image_yxc: UInt8[np.ndarray, "y x 3"]) -> bytes:
    """PNG file of a colour image; OpenCV's default compression is its fastest."""
    return _encode(".png", cv2.cvtColor(image_yxc, cv2.COLOR_RGB2BGR))


def encode_depth(depth_yxc: UInt16[np.ndarray, "y x 1"]) -> bytes:
    """Uncompressed TIFF file of a depth image [mm], which LeRobot's reader gives back without loss."""
    return _encode(".tiff", depth_yxc, _TIFF_UNCOMPRESSED)


def image_statistics(images_nyxc: Images) -> dict[str, np.ndarray]:
    """Statistics of one episode's images, for ``episode_stats`` of LeRobot's metadata.

    At most a few hundred images, evenly spaced, are looked at, and of large ones every k-th pixel: the choice is
    LeRobot's. Minimum, maximum, count and quantiles equal LeRobot's; mean and standard deviation are exact, where
    LeRobot's float32 sums are off by up to a few per cent.

    Args:
        images_nyxc: all images of one camera; uint8 colours or uint16 depth [mm].

    Returns:
        ``min max mean std q01 q10 q50 q90 q99``, each of shape (c, 1, 1), colours in [0, 1], depth in mm; ``count``,
        the number of images looked at, of shape (1,).
    """
    sampled_nyxc = images_nyxc[_sampled_frames(len(images_nyxc))]
    step = _pixel_step(*images_nyxc.shape[1:3])
    sampled_nyxc = sampled_nyxc[:, ::step, ::step]
    scale = 255.0 if images_nyxc.dtype == np.uint8 else 1.0
    channels = [_statistics_of_counts(np.bincount(channel.ravel())) for channel in np.moveaxis(sampled_nyxc, -1, 0)]
    statistics = {
        name: np.array([channel[name] for channel in channels]).reshape(-1, 1, 1) / scale for name in channels[0]
    }
    return statistics | {"count": np.array([len(sampled_nyxc)])}


def _encode(suffix: str, image: np.ndarray, options: tuple[int, ...] = ()) -> bytes:
    done, encoded = cv2.imencode(suffix, image, options)
    assert done, f"OpenCV could not encode a {suffix} image of shape {image.shape}"
    return encoded.tobytes()


def _sampled_frames(n: int) -> Int64[np.ndarray, " sampled"]:
    samples = max(min(_MIN_SAMPLES, n), min(int(n**_SAMPLING_POWER), _MAX_SAMPLES))
    return np.round(np.linspace(0, n - 1, samples)).astype(np.int64)


def _pixel_step(height: int, width: int) -> int:
    longer = max(height, width)
    return 1 if longer < _FULL_SIZE_BELOW else longer // _REDUCED_SIZE


def _statistics_of_counts(counts: Int64[np.ndarray, " value"]) -> dict[str, float]:
    """Statistics of pixels given how often each integer value occurs."""
    values = np.flatnonzero(counts)
    weights = counts[values]
    mean = float(np.average(values, weights=weights))
    std = float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))
    quantiles = _quantiles(values.astype(np.float32), weights)
    names = [f"q{round(100 * q):02d}" for q in QUANTILES]
    return {"min": float(values[0]), "max": float(values[-1]), "mean": mean, "std": std} | dict(
        zip(names, quantiles, strict=True)
    )


def _quantiles(values: np.ndarray, weights: Int64[np.ndarray, " value"]) -> Float64[np.ndarray, " q"]:
    """Quantiles read off a histogram, linear inside a bin: LeRobot's estimate, kept so that datasets compare."""
    edges = np.linspace(values[0] - 1e-10, values[-1] + 1e-10, _QUANTILE_BINS + 1)
    histogram, _ = np.histogram(values, bins=edges, weights=weights)
    below = np.cumsum(histogram)
    wanted = np.array(QUANTILES) * weights.sum()
    bins = np.searchsorted(below, wanted)
    before = np.where(bins > 0, below[bins - 1], 0)
    fractions = np.where(bins > 0, (wanted - before) / np.maximum(histogram[bins], 1), 0.0)
    return edges[bins] + fractions * (edges[bins + 1] - edges[bins])

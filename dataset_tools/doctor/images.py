"""Checks of camera images: blank or frozen pictures, depth in the wrong unit, depth without measurements."""

import io
from collections.abc import Collection, Mapping
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from PIL import Image

from dataset_tools.doctor.findings import Finding, Severity

NEAREST, FARTHEST = 0.02, 20.0
"""Between these [m] lies the median of every camera that looks at a robot's workspace."""
SOME_INVALID, MOST_INVALID = 0.5, 0.95
"""Share of invalid pixels from which there is a warning, and an error."""
MOVED = 0.02
"""After the tool has moved this far [m], a picture must have changed."""
LOSSY = ("JPEG", "WEBP", "MPO")


def lossy_file(file: bytes, camera: str) -> list[Finding]:
    """A colour image is stored without loss."""
    kind = Image.open(io.BytesIO(file)).format
    return [Finding.of("rgb_lossy", f"stored as {kind}", camera=camera)] if kind in LOSSY else []


def image_blank(image: UInt8[np.ndarray, "y x 3"], camera: str, episode: int, frame: int) -> list[Finding]:
    """A colour image has more than one colour."""
    colour = image[0, 0]
    if (image != colour).any():
        return []
    return [Finding.of("image_blank", f"all pixels are {colour.tolist()}", episode, frame, camera)]


def image_frozen(
    images: Mapping[int, UInt8[np.ndarray, "y x 3"]], position: Float[np.ndarray, "n 3"], camera: str, episode: int
) -> list[Finding]:
    """A picture changes when the tool moves.

    Args:
        images: by frame.
        position: of the tool [m], at all frames of the episode.
        camera: which camera.
        episode: which episode.
    """
    for frame, later in pairwise(sorted(images)):
        moved = float(np.linalg.norm(position[later] - position[frame]))
        if moved > MOVED and np.ptp(images[frame]) and np.array_equal(images[frame], images[later]):
            message = f"the same as in frame {frame}, although the tool has moved {100 * moved:.0f} cm"
            return [Finding.of("image_frozen", message, episode, later, camera)]
    return []


def depth_not_finite(depth: Shaped[np.ndarray, "y x"], camera: str, episode: int, frame: int) -> list[Finding]:
    """Depth is a distance, or 0 where nothing was measured."""
    bad = ~(np.isfinite(depth) & (depth >= 0))
    if not bad.any():
        return []
    message = f"depth holds {depth[bad][0]} in {bad.sum()} pixels; invalid ones must be 0"
    return [Finding.of("nan", message, episode, frame, camera)]


def depth_unit(depths: Collection[Float[np.ndarray, "y x"]], stored: str, camera: str, episode: int) -> list[Finding]:
    """The median of valid depth [m] is that of a workspace; ``stored`` is the unit that was understood."""
    valid = np.concatenate([depth[depth > 0] for depth in depths])
    if not len(valid) or NEAREST <= np.median(valid) <= FARTHEST:
        return []
    median = float(np.median(valid))
    likely = "metres stored as millimetres" if median < NEAREST else "millimetres stored as metres"
    message = f"declared or taken as {stored}, the median is {median:.4g} m; probably {likely}"
    return [Finding.of("depth_unit", message, episode, camera=camera)]


def depth_invalid(depths: Collection[Float[np.ndarray, "y x"]], camera: str, episode: int) -> list[Finding]:
    """Most pixels of depth images have a measurement."""
    share = float(np.mean([1 - np.mean(depth > 0) for depth in depths]))
    if share <= SOME_INVALID:
        return []
    severity = Severity.ERROR if share > MOST_INVALID else Severity.WARNING
    return [Finding.of("depth_invalid", f"{share:.0%} of the pixels", episode, camera=camera, severity=severity)]

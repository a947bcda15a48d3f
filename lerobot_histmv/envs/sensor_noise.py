"""Noise of cameras: colour noise, the depth of a RealSense D435, a card in the way. Pure functions of images."""

import numpy as np
from jaxtyping import UInt8, UInt16

RGB_NOISE = 6.0
"""Standard deviation of colours at strength 1, of 255."""
SUBPIXEL, FOCAL_BASELINE = 0.08, 32.0
"""A D435 finds disparities to 0.08 pixels (RMS) at a focal length of 640 pixels and a baseline of 5 cm, so that its
depth errors are z^2 * SUBPIXEL / FOCAL_BASELINE [m]."""
EDGE = 20
"""Depth step to a neighbouring pixel [mm] that the stereo matcher does not resolve."""
EDGE_HOLES, DROPOUTS = 0.5, 0.01
"""Shares of edge pixels and of all pixels without depth at strength 1."""
CARD_DEPTH = 250
"""Distance of the occluding card from the camera [mm]."""
CARD_COLOR = (120, 124, 130)
CARD_WIDTH = 0.3
"""Share of the picture's width that it hides at strength 1."""


def noisy_colors(
    image: UInt8[np.ndarray, "h w 3"], strength: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Independent Gaussian noise on every channel."""
    noise = rng.normal(0, strength * RGB_NOISE, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def stereo_depth(
    depth: UInt16[np.ndarray, "h w 1"], strength: float, rng: np.random.Generator
) -> UInt16[np.ndarray, "h w 1"]:
    """Depth [mm] as an active stereo camera measures it: noise growing with z^2, holes at edges, dropouts."""
    metres = depth.astype(np.float64) / 1000
    noisy = 1000 * (metres + strength * metres**2 * SUBPIXEL / FOCAL_BASELINE * rng.normal(size=depth.shape))
    lost = rng.random(depth.shape) < DROPOUTS * strength
    lost |= edges(depth) & (rng.random(depth.shape) < EDGE_HOLES * strength)
    lost |= depth == 0
    return np.where(lost, 0, np.clip(np.rint(noisy), 1, 65535)).astype(np.uint16)


def edges(depth: UInt16[np.ndarray, "h w 1"]) -> np.ndarray:
    """Pixels whose depth differs by more than ``EDGE`` from that of one of their four neighbours."""
    wide = np.pad(depth.astype(np.int32), ((1, 1), (1, 1), (0, 0)), mode="edge")
    centre = wide[1:-1, 1:-1]
    others = (wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:])
    return np.any([np.abs(centre - other) > EDGE for other in others], axis=0)


def hide_behind_card(
    image: UInt8[np.ndarray, "h w 3"], depth: UInt16[np.ndarray, "h w 1"], left: float, width: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "h w 1"]]:
    """Picture and depth with a card in front from ``left`` on, ``width`` wide (shares of the picture's width)."""
    size = image.shape[1]
    columns = slice(round(left * size), round((left + width) * size))
    image, depth = image.copy(), depth.copy()
    image[:, columns] = CARD_COLOR
    depth[:, columns] = CARD_DEPTH
    return image, depth

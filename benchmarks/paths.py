"""The named set of paths on which keyframing methods are compared: smooth reaches without any pause.

* ``min_jerk``: minimum-jerk reaches (Flash and Hogan 1985) between random points, each beginning before the last one
  has ended, so that the tool never rests.
* ``human``: the same with submovements, 8 to 12 Hz tremor and 0.3 mm of sensor noise.
* ``press``: minimum-jerk reaches to over a button, straight down, back the same way and aside.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

RATE = 20.0
"""Frames per second."""
OVERLAP = 0.35
"""Share of a reach during which the next one is under way already."""
TREMOR, NOISE = 0.0008, 0.0003
"""Amplitude of the tremor and standard deviation of the noise [m]."""
KINDS = ("min_jerk", "human", "press")
SMOOTH = KINDS[:2]
"""Those on which methods are compared; a path that returns on itself shows what the distance is for."""


def profile(time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Share of a minimum-jerk reach that is done at each share of its time."""
    share = np.clip(time, 0, 1)
    return share**3 * (10 - 15 * share + 6 * share**2)


def min_jerk(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """A path of reaches of about 1.5 s in a box of 0.4 x 0.6 x 0.4 m [m]."""
    reaches = max(2, round((frames - 1) / RATE / 1.5))
    corners = rng.uniform([0.25, -0.3, 0.05], [0.65, 0.3, 0.45], (reaches + 1, 3))
    return blended(corners, rng.uniform(0.7, 1.3, reaches), frames)


def press(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """A path over a button, down by 12 cm, up and aside [m]."""
    begin, over, end = rng.uniform([0.25, -0.3, 0.2], [0.65, 0.3, 0.45], (3, 3))
    return blended(np.stack([begin, over, over - [0, 0, 0.12], over, end]), rng.uniform(0.7, 1.3, 4), frames)


def blended(
    corners: Float[np.ndarray, "c 3"], lengths: Float[np.ndarray, " r"], frames: int
) -> Float[np.ndarray, "n 3"]:
    """Reaches from corner to corner with relative durations, each beginning before the last one has ended."""
    seconds = np.arange(frames) / RATE
    begins = np.concatenate([[0], np.cumsum(lengths[:-1] * (1 - OVERLAP))])
    scale = seconds[-1] / (begins[-1] + lengths[-1])
    done = [
        profile((seconds - scale * begin) / (scale * length)) for begin, length in zip(begins, lengths, strict=True)
    ]
    return corners[0] + sum(share[:, None] * step for share, step in zip(done, np.diff(corners, axis=0), strict=True))


def human(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """``min_jerk`` with small corrections, tremor and noise [m]."""
    path, seconds = min_jerk(frames, rng), np.arange(frames) / RATE
    for begin in rng.uniform(0, seconds[-1], max(2, frames // 25)):
        path += profile((seconds - begin) / 0.4)[:, None] * rng.normal(0, 0.006, 3)
    frequency, phase = rng.uniform(8, 12, 3), rng.uniform(0, 2 * np.pi, 3)
    tremor = TREMOR * np.sin(2 * np.pi * frequency * seconds[:, None] + phase)
    return path + tremor + rng.normal(0, NOISE, path.shape)


def paths(kind: str, frames: int, count: int) -> Iterator[Float[np.ndarray, "n 3"]]:
    """The first ``count`` paths of a kind and length; always the same ones."""
    make = {"min_jerk": min_jerk, "human": human, "press": press}[kind]
    for number in range(count):
        yield make(frames, np.random.default_rng([KINDS.index(kind), frames, number]))

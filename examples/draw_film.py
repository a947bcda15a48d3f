"""Stills of a film that ``histmv eval`` or ``make demo`` made, in reading order.

``python examples/draw_film.py outputs/demo/evaluation/videos/pick_and_lift/200000.mp4 docs/images/decisions.png``
"""

import sys

import av
import numpy as np
from PIL import Image

ROWS, COLUMNS = 2, 2


def main(film: str, picture: str) -> None:
    """Frames at equal distances, the first and the last among them, on one page."""
    with av.open(film) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    stills = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, ROWS * COLUMNS)]
    page = np.vstack([np.hstack(stills[row * COLUMNS : (row + 1) * COLUMNS]) for row in range(ROWS)])
    Image.fromarray(page).quantize(128).save(picture, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

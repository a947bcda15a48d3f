"""All decisions of an episode below each other, and the film of them: the boards with what belongs around them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from dataset_tools import overlay
from dataset_tools.eval_film import Film
from dataset_tools.explain.board import BOARD, decision_text, draw_board
from dataset_tools.explain.episode import Explained
from dataset_tools.explain.watch import Record
from dataset_tools.overlay import BACKGROUND, GAP, MAIN, MUTED, TEXT, font
from dataset_tools.video import VideoWriter

HOLD = 2.0
"""How long a film shows each decision on a dataset's row [s]."""
HEAD = 30
"""Height of the line over a decision's board [pixels]."""


def draw_sheet(episode: Explained) -> Image.Image:
    """All decisions, two beside each other."""
    rows = -(-len(episode.records) // 2)
    width, height = BOARD + 6 * GAP, HEAD + MAIN + 2 * GAP
    sheet = Image.new("RGB", (2 * width, rows * height), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for index, record in enumerate(episode.records):
        left, top = index % 2 * width + 3 * GAP, index // 2 * height
        truth = None if episode.truth is None else episode.truth[index]
        text = f"{index + 1}:  {decision_text(record, truth)}"
        draw.text((left, top + 6), text, font=font(16), fill=TEXT)
        sheet.paste(draw_board(episode.records[: index + 1], truth), (left, top + HEAD))
    return sheet


class ExplainedFilm(Film):
    """A film whose decisions are shown as boards beside the moving picture.

    Args:
        records: decisions so far; the last one is shown.
        path: mp4 file.
        fps: frames per second.
    """

    def __init__(self, records: Sequence[Record], path: Path, fps: int) -> None:
        super().__init__(path, fps)
        self._records, self._shown = records, 0

    def show(self, scene: overlay.Scene, frames: Sequence[UInt8[np.ndarray, "y x 3"]]) -> None:
        """Append the frames of one step beside the decision that led to it; a new one is shown before the arm moves."""
        if self._shown < len(self._records):
            self._shown = len(self._records)
            self._canvas = _canvas(self._records, scene.instruction)
            self.hold(overlay.draw_frame(self._canvas, frames[0], f"decision {self._shown}"))
        self.add(self._canvas, scene.step, frames)


def film_rows(episode: Explained, path: Path, fps: int) -> None:
    """Write a film of the decisions on a dataset's rows: still pictures, as nothing was recorded between them."""
    with VideoWriter(path, fps) as video:
        for index, record in enumerate(episode.records):
            truth = None if episode.truth is None else episode.truth[index]
            canvas = _canvas(episode.records[: index + 1], episode.instruction, truth)
            still = next(iter(record.views.values())).color
            frame = overlay.draw_frame(canvas, still, f"step {index + 1}")
            for _ in range(round(HOLD * fps)):
                video.add(frame)


def _canvas(records: Sequence[Record], instruction: str, truth: Float[np.ndarray, " 8"] | None = None) -> Image.Image:
    """All of a frame but the moving picture and its status."""
    canvas = Image.new("RGB", (MAIN + BOARD + 4 * GAP, overlay.HEIGHT), BACKGROUND)
    canvas.paste(draw_board(records, truth), (MAIN + 3 * GAP, GAP))
    draw = ImageDraw.Draw(canvas)
    left, top = 2 * GAP, MAIN + 3 * GAP
    draw.text((left, top), overlay.fitting(instruction, 18, canvas.width - 2 * left), font=font(18), fill=TEXT)
    draw.text((MAIN + 3 * GAP, top + 26), decision_text(records[-1], truth), font=font(16), fill=MUTED)
    return canvas

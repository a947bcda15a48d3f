"""The picture of one decision: every view under its heat map, how the views were weighed, what was looked back at."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from dataset_tools.explain.watch import Record
from dataset_tools.inspect.cameras import CameraView
from dataset_tools.overlay import (
    BACKGROUND,
    CHOSEN,
    FAINT,
    GAP,
    MAIN,
    MUTED,
    TEXT,
    Color,
    View,
    draw_tile,
    font,
)
from lerobot_histmv.geometry import project

BOARD = 620
"""Width of the picture [pixels]; it is as high as a film's moving picture."""
LARGEST = (BOARD - 2 * GAP) // 3
"""Side of a view's tile when there are three views [pixels]; smaller for more."""
BAR, LINE = 8, 17
THUMB = 62
LEFT = 78
"""Room for the words left of the bars [pixels]."""


def draw_board(records: Sequence[Record], truth: Float[np.ndarray, " 8"] | None = None) -> Image.Image:
    """The last of ``records``, whose history the others are; ``truth`` is where the demonstration went."""
    now = records[-1]
    board = Image.new("RGB", (BOARD, MAIN), BACKGROUND)
    draw = ImageDraw.Draw(board)
    top = _views(board, draw, now, truth)
    _memory(board, draw, records, top + 2 * GAP)
    return board


def decision_text(record: Record, truth: Float[np.ndarray, " 8"] | None = None) -> str:
    """Where the tool is sent and what the gripper shall do."""
    x, y, z = record.action[:3]
    gripper, sure = ("open", record.opening) if record.action[7] > 0.5 else ("closed", 1 - record.opening)
    text = f"next pose {x:.3f}, {y:.3f}, {z:.3f} m, gripper {gripper} ({100 * sure:.0f} %)"
    if truth is None:
        return text
    wrong = "" if (record.action[7] > 0.5) == (truth[7] > 0.5) else ", gripper wrong"
    return f"{text};  {1000 * np.linalg.norm(record.action[:3] - truth[:3]):.0f} mm off{wrong}"


def seen_target(view: CameraView, position: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 2"]:
    """Column and row at which a view sees a world point; NaN behind it."""
    assert view.intrinsics is not None and view.world_from_cam is not None
    return project(position[None], view.intrinsics, view.world_from_cam)[0][0]


def tile(record: Record, index: int, side: int, truth: Float[np.ndarray, " 8"] | None) -> Image.Image:
    """View ``index`` of a decision under its heat map."""
    camera, view = list(record.views.items())[index]
    drawn = View(
        camera,
        view.color,
        target=seen_target(view, record.action[:3]),
        truth=None if truth is None else seen_target(view, truth[:3]),
    )
    return draw_tile(drawn, side, record.heat[index], index == record.chosen)


def _views(board: Image.Image, draw: ImageDraw.ImageDraw, record: Record, truth: Float[np.ndarray, " 8"] | None) -> int:
    """The views beside each other, with the two numbers that choose among them; returns where they end."""
    side = min(LARGEST, (BOARD - (len(record.views) - 1) * GAP) // len(record.views))
    for index, camera in enumerate(record.views):
        left, chosen = index * (side + GAP), index == record.chosen
        color = CHOSEN if chosen else TEXT
        draw.text((left, 0), f"{camera}{': acts' if chosen else ''}", font=font(14), fill=color)
        board.paste(tile(record, index, side, truth), (left, LINE + 2))
        top = LINE + 2 + side + GAP
        for name, share in (("weight", record.weights[index]), (record.choosing.support, record.support[index])):
            _bar(draw, (left, top), side, name, float(share), color if chosen else MUTED)
            top += LINE
        draw.text((left, top - 1), _alone(record, index, truth), font=font(13), fill=MUTED)
    return top + LINE


def _alone(record: Record, index: int, truth: Float[np.ndarray, " 8"] | None) -> str:
    """How far off the true position a view would have sent the tool by itself, or how far from where it was sent."""
    aim = record.action[:3] if truth is None else truth[:3]
    distance = 100 * np.linalg.norm(record.targets[index] - aim)
    return f"alone: {distance:.1f} cm {'elsewhere' if truth is None else 'off'}"


def _bar(draw: ImageDraw.ImageDraw, place: tuple[int, int], side: int, name: str, share: float, color: Color) -> None:
    left, top = place
    draw.text((left, top - 1), name, font=font(13), fill=MUTED)
    start, end = left + LEFT, left + side - 2 * GAP - 28
    draw.rectangle((start, top + 4, end, top + 4 + BAR), fill=FAINT)
    draw.rectangle((start, top + 4, start + round((end - start) * share), top + 4 + BAR), fill=color)
    draw.text((left + side - GAP, top - 1), f"{100 * share:.0f} %", font=font(12), fill=MUTED, anchor="ra")


def _without_past(record: Record) -> str:
    """What would have been decided from the present alone; empty for a decision without a past."""
    if not len(record.influence):
        return ""
    opens = record.opening_without_past > 0.5
    same = "the same" if opens == (record.opening > 0.5) else "open" if opens else "closed"
    return f"without its past: target {100 * record.memory:.1f} cm elsewhere, gripper {same}"


def _memory(board: Image.Image, draw: ImageDraw.ImageDraw, records: Sequence[Record], top: int) -> None:
    """The steps of the history, each as its chosen view saw it, with the attention that it got."""
    now = records[-1]
    shares = now.attention.mean(axis=0)
    draw.text((0, top), "attention over steps", font=font(14), fill=TEXT)
    draw.text((BOARD - 1, top), _without_past(now), font=font(13), fill=MUTED, anchor="ra")
    column = BOARD // max(6, len(shares))
    for index, (share, past) in enumerate(zip(shares, records[-len(shares) :], strict=True)):
        left, below = index * column, top + LINE + 4
        size = min(THUMB, column - GAP)
        board.paste(tile(past, past.chosen, size, None), (left, below))
        number = len(records) - len(shares) + index + 1
        label = "now" if index == len(shares) - 1 else f"{number}"
        draw.text((left + size + 4, below), label, font=font(12), fill=MUTED)
        draw.text((left + size + 4, below + size - 16), f"{100 * share:.0f}%", font=font(12), fill=TEXT)
        height = round((size - 36) * share)
        draw.rectangle((left + size + 6, below + 18, left + size + 16, below + size - 18), fill=FAINT)
        draw.rectangle((left + size + 6, below + size - 18 - height, left + size + 16, below + size - 18), fill=MUTED)
        if index < len(now.influence):
            moved = f"{100 * now.influence[index]:.1f} cm"
            draw.text((left, below + size + 2), moved, font=font(12), fill=MUTED)

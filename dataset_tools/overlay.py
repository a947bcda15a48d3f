"""Pictures of an evaluation: the scene, the views, and what the policy made of them.

Left the front camera while the arm moves; right of it the views of the last decision with the heat map over the chosen
one, a cross where each view sees the predicted target, and the view weights; below the instruction and the outcome.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

MAIN = 392
"""Side of the large picture [pixels]."""
GAP = 4
TILE = 128
"""Side of a view's tile [pixels]; smaller when more than three views share the height."""
BARS = 124
CAPTION = 64
WIDTH = MAIN + TILE + BARS + 4 * GAP
HEIGHT = MAIN + CAPTION + 2 * GAP

Color = tuple[int, int, int]
BACKGROUND: Color = (22, 24, 29)
FAINT: Color = (58, 62, 72)
TEXT: Color = (232, 234, 240)
MUTED: Color = (150, 156, 170)
CHOSEN: Color = (255, 176, 32)
TARGET: Color = (64, 255, 160)
TRUTH: Color = (255, 255, 255)
SUCCESS: Color = (64, 200, 110)
FAILURE: Color = (235, 84, 84)
HEAT_OPACITY = 0.8


@dataclass(frozen=True, eq=False)
class View:
    """One camera at a decision.

    Args:
        camera: its name.
        image: what it saw.
        weight: its share w; None when the policy weighs no views.
        target: column and row [pixels] at which it sees the predicted target; NaN when behind it.
        truth: the same of the target that a demonstration went to; None when there is none.
    """

    camera: str
    image: UInt8[np.ndarray, "y x 3"]
    weight: float | None = None
    target: Float[np.ndarray, " 2"] | None = None
    truth: Float[np.ndarray, " 2"] | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is drawn besides the moving picture.

    Args:
        instruction: what the policy was told.
        step: number of the decision, from 1.
        views: all cameras.
        chosen: index of the view that was decoded; None when the policy chooses none.
        heat: heat map over the chosen view, any positive scale.
    """

    instruction: str
    step: int
    views: Sequence[View] = field(default_factory=list)
    chosen: int | None = None
    heat: Float[np.ndarray, "y x"] | None = None


@cache
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own typeface at ``size`` pixels."""
    return ImageFont.load_default(size)


def resized(image: UInt8[np.ndarray, "y x 3"], side: int) -> Image.Image:
    """``image`` scaled so that its longer side measures ``side``, centred on a square."""
    picture = Image.fromarray(image)
    scale = side / max(picture.size)
    picture = picture.resize((round(picture.width * scale), round(picture.height * scale)), Image.Resampling.BICUBIC)
    square = Image.new("RGB", (side, side), BACKGROUND)
    square.paste(picture, ((side - picture.width) // 2, (side - picture.height) // 2))
    return square


def blend_heat(image: UInt8[np.ndarray, "y x 3"], heat: Float[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x 3"]:
    """``image``, darkened, under the heat map; opacity follows the root of the heat so that weak modes stay visible."""
    strength = np.sqrt(np.clip(heat / max(float(heat.max()), np.finfo(np.float32).tiny), 0, 1))
    colours = 255 * matplotlib.colormaps["inferno"](0.25 + 0.75 * strength)[..., :3]
    opacity = HEAT_OPACITY * strength[..., None]
    return (0.7 * image * (1 - opacity) + colours * opacity).astype(np.uint8)


def draw_tile(view: View, side: int, heat: Float[np.ndarray, "y x"] | None, chosen: bool) -> Image.Image:
    """A view on a square of ``side`` pixels: under its heat map, with its target and truth, framed if chosen."""
    image = view.image if heat is None else blend_heat(view.image, heat)
    tile = resized(image, side)
    draw = ImageDraw.Draw(tile)
    rows, columns = image.shape[:2]
    scale = side / max(rows, columns)
    inset = (side - scale * np.array([columns, rows])) / 2
    if view.truth is not None and np.isfinite(view.truth).all():
        u, v = (view.truth + 0.5) * scale + inset
        draw.ellipse((u - 6, v - 6, u + 6, v + 6), outline=TRUTH, width=2)
    if view.target is not None and np.isfinite(view.target).all():
        u, v = (view.target + 0.5) * scale + inset
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            draw.line((u + 4 * du, v + 4 * dv, u + 10 * du, v + 10 * dv), fill=TARGET, width=2)
    if chosen:
        draw.rectangle((0, 0, side - 1, side - 1), outline=CHOSEN, width=3)
    return tile


def _bar(draw: ImageDraw.ImageDraw, left: int, top: int, view: View, chosen: bool) -> None:
    draw.text((left, top), view.camera, font=font(14), fill=CHOSEN if chosen else TEXT)
    if view.weight is None:
        return
    width = BARS - GAP
    draw.rectangle((left, top + 22, left + width, top + 34), fill=FAINT)
    draw.rectangle((left, top + 22, left + round(width * view.weight), top + 34), fill=CHOSEN if chosen else MUTED)
    draw.text((left, top + 40), f"{100 * view.weight:.0f} %", font=font(13), fill=MUTED)
    if chosen:
        draw.text((left, top + 58), "chosen", font=font(13), fill=CHOSEN)


def draw_scene(scene: Scene) -> Image.Image:
    """The whole picture but for the moving part: views, weights, instruction."""
    canvas = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    count = max(3, len(scene.views))
    side = min(TILE, (MAIN - (count - 1) * GAP) // count)
    for index, view in enumerate(scene.views):
        chosen = index == scene.chosen
        left, top = MAIN + 2 * GAP, GAP + index * (side + GAP)
        canvas.paste(draw_tile(view, side, scene.heat if chosen else None, chosen), (left, top))
        _bar(draw, left + side + 2 * GAP, top + 4, view, chosen)
    draw.text((2 * GAP, MAIN + 3 * GAP), fitting(scene.instruction, 18, WIDTH - 4 * GAP), font=font(18), fill=TEXT)
    return canvas


def draw_frame(
    canvas: Image.Image, frame: UInt8[np.ndarray, "y x 3"], status: str, color: Color = MUTED
) -> UInt8[np.ndarray, "y2 x2 3"]:
    """One video frame: ``canvas`` of ``draw_scene`` with the moving picture and a line of ``status``."""
    picture = canvas.copy()
    picture.paste(resized(frame, MAIN), (GAP, GAP))
    draw = ImageDraw.Draw(picture)
    draw.text((2 * GAP, MAIN + 3 * GAP + 26), status, font=font(16), fill=color)
    if color is not MUTED:
        draw.rectangle((GAP, GAP, GAP + MAIN - 1, GAP + MAIN - 1), outline=color, width=4)
    return np.asarray(picture)


def fitting(text: str, size: int, width: int) -> str:
    """``text``, cut at the end so that it fits into ``width`` pixels."""
    typeface = font(size)
    if typeface.getlength(text) <= width:
        return text
    while text and typeface.getlength(text + "...") > width:
        text = text[:-1]
    return text + "..."

"""The demo's pictures: the loss curve from LeRobot's training log, and a contact sheet of one keyframed episode."""

import io
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
from jaxtyping import UInt8, UInt16
from matplotlib.figure import Figure
from PIL import Image

from dataset_tools.figure_style import look
from lerobot_histmv import keys

LOG_FREQUENCY = re.compile(r"'log_freq': (\d+)")
LOSS = re.compile(r"\bstep:\S+ .*?\bloss:([-+.\deE]+|nan|inf)")
CHECKPOINT = re.compile(r"Checkpoint policy after step (\d+)")
START = "Start offline training"

DEPTH_SHOWN = (2.0, 85.0)
"""Percentiles of a camera's depth that its pictures span."""


@dataclass(frozen=True)
class LossHistory:
    """Training loss (mean over each logging period) and the steps at which it was logged."""

    steps: list[int]
    losses: list[float]


def read_losses(lines: Iterable[str]) -> LossHistory:
    """The loss curve in ``lerobot-train``'s output; runs that were continued are joined at the checkpoint.

    LeRobot prints steps above 999 rounded to thousands, so steps are counted from the logging period and the
    checkpoints, whose numbers are exact.
    """
    period, step, checkpoint = 1, 0, 0
    found: dict[int, float] = {}
    for line in lines:
        if match := LOG_FREQUENCY.search(line):
            period = int(match[1])
        elif START in line:
            step = checkpoint - checkpoint % period
        elif match := CHECKPOINT.search(line):
            checkpoint = int(match[1])
        elif match := LOSS.search(line):
            step += period
            found[step] = float(match[1])
    return LossHistory(sorted(found), [found[step] for step in sorted(found)])


def draw_losses(history: LossHistory, path: Path) -> None:
    """Write the loss curve as a picture."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(history.steps, history.losses, color="tab:blue", linewidth=1.5)
    if history.losses and min(history.losses) > 0:
        axes.set_yscale("log")
    axes.set_xlabel("training step")
    axes.set_ylabel("loss")
    axes.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)


@dataclass(frozen=True)
class Keyframe:
    """One row of a keyframed dataset, ready to be shown.

    Args:
        pictures: camera -> colours (h, w, 3) and depth [mm] (h, w) or None.
        reason: why the observed keyframe was kept.
        seconds: its time in the recorded episode.
        instruction: the task's text.
    """

    pictures: dict[str, tuple[UInt8[np.ndarray, "h w 3"], UInt16[np.ndarray, "h w"] | None]]
    reason: str
    seconds: float
    instruction: str


def read_keyframes(root: Path, episode: int) -> list[Keyframe]:
    """Rows of one episode of a keyframed dataset, read without LeRobot.

    Raises:
        ValueError: the dataset has no such episode.
    """
    features = json.loads((root / "meta" / "info.json").read_text())["features"]
    cameras = [
        key.removeprefix(keys.IMAGES_PREFIX)
        for key in features
        if key.startswith(keys.IMAGES_PREFIX) and not key.endswith(keys.DEPTH_SUFFIX)
    ]
    table = pyarrow.dataset.dataset(root / "data", format="parquet")
    rows = table.to_table(filter=pyarrow.dataset.field("episode_index") == episode).to_pylist()
    if not rows:
        raise ValueError(f"{root} has no episode {episode}")
    tasks = pyarrow.dataset.dataset(root / "meta" / "tasks.parquet").to_table().to_pandas()
    instructions = dict(zip(tasks["task_index"], tasks.index, strict=True))
    return [
        Keyframe(
            pictures={camera: (image(row[keys.rgb_key(camera)]), depth_of(row, camera)) for camera in cameras},
            reason=keys.REASONS[scalar(row[keys.REASON])],
            seconds=float(scalar(row[keys.SOURCE_TIMESTAMP])),
            instruction=str(instructions[row["task_index"]]),
        )
        for row in sorted(rows, key=lambda row: row["frame_index"])
    ]


def image(stored: dict[str, Any]) -> np.ndarray:
    """The pixels of an image column's value."""
    return np.asarray(Image.open(io.BytesIO(stored["bytes"])))


def depth_of(row: dict[str, Any], camera: str) -> UInt16[np.ndarray, "h w"] | None:
    """Depth [mm] of ``camera``, if the dataset has any."""
    stored = row.get(keys.depth_key(camera))
    return None if stored is None else image(stored).astype(np.uint16)


def scalar(value: Any) -> Any:
    """The number in a feature of shape (1,), which is stored as a list or as itself."""
    return value[0] if isinstance(value, list) else value


def depth_range(keyframes: list[Keyframe], camera: str) -> tuple[float, float]:
    """Depth [mm] that the first and last colour of ``camera``'s depth pictures stand for; invalid depth is left out."""
    depths = [depth for frame in keyframes if (depth := frame.pictures[camera][1]) is not None]
    valid = np.concatenate([depth[depth > 0] for depth in depths])
    low, high = np.percentile(valid, DEPTH_SHOWN) if len(valid) else (0.0, 1.0)
    return float(low), float(high)


def contact_sheet(keyframes: list[Keyframe]) -> Figure:
    """One episode as a picture: a row per keyframe, colours and depth of each camera side by side."""
    panels = [
        (camera, kind)
        for camera, pair in keyframes[0].pictures.items()
        for kind, pixels in enumerate(pair)
        if pixels is not None
    ]
    rows, columns = len(keyframes), len(panels)
    figure = Figure(figsize=(1.5 * columns + 0.9, 1.5 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for (camera, is_depth), axes_of_column in zip(panels, grid.T, strict=True):
        axes_of_column[0].set_title(f"{camera} depth" if is_depth else camera, fontsize=9)
        low, high = depth_range(keyframes, camera) if is_depth else (None, None)
        for frame, axes in zip(keyframes, axes_of_column, strict=True):
            pixels = frame.pictures[camera][is_depth]
            axes.imshow(np.ma.masked_equal(pixels, 0) if is_depth else pixels, vmin=low, vmax=high)
            axes.set(xticks=[], yticks=[])
    for number, (frame, axes) in enumerate(zip(keyframes, grid[:, 0], strict=True)):
        label = f"{number}: {frame.reason}\n{frame.seconds:.2f} s"
        axes.set_ylabel(label, fontsize=9, color=look(frame.reason).color)
    figure.suptitle(f"“{keyframes[0].instruction}”", fontsize=11)
    return figure


def draw_contact_sheet(keyframes: list[Keyframe], path: Path) -> None:
    """Write the contact sheet of one episode."""
    contact_sheet(keyframes).savefig(path, dpi=110)

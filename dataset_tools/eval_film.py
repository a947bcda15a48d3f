"""The video of one episode at the environment's frame rate, with what the policy saw and decided drawn in."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from lerobot.policies import PreTrainedPolicy
from PIL import Image

from dataset_tools import overlay
from dataset_tools.video import VideoWriter
from lerobot_histmv import geometry

HOLD_SECONDS = 1.0
"""How long the last picture, with the outcome, stays."""


class Film:
    """Writes one episode's video; nothing is left behind when it is abandoned.

    Args:
        path: mp4 file.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: int) -> None:
        self.fps = fps
        self._writer = VideoWriter(path, fps)
        self._frames = 0
        self._last: UInt8[np.ndarray, "y x 3"] | None = None

    def show(self, scene: overlay.Scene, frames: Sequence[UInt8[np.ndarray, "y x 3"]]) -> None:
        """Append the frames of one step under the decision that led to it."""
        self.add(overlay.draw_scene(scene), scene.step, frames)

    def add(self, canvas: Image.Image, step: int, frames: Sequence[UInt8[np.ndarray, "y x 3"]]) -> None:
        """Append the frames of one step on the ``canvas`` that was drawn of its decision."""
        self._canvas = canvas
        for frame in frames:
            self._frames += 1
            self._last = frame
            status = f"step {step}     {self._seconds():.1f} s"
            self._writer.add(overlay.draw_frame(self._canvas, frame, status))

    def finish(self, failure: str, success: bool) -> None:
        """Hold the last picture with the outcome and close the file."""
        assert self._last is not None
        outcome = "success" if success else f"failed: {failure}"
        color = overlay.SUCCESS if success else overlay.FAILURE
        picture = overlay.draw_frame(self._canvas, self._last, f"{outcome}     {self._seconds():.1f} s", color)
        self.hold(picture)
        self._writer.close()

    def hold(self, picture: UInt8[np.ndarray, "y x 3"]) -> None:
        """Append a whole frame that stays for a while, so that it can be read."""
        for _ in range(round(HOLD_SECONDS * self.fps)):
            self._writer.add(picture)

    def abandon(self) -> None:
        """Delete the unfinished file."""
        self._writer.abandon()

    def _seconds(self) -> float:
        return self._frames / self.fps


def chosen_views(policy: PreTrainedPolicy) -> list[str] | None:
    """Camera of the most informative view in each scene's last decision; None for policies that choose none."""
    decision = getattr(policy, "last_decision", None)
    if decision is None:
        return None
    return [policy.config.cameras[view] for view in decision.view.tolist()]


def describe(
    policy: PreTrainedPolicy,
    observation: dict[str, Any],
    action: Float[np.ndarray, "b a"],
    instruction: str,
    step: int,
    row: int,
) -> overlay.Scene:
    """What scene ``row`` showed and what was decided for it.

    Args:
        policy: right after its decision.
        observation: the vector environment's, before the step.
        action: the decided actions.
        instruction: what the policy was told.
        step: number of the decision, from 1.
        row: index of the scene in the batch.
    """
    decision = getattr(policy, "last_decision", None)
    pixels = observation["pixels"]
    if decision is None:
        return overlay.Scene(instruction, step, [overlay.View(camera, image[row]) for camera, image in pixels.items()])
    intrinsics = observation["camera_intrinsics"][row].reshape(-1, 4)
    extrinsics = observation["camera_extrinsics"][row].reshape(-1, 3, 4)
    views = []
    for index, camera in enumerate(policy.config.cameras):
        target, _ = geometry.project(action[row : row + 1, :3], intrinsics[index], extrinsics[index])
        views.append(overlay.View(camera, pixels[camera][row], float(decision.weights[row, index]), target[0]))
    heat = decision.heat[row].cpu().numpy()
    return overlay.Scene(instruction, step, views, int(decision.view[row]), heat)

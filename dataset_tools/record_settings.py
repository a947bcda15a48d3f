"""What decides a recorded dataset, so that a resumed recording cannot mix two."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from lerobot_histmv.envs.disturbances import CLEAN, Disturbances
from lerobot_histmv.motion import TICK

CONTROL_RATE = round(1 / TICK)
"""Ticks per second at which the expert acts."""
SEED_LIMIT = 100_000
"""Scenes from this seed on belong to evaluation."""


@dataclass(frozen=True)
class RecordSettings:
    """Everything that decides the bytes of the dataset but the number of its episodes.

    Args:
        tasks: names of the tasks; every one gets as many episodes.
        variation: the one to record; None: all of them in turn.
        cameras: names, in the order of the calibration vectors.
        image_size: side of the images [pixels].
        fps: frames per second; divides ``CONTROL_RATE``.
        seed: scene seed of the first attempt, below ``SEED_LIMIT``.
        disturbances: what makes episodes harder.
    """

    tasks: tuple[str, ...]
    variation: int | None
    cameras: tuple[str, ...]
    image_size: int
    fps: int
    seed: int
    disturbances: Disturbances = CLEAN

    def __post_init__(self) -> None:
        accepted = [rate for rate in range(1, CONTROL_RATE + 1) if CONTROL_RATE % rate == 0]
        if self.fps not in accepted:
            raise ValueError(
                f"fps is {self.fps}; the arm is controlled at {CONTROL_RATE} Hz, so accepted are {accepted}"
            )
        if not 0 <= self.seed < SEED_LIMIT:
            raise ValueError(f"seed is {self.seed}; recordings use scene seeds from 0 to {SEED_LIMIT - 1}")

    @property
    def stride(self) -> int:
        """Control ticks per recorded frame."""
        return CONTROL_RATE // self.fps

    def as_json(self) -> dict[str, Any]:
        """The same as a JSON file gives it back."""
        return {**dataclasses.asdict(self), "tasks": list(self.tasks), "cameras": list(self.cameras)}

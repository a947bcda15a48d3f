"""A stand-in with what a recording needs of the UR5 environments: seeds decide everything, no simulator."""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from dataset_tools.record import Recorder

CAMERAS = ("left", "right")
SIZE = 17
FAILING_SEEDS = (2, 5)
PARAPHRASES = (("lift red", "raise red"), ("lift blue", "raise blue", "pick blue up"))
TICKS_PER_MOTION = 5


@dataclass
class FakeTick:
    action: np.ndarray


class FakeEnv:
    """Two motions of five ticks; the gripper closes with the second.

    Args:
        task: what it is asked for; it makes no difference.
        seconds: how long an episode takes.
        crash_file: while this file exists, every episode ends its process.
        error_file: while this file exists, every episode raises.
    """

    def __init__(self, task: str = "", seconds: float = 0.0, crash_file: str = "", error_file: str = "") -> None:
        self.task, self.seconds, self.crash_file, self.error_file = task, seconds, crash_file, error_file

    def failure(self) -> str:
        return "grasp missed"

    def close(self) -> None:
        pass

    @property
    def variations(self) -> range:
        return range(len(PARAPHRASES))

    def reset(self, *, seed: int, options: dict[str, int] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.seed, self.ticks = seed, 0
        rng = np.random.default_rng(seed)
        self.variation = (options or {}).get("variation", 0)
        instruction = self.paraphrases[int(rng.integers(len(self.paraphrases)))]
        return self.observe(), {"variation": self.variation, "instruction": instruction}

    @property
    def paraphrases(self) -> tuple[str, ...]:
        return PARAPHRASES[self.variation]

    def observe(self) -> dict[str, Any]:
        rng = np.random.default_rng([self.seed, self.ticks])
        return {
            "pixels": {camera: rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8) for camera in CAMERAS},
            **{f"{camera}_depth": rng.integers(0, 2000, (SIZE, SIZE, 1), np.uint16) for camera in CAMERAS},
            "agent_pos": rng.normal(size=14).astype(np.float32),
            "camera_intrinsics": rng.normal(size=4 * len(CAMERAS)).astype(np.float32),
            "camera_extrinsics": rng.normal(size=12 * len(CAMERAS)).astype(np.float32),
        }

    def expert(self) -> Iterator[int]:
        yield from range(2)

    def execute(self, motion: int, on_tick: Callable[[FakeTick], None]) -> None:
        if self.crash_file and Path(self.crash_file).exists():
            os._exit(1)
        if self.error_file and Path(self.error_file).exists():
            raise OSError("no graphics")
        for _ in range(TICKS_PER_MOTION):
            on_tick(FakeTick(self.action()))
            self.ticks += 1
        time.sleep(self.seconds / 2)

    def action(self) -> np.ndarray:
        """Numbered by the tick, open in the first motion and closed in the second."""
        return np.float32([self.ticks, 0, 0, 1, 0, 0, 0, self.ticks < TICKS_PER_MOTION])

    def is_success(self) -> bool:
        return self.seed not in FAILING_SEEDS


def recorder(root: Path, **env: Any) -> "Recorder":
    """Records fake demonstrations into ``root``; ``env`` goes to ``FakeEnv``."""
    from dataset_tools.record import Recorder  # here, because every worker imports this file
    from dataset_tools.record_place import RecordPlace
    from dataset_tools.record_settings import RecordSettings

    settings = RecordSettings(("pick_and_lift",), None, CAMERAS, SIZE, 20, 0)
    place = RecordPlace(root, settings, overwrite=False)
    return Recorder(settings, partial(FakeEnv, **env), place, "local/fake")

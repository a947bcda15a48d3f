"""What makes episodes harder than the clean simulation, each with a strength; all off by default."""

import dataclasses
import math
from dataclasses import dataclass
from numbers import Real

MAX_DISTRACTORS = 6


@dataclass(frozen=True)
class Disturbances:
    """Strengths: 0 is off, 1 what one meets in a laboratory, 3 a bad one.

    The scene of a seed stays the same; everything here is drawn beside it, from the same seed.

    Args:
        lighting: each light's brightness varies by 40 % and its direction by 15 degrees, per episode.
        camera_pose: the extrinsics that are told are off by 5 mm and 0.5 degrees, per episode and camera.
        camera_intrinsics: the focal length that is told is off by 1 %, per episode and camera.
        rgb_noise: Gaussian noise of 6 of 255 on every channel.
        depth: noise, holes and dropouts like those of a RealSense D435.
        occluder: a grey card hangs before one fixed camera and hides 30 % of the width of its picture.
        dead_camera: probability that one camera of the episode gives black pictures without depth.
        distractors: number of blocks on free places of the table, in none of the colours that the instruction names.
        moved_object: probability that, once in an episode and between two motions, one of the task's loose objects is
            moved by 3 to 6 cm.
        action_noise: Gaussian noise of 4 mm on each axis of every commanded position; in recordings, one error for all
            key poses of a motion, and what is recorded is where the arm went.
        gripper_delay: the gripper takes its command 0.25 s late.
        camera: name of the camera that the occluder hides and that is dead; by default each is drawn per episode.
    """

    # lights' brightness (by up to 0.4 of it) and direction (15 degrees), per episode
    lighting: float = 0.0
    # error of the extrinsics that are told: 5 mm, 0.5 degrees
    camera_pose: float = 0.0
    # error of the focal length that is told: a hundredth
    camera_intrinsics: float = 0.0
    # Gaussian noise on colours: 6 of 255
    rgb_noise: float = 0.0
    # depth like a RealSense D435's: noise, holes at edges, dropouts
    depth: float = 0.0
    # a card before one fixed camera that hides 0.3 of its width
    occluder: float = 0.0
    # probability that one camera is dead
    dead_camera: float = 0.0
    # number of additional blocks on the table
    distractors: int = 0
    # probability that an object is moved once in an episode
    moved_object: float = 0.0
    # Gaussian noise on commanded positions: 4 mm
    action_noise: float = 0.0
    # delay of the gripper: 0.25 s
    gripper_delay: float = 0.0
    # the camera that the occluder hides and that is dead; by default drawn per episode
    camera: str = ""

    def __post_init__(self) -> None:
        strengths = {name: value for name, value in dataclasses.asdict(self).items() if name != "camera"}
        for name, value in strengths.items():
            if not (isinstance(value, Real) and math.isfinite(value)):
                raise ValueError(f"disturbances.{name} is {value!r}; it must be a finite number, 0 is off")
            if value < 0:
                raise ValueError(f"disturbances.{name} is {value}; it must not be negative")
        for name in ("dead_camera", "moved_object"):
            if getattr(self, name) > 1:
                raise ValueError(f"disturbances.{name} is {getattr(self, name)}; it is a probability, at most 1")
        if self.occluder > 3:
            raise ValueError(f"disturbances.occluder is {self.occluder}; at 3 nine tenths of the picture are hidden")
        if self.distractors > MAX_DISTRACTORS or self.distractors != int(self.distractors):
            raise ValueError(f"disturbances.distractors is {self.distractors}; a table holds 0 to {MAX_DISTRACTORS}")

    def check_cameras(self, cameras: tuple[str, ...]) -> None:
        """Raise ValueError unless the named camera is one of ``cameras``."""
        if self.camera and self.camera not in cameras:
            raise ValueError(f"disturbances.camera is {self.camera!r}; the cameras are {list(cameras)}")

    @property
    def objects(self) -> dict[str, str]:
        """Additional objects of the scene: name -> description."""
        kinds = ("cube", "block_cylinder", "block_brick", "block_hexagon")
        return {f"distractor{i}": kinds[i % len(kinds)] for i in range(self.distractors)}


CLEAN = Disturbances()

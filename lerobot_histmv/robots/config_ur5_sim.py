"""Options of the simulated UR5e as a LeRobot robot: ``--robot.type=ur5_sim --robot.task=pick_and_lift``."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from lerobot_histmv.envs.interface import CAMERA_NAMES, check_options


@RobotConfig.register_subclass("ur5_sim")
@dataclass(kw_only=True)
class UR5SimConfig(RobotConfig):
    """A simulated UR5e at one scene of a task.

    Args:
        task: a task (turn_tap) or a variation (turn_tap.left).
        seed: the scene.
        variation: number of the variation to use; None draws it from the seed.
        instruction_split: paraphrases among which the seed picks the scene's, ``train`` or ``held_out``.
        camera_names: which of front, left_shoulder and wrist to render, in this order.
        image_size: width and height of the images [pixels].
        stop_when_done: ask LeRobot to stop, as Ctrl-C does, once the task is done or out of time.
    """

    task: str = "pick_and_lift"
    seed: int = 200_000
    variation: int | None = None
    instruction_split: str = "train"
    camera_names: list[str] = field(default_factory=lambda: list(CAMERA_NAMES))
    image_size: int = 128
    stop_when_done: bool = False

    def __post_init__(self) -> None:
        """Check the options."""
        super().__post_init__()
        check_options(self.task, self.camera_names, self.image_size, "servo", self.variation, self.instruction_split)

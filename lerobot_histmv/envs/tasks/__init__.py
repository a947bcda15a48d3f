"""The tasks, by name. A new task is one class here plus its objects' descriptions."""

from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.envs.tasks.insert_onto_square_peg import InsertOntoSquarePeg
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift
from lerobot_histmv.envs.tasks.pick_up_cup import PickUpCup
from lerobot_histmv.envs.tasks.push_buttons import PushButtons
from lerobot_histmv.envs.tasks.reach_target import ReachTarget
from lerobot_histmv.envs.tasks.stack_blocks import StackBlocks
from lerobot_histmv.envs.tasks.stack_cups import StackCups
from lerobot_histmv.envs.tasks.take_lid_off_saucepan import TakeLidOffSaucepan
from lerobot_histmv.envs.tasks.turn_tap import TurnTap

TASKS: dict[str, type[Task]] = {
    task.name: task
    for task in (
        ReachTarget,
        PushButtons,
        PickAndLift,
        PickUpCup,
        TurnTap,
        StackBlocks,
        StackCups,
        InsertOntoSquarePeg,
        TakeLidOffSaucepan,
    )
}

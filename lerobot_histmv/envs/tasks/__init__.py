"""The tasks, by name. A new task is one class here plus its objects' descriptions."""

from lerobot_histmv.envs.tasks.base import Task
from lerobot_histmv.envs.tasks.pick_and_lift import PickAndLift
from lerobot_histmv.envs.tasks.push_buttons import PushButtons
from lerobot_histmv.envs.tasks.reach_target import ReachTarget
from lerobot_histmv.envs.tasks.turn_tap import TurnTap

TASKS: dict[str, type[Task]] = {task.name: task for task in (ReachTarget, PushButtons, PickAndLift, TurnTap)}
